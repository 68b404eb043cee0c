"""Writes PS-Wild folders: images, truth and facts, whole or not at all.

Plain NumPy. `io.ps_wild_objects` and `evaluation.benchmarks.ps_wild` read them.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder


def check_picture(path: Path, option: str) -> None:
    """Refuses what `write_picture` could not write, before there is a picture.

    Args:
        path: of the picture.
        option: of the command line that gave it.

    Raises:
        InputError: naming the option.
    """
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif"):
        raise InputError(
            f"{option}: expected a file ending in .png, .jpg or .tif, got {path}"
        )
    if path.is_dir():
        raise InputError(f"{option}: expected a file's name, got a folder's, {path}")
    make_folder(path.parent, option)


def write_picture(path: Path, pixels: np.ndarray) -> None:
    """Writes RGB or grey pixels; the suffix chooses the format."""
    if pixels.ndim == 3:
        pixels = pixels[..., ::-1]
    ok, data = cv2.imencode(path.suffix, np.ascontiguousarray(pixels))
    if not ok:
        raise OSError(f"{path}: could not be encoded")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes())


def encode_normals(normals: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Normals as 16-bit colours.

    Args:
        normals: `[H, W, 3]`, unit inside the mask.
        mask: `[H, W]` bool.

    Returns:
        `[H, W, 3]` uint16, v = 65535 (n + 1) / 2 rounded, 32768 outside the mask.
    """
    values = np.rint((np.clip(normals, -1, 1) + 1) * 32767.5)
    return np.where(mask[..., None], values, 32768).astype(np.uint16)


def encode_linear(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1], clipped, as 16-bit integers."""
    return np.rint(np.clip(values, 0, 1) * 65535).astype(np.uint16)


def write_folder(
    folder: Path,
    images: Iterable[np.ndarray],
    mask: np.ndarray,
    normals: np.ndarray,
    facts: Mapping[str, Any],
    *,
    maps: Mapping[str, np.ndarray] | None = None,
    depth: np.ndarray | None = None,
    name: str = "L_{:02d}.png",
) -> None:
    """Writes one object; the folder appears only when it is complete.

    The caller has claimed it: what a killed process left of it is removed.

    Args:
        folder: `X.data`, must not exist.
        images: `[H, W, 3]` each, linear, 1 becomes 65535.
        mask: `[H, W]` bool.
        normals: `[H, W, 3]`, unit inside the mask.
        facts: JSON values for `meta.json`.
        maps: of the material in [0, 1], `[H, W]` or `[H, W, 3]`, kept as 16-bit TIFF
            under their names.
        depth: `[H, W]`, kept as `depth.exr`; 0 outside the mask.
        name: of the images' files, by number.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    for leftover in folder.parent.glob(f".{folder.name}.*"):
        shutil.rmtree(leftover)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for index, image in enumerate(images):
            write_picture(partial / name.format(index), encode_linear(image))
        write_picture(partial / "mask.png", mask.astype(np.uint8) * 255)
        write_picture(partial / "normal.tif", encode_normals(normals, mask))
        for title, values in (maps or {}).items():
            write_picture(partial / f"{title}.tif", encode_linear(values))
        if depth is not None:
            channels = {"Z": np.where(mask, depth, 0).astype(np.float32)}
            OpenEXR.File({}, channels).write(str(partial / "depth.exr"))
        text = json.dumps(dict(facts), indent=1)
        (partial / "meta.json").write_text(text + "\n")
        partial.chmod(0o755)
        os.rename(partial, folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
