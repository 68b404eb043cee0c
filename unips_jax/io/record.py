"""What one estimate was made from: kept beside the normals, and printed."""

import sys
import textwrap
from typing import Any

import numpy as np

from unips_jax import __version__
from unips_jax.io.photographs import Selection

_UNTRAINED = "RANDOM WEIGHTS: an untrained network, these normals mean nothing"


def make_record(
    selection: Selection,
    images: np.ndarray,
    mask: np.ndarray,
    weights: dict[str, Any],
    options: dict[str, Any],
    warnings: list[str],
) -> dict[str, Any]:
    """The content of `normals.json`, less its list of files.

    Args:
        selection: the photographs used and left out.
        images: `[N, H, W, 3]`, as the network is given them.
        mask: `[H, W]`, bool.
        weights: name, hash and whether they were trained.
        options: what the user chose, or was chosen for them.
        warnings: about the capture.
    """
    mask_file = selection.mask_file
    return {
        "unips_jax": __version__,
        "weights": weights,
        "folder": str(selection.folder),
        "images": list(selection.names),
        "left_out": selection.left_out,
        "mask": None if mask_file is None else str(mask_file),
        "mask_pixels": int(mask.sum()),
        "width": mask.shape[1],
        "height": mask.shape[0],
        "dtype": str(images.dtype),
        "options": options,
        "warnings": warnings,
    }


def summary(record: dict[str, Any]) -> str:
    """One line for the contact sheet.

    Args:
        record: from `make_record`.
    """
    weights = record["weights"]
    name = f"weights {weights['name']}" if weights["trained"] else _UNTRAINED
    size = f"{record['width']} x {record['height']} pixels"
    return f"{size}   {name}   unips_jax {record['unips_jax']}"


def print_selection(selection: Selection) -> None:
    """Prints which photographs are used, and which files are not and why.

    Args:
        selection: the files.
    """
    print(f"{selection.folder}: {len(selection.files)} photographs")
    print_line("used", ", ".join(selection.names))
    for reason, names in selection.left_out.items():
        print_line("left out", f"{', '.join(names)} ({reason})")


def print_record(record: dict[str, Any]) -> None:
    """Prints what else the estimate depends on.

    Args:
        record: from `make_record`.
    """
    options, weights = record["options"], record["weights"]
    size = f"{record['width']} x {record['height']}"
    mask = record["mask"] or "none, so the whole image"
    print_line("mask", f"{mask}: {record['mask_pixels']} of {size} pixels")
    if options["reader"] == "official":
        print_line("reader", f"official: square crop, resized to {size}, linear")
    else:
        print_line(
            "transfer",
            f"{options['transfer']} ({record['dtype']} pixels; "
            "--transfer linear or srgb overrules)",
        )
    print_line("weights", f"{weights['name']} (hash {weights['hash'][:8]})")
    if not weights["trained"]:
        print_line("", _UNTRAINED)
    sys.stdout.flush()


def print_line(label: str, text: str) -> None:
    """Prints an indented line with a label, wrapped between words.

    Args:
        label: a word.
        text: what to print.
    """
    lines = textwrap.wrap(
        text,
        100,
        break_long_words=False,
        break_on_hyphens=False,
        subsequent_indent=" " * 12,
    )
    print(f"  {label:10}" + "\n".join(lines))
