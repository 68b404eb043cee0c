"""The authors' own preprocessing, for results comparable with theirs.

Square crop around the mask (but none for training folders), nearest-neighbour resize to
a fixed size (the aspect is not kept), division by the mean inside the mask. Every file
is taken as linear. For everything else there is `io.photographs.read_photographs`.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import as_float
from unips_jax.io.images import ImageFile, read_image_file, require_finite
from unips_jax.io.masks import mask_box
from unips_jax.io.orientation import require_orientation
from unips_jax.io.photographs import mask_for
from unips_jax.io.selection import Selection

_MARGIN = 4


def read_official(
    selection: Selection,
    *,
    size: int = 512,
    whole: bool = False,
    keep_aspect: bool = False,
    read: Callable[[Path], ImageFile] = read_image_file,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Reads photographs as the authors' reader does.

    With a `normal.tif` among the photographs, the mask of a folder without its own is
    where these normals have unit length, unless the `whole` image is asked for. A
    training folder (photographs `0*` and `normal.tif`) is not cropped. With
    `keep_aspect` a crop that is not square is refused. Returns images
    `[N, size, size, 3]` (float32, linear RGB, mean 1 inside the mask, where no image
    may be black, and 0 outside), the mask, and the normals, as stored, or None.
    """
    first = read(selection.files[0])
    shape = first.pixels.shape[:2]
    normal_file = selection.folder / "normal.tif"
    normals = None
    if normal_file.is_file():
        normals = 2 * _sized(read(normal_file), shape) - 1
    if selection.mask_file is None and normals is not None and not whole:
        mask = np.abs(1 - np.linalg.norm(normals, axis=-1)) < 1e-3
    else:
        mask = mask_for(selection, shape, read=read)
    training = normals is not None and selection.names[0].startswith("0")
    crop = (slice(None), slice(None)) if training else official_crop(mask)
    height, width = mask[crop].shape
    if keep_aspect and abs(height - width) > 1:
        raise InputError(
            f"{selection.title}: the authors' reader makes {width} x {height} pixels "
            "square, and no depth fits that; leave out --reader official, or --depth, "
            "--mesh and --view"
        )
    small_mask = _resized(mask.astype(np.uint8)[crop], size) > 0
    images = np.zeros((len(selection.files), size, size, 3), np.float32)
    for i, (image, path) in enumerate(zip(images, selection.files, strict=True)):
        file = first if i == 0 else read(path)
        require_orientation(file, first)
        image[:] = _resized(_sized(file, shape)[crop], size)
        mean = image[small_mask].mean(dtype=np.float64) if small_mask.any() else 0
        if not mean > 0:
            raise InputError(
                f"{path}: expected light inside the mask, got 0 everywhere; remove the "
                "image, or check the mask"
            )
        image *= small_mask[..., None] / np.float32(mean)
    if normals is not None:
        normals = _resized(normals[crop], size)
    return images, small_mask, normals


def official_crop(mask: np.ndarray) -> tuple[slice, slice]:
    """The authors' crop around a mask `[H, W]`: rows and columns.

    If its bounding box with a margin of 4 pixels does not stay strictly inside the
    image, nothing is cropped.
    """
    if not mask.any():
        return slice(None), slice(None)
    box = mask_box(mask)
    lows = [side.start for side in box]
    highs = [side.stop - 1 for side in box]
    for low, high, length in zip(lows, highs, mask.shape, strict=True):
        if not (low - _MARGIN > 0 and high + _MARGIN <= length):
            return slice(None), slice(None)
    lengths = [high - low for low, high in zip(lows, highs, strict=True)]
    extra = int(0.5 * abs(lengths[0] - lengths[1]))
    shorter = int(np.argmin(lengths))
    crop = []
    for axis, (low, high) in enumerate(zip(lows, highs, strict=True)):
        reach = _MARGIN + (extra if axis == shorter else 0)
        crop.append(slice(max(low - reach, 0), min(high + reach, mask.shape[axis])))
    return crop[0], crop[1]


def _sized(file: ImageFile, shape: tuple[int, ...]) -> np.ndarray:
    """RGB in float32, without negative light."""
    require_finite(file.path, file.pixels)
    image = np.maximum(as_float(file.pixels), 0)
    if image.shape[:2] != shape:
        raise InputError(
            f"{file.path}: expected {shape[1]} x {shape[0]} pixels as the first "
            f"photograph, got {image.shape[1]} x {image.shape[0]}; remove or re-export "
            "it"
        )
    return np.broadcast_to(image, (*shape, 3))


def _resized(image: np.ndarray, size: int) -> np.ndarray:
    return cv2.resize(
        np.ascontiguousarray(image), (size, size), interpolation=cv2.INTER_NEAREST
    )
