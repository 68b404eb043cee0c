"""What one estimate was made from: kept with the normals, and printed."""

import datetime
import hashlib
import importlib.metadata
import os
import platform
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.io.color import Transfer
from unips_jax.io.images import MAX_PIXELS, ImageFile, decode_image, read_bytes
from unips_jax.io.results import file_hash
from unips_jax.io.selection import Selection
from unips_jax.version import __version__

_UNTRAINED = "RANDOM WEIGHTS: an untrained network, these normals mean nothing"
_VERSIONS_OF = ("jax", "flax", "numpy", "opencv-python-headless")


class HashingReader:
    """Reads image files, and knows their hashes from then on: each is opened once."""

    def __init__(self, max_pixels: int = MAX_PIXELS) -> None:
        self._max_pixels = max_pixels
        self._hashes: dict[Path, str] = {}

    def __call__(self, path: Path) -> ImageFile:
        """Reads an image file; see `read_image_file`."""
        data = read_bytes(path, max_pixels=self._max_pixels)
        self._hashes[path] = hashlib.sha256(data).hexdigest()
        return decode_image(data, path, max_pixels=self._max_pixels)

    def hash(self, path: Path) -> str:
        """The SHA-256 of a file's contents, opened if it was not read here."""
        if path not in self._hashes:
            self._hashes[path] = file_hash(path)
        return self._hashes[path]


def input_record(
    selection: Selection,
    weights: dict[str, Any],
    options: dict[str, Any],
    code: str,
    reader: HashingReader,
) -> dict[str, Any]:
    """What the normals follow from, known before anything is computed."""
    mask = selection.mask_file
    return {
        "unips_jax": __version__,
        "code": code,
        "weights": weights,
        "folder": os.path.abspath(selection.title),  # links stay
        "images": {file.name: reader.hash(file) for file in selection.files},
        "left_out": selection.left_out,
        "mask": None if mask is None else os.path.abspath(mask),
        "mask_hash": None if mask is None else reader.hash(mask),
        "options": options,
    }


def same_inputs(record: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two estimates' normals are the same: places and names do not matter."""

    def essence(record: dict[str, Any]) -> list[Any]:
        names = ("unips_jax", "code", "mask_hash", "options")
        weights, images = record.get("weights"), record.get("images")
        return [
            weights.get("hash") if isinstance(weights, dict) else None,
            list(images.items()) if isinstance(images, dict) else None,
            *(record.get(name) for name in names),
        ]

    return essence(record) == essence(other)


def complete_record(
    inputs: dict[str, Any],
    images: np.ndarray,
    mask: np.ndarray,
    transfer: Transfer,
    transfer_rule: str,
    warnings: list[str],
) -> dict[str, Any]:
    """The content of `normals.json`, less the files' hashes."""
    now = datetime.datetime.now(datetime.UTC)
    return {
        **inputs,
        "date": now.isoformat(timespec="seconds"),
        "versions": {
            "python": platform.python_version(),
            **{name: _version(name) for name in _VERSIONS_OF},
        },
        "mask_pixels": int(mask.sum()),
        "width": mask.shape[1],
        "height": mask.shape[0],
        "dtype": str(images.dtype),
        "transfer": transfer,
        "transfer_rule": transfer_rule,
        "warnings": warnings,
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def summary(record: dict[str, Any]) -> str:
    """One line for the contact sheet."""
    weights = record["weights"]
    name = f"weights {weights['name']}" if weights["trained"] else _UNTRAINED
    size = f"{record['width']} x {record['height']} pixels"
    return f"{size}   {name}   unips_jax {record['unips_jax']}"


def print_selection(selection: Selection) -> None:
    """Prints which photographs are used, and which files are not and why."""
    print(f"{selection.title}: {len(selection.files)} photographs")
    print_line("used", ", ".join(selection.names))
    for reason, names in selection.left_out.items():
        print_line("left out", f"{', '.join(names)} ({reason})")


def print_record(record: dict[str, Any]) -> None:
    """Prints what else the estimate depends on."""
    options, weights = record["options"], record["weights"]
    size = f"{record['width']} x {record['height']}"
    print_line(
        "mask",
        f"{_mask_shown(record)}: {record['mask_pixels']} of {size} pixels are taken",
    )
    if options["reader"] == "official":
        print_line("reader", f"official: square crop, resized to {size}, linear")
    else:
        print_line(
            "transfer",
            f"{record['transfer']} ({record['transfer_rule']}; "
            "--transfer linear or srgb overrules)",
        )
    if record.get("moved_back"):
        moves = record["moved_back"].items()
        shown = [f"{name} {x:+.1f} {y:+.1f}" for name, (x, y) in moves]
        lay = f"{', '.join(shown)} pixels (right, down) from the others"
        print_line("moved", f"back: {lay}")
    if known := options["known_lights"]:
        print_line("lights", f"known of {len(known)} of {len(record['images'])}")
    print_line("weights", f"{weights['name']} (hash {weights['hash'][:8]})")
    if not weights["trained"]:
        print_line("", _UNTRAINED)
    sys.stdout.flush()


def _mask_shown(record: dict[str, Any]) -> str:
    contrast = record.get("mask_contrast")
    if record["mask"] or contrast is None:
        return record["mask"] or "none"
    if record["mask_suggested"]:
        return (
            f"suggested by {record['mask_rule']} ({contrast:.2f}; --mask FILE or none "
            "overrules; see mask.png)"
        )
    return f"none (no object found: {contrast:.2f})"


def print_line(label: str, text: str) -> None:
    """Prints an indented line with a label, wrapped between words."""
    lines = textwrap.wrap(
        text,
        100,
        break_long_words=False,
        break_on_hyphens=False,
        subsequent_indent=" " * 12,
    )
    print(f"  {label:10}" + "\n".join(lines))
