"""Depth on disk, each file with its unit and scale in words.

    depth.exr    float32, one channel Z; grows away from the viewer; NaN: no surface
    depth.png    16 bits; 1 is nearest, 65535 farthest; 0: no surface
    height.png   16 bits; 0 is farthest, 65535 nearest, for displacement; 0 outside too

The PNGs' text chunks and the record hold the depth that levels stand for.
"""

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from unips_jax.errors import InputError
from unips_jax.io.door import new_file
from unips_jax.io.formats.exr import MAGIC
from unips_jax.io.images import write_exr

_TOP = 65535


def read_depth(path: Path) -> np.ndarray:
    """Reads `depth.exr`: its channel Z as stored, `[H, W]`, float32."""
    if not path.is_file() or path.read_bytes()[:4] != MAGIC:
        raise InputError(
            f"{path}: expected depth as an EXR with channel Z, or a .npy, got another "
            "file or none; convert it"
        )
    try:
        channels = OpenEXR.File(str(path)).channels()
    except Exception as error:  # the library raises what it likes
        raise InputError(f"{path}: cannot be read: {error}") from None
    if "Z" not in channels:
        raise InputError(
            f"{path}: expected the channel Z, got {', '.join(channels)}; rename it"
        )
    return channels["Z"].pixels.astype(np.float32)


def write_depth(folder: Path, depth: np.ndarray, *, unit: str) -> dict[str, Any]:
    """Writes `depth.exr`, `depth.png` and `height.png` into a folder that exists.

    `depth` is `[H, W]`, float32, NaN where there is no surface. Returns for the record
    the unit, nearest and farthest depth, and what each level of the PNGs means.
    """
    there = np.isfinite(depth)
    near = float(depth[there].min()) if there.any() else 0.0
    far = float(depth[there].max()) if there.any() else 0.0
    reach = far - near
    share = np.where(there, depth - near, 0) / (reach or 1.0)
    levels = np.where(there, 1 + np.round(share * (_TOP - 1)), 0).astype(np.uint16)
    heights = np.where(there, np.round((1 - share) * _TOP), 0).astype(np.uint16)
    facts = {
        "unit": unit,
        "near": near,
        "far": far,
        "depth.png": f"depth = {near:.9g} + (level - 1) * {reach / (_TOP - 1):.9g} "
        f"{unit}, away from the viewer; level 0: no surface",
        "height.png": f"height above the farthest point = level * {reach / _TOP:.9g} "
        f"{unit}, towards the viewer; full scale {reach:.9g} {unit}",
    }
    comments = f"depth in {unit}, away from the viewer; NaN: no surface"
    write_exr(folder / "depth.exr", {"Z": depth}, comments)
    _write_png(folder / "depth.png", levels, str(facts["depth.png"]))
    _write_png(folder / "height.png", heights, str(facts["height.png"]))
    return facts


def _write_png(path: Path, levels: np.ndarray, text: str) -> None:
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    chunks.add_text("Description", text)
    with new_file(path) as file:
        Image.fromarray(levels).save(file, format="png", pnginfo=chunks)
