"""Photographs of one camera whose files disagree about which way is up.

A camera that looks down from a tripod does not know: files that were stored alike are
shown turned. Edges decide what fits.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.formats.encoded import turned_back
from unips_jax.io.images import (
    MAX_PIXELS,
    ImageFile,
    decode_image,
    image_header,
    read_bytes,
    read_image_file,
    turned,
)

ADVICE = (
    "remove the tag from all files (exiftool -Orientation= FILES; of HEIC export PNG "
    "that lie alike)"
)
_SIDE = 128  # pixels of the longer side, where edges are compared
_ALIKE, _CLEARLY = 0.3, 0.15  # correlations


def oriented_as(file: ImageFile, first: ImageFile, image: np.ndarray) -> ImageFile:
    """A photograph turned as the first: as stored or as shown, what clearly fits."""
    stored = as_oriented(file, first.orientation)
    as_stored, as_shown = (_likeness(f.pixels, image) for f in (stored, file))
    if max(as_stored, as_shown) < _ALIKE or abs(as_stored - as_shown) < _CLEARLY:
        require_orientation(file, first)
    if as_stored > as_shown:
        return stored
    return dataclasses.replace(file, orientation=first.orientation)


def read_as_estimated(
    path: Path, record: Mapping[str, Any], *, max_pixels: int = MAX_PIXELS
) -> np.ndarray:
    """A photograph as an estimate had it, by its record: `[H, W, 1 or 3]`.

    Turned as the first one; the record's "transfer" holds for the values.
    """
    file = read_image_file(path, max_pixels=max_pixels)
    first = path.with_name(next(iter(record.get("images", ())), path.name))
    if path != first:
        data = read_bytes(first, max_pixels=max_pixels)
        header = image_header(data, first, max_pixels=max_pixels)
        if header.orientation != file.orientation:
            start = decode_image(data, first, max_pixels=max_pixels)
            file = oriented_as(file, start, start.pixels)
    if record.get("transfer_rule") == "--transfer":
        return file.pixels
    return file.encoding.values(file.pixels)


def require_orientation(file: ImageFile, first: ImageFile) -> None:
    """Raises InputError if two photographs' EXIF orientations differ."""
    if file.orientation != first.orientation:
        raise InputError(
            f"{file.path}: expected EXIF orientation {first.orientation} as in "
            f"{first.path.name}, got {file.orientation}; if the camera stood still, "
            f"{ADVICE}, else leave this one out"
        )


def as_oriented(file: ImageFile, orientation: int) -> ImageFile:
    """The same file, turned as if EXIF had asked for it: from 1 (as stored) to 8."""

    def again(image: np.ndarray) -> np.ndarray:
        return turned(turned_back(image, file.orientation), orientation)

    alpha = None if file.alpha is None else again(file.alpha)
    return dataclasses.replace(
        file, pixels=again(file.pixels), alpha=alpha, orientation=orientation
    )


def normals_as_stored(normals: np.ndarray, orientation: int) -> np.ndarray:
    """Normals `[H, W, 3]` of a photograph as shown, as those of the picture stored."""
    axes = axes_as_stored(orientation).astype(normals.dtype)
    return turned_back(normals, orientation) @ axes.T


def axes_as_stored(orientation: int) -> np.ndarray:
    """What turns vectors (y up) of a photograph as shown as `turned_back` its pixels.

    A matrix `[3, 3]`; its transpose turns them the other way.
    """
    x, y, z = np.diag([1.0, -1.0, 1.0])  # y down
    y = -y if orientation in (3, 4, 7, 8) else y
    x = -x if orientation in (2, 3, 6, 7) else x
    x, y = (y, x) if orientation >= 5 else (x, y)
    return np.stack([x, -y, z])


def _likeness(image: np.ndarray, other: np.ndarray) -> float:
    """Correlation of the edges of two images; -1 if their sizes differ."""
    if image.shape[:2] != other.shape[:2]:
        return -1.0
    scale = min(1.0, _SIDE / max(image.shape[:2]))
    edges = []
    for pixels in (image, other):
        grey = np.ascontiguousarray(pixels.astype(np.float32).mean(axis=-1))
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), 1)
        log = np.log(small + max(0.05 * float(small.max()), 1e-12))
        edges.append(np.hypot(*np.gradient(log)).ravel())
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.nan_to_num(np.corrcoef(*edges)[0, 1]))
