"""Masks: which pixels show the object."""

from pathlib import Path

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.images import ImageFile, read_image_file, require_finite

_BLACK = 2  # levels of 255 that count as black
_NEARLY_BLACK = 32  # next to black: what a JPEG leaves around an object, 1.4% of light
_LEVELS_SHARE = 0.9
_LEVEL = 1 / 16


def read_mask(path: Path) -> np.ndarray:
    """Reads a mask: `[H, W]` bool; see `mask_of`.

    Raises:
        InputError: if the file cannot be read, or nothing is inside.
    """
    return mask_of(read_image_file(path))


def mask_of(file: ImageFile) -> np.ndarray:
    """What a mask's image marks: `[H, W]` bool.

    Inside is where the brightest channel is above half of the image's largest value,
    whatever that is. So neither the noise of a JPEG nor a soft edge counts as object.

    Where transparency varies, the same rule for alpha must hold too. If what it leaves
    is no mask itself (nine in ten pixels nearly black or nearly the brightest, both
    met) but one colour or a cut-out photograph, alpha alone decides.

    Raises:
        InputError: if nothing is inside, or values are not finite.
    """
    require_finite(file.path, file.pixels)
    values = file.pixels.max(axis=-1)
    if file.alpha is None or np.ptp(file.alpha) == 0:
        mask = above_half(values)
    else:
        mask = above_half(file.alpha)
        if _has_two_levels(values[mask]):
            mask &= values > values[mask].max() / 2
    if not mask.any():
        raise InputError(
            f"{file.path}: expected a mask that is bright on the object, got "
            f"{values.max()} at most; paint the object white, or remove the mask"
        )
    return mask


def above_half(values: np.ndarray) -> np.ndarray:
    """Where values are above half of their largest: bool, of the same shape.

    Args:
        values: not empty; nothing is above half of 0.
    """
    return values > values.max() / 2


def mask_box(mask: np.ndarray, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns of a mask's bounding box.

    Args:
        mask: `[H, W]`, bool, with at least one pixel.
        margin: pixels more on each side, where the image has them.
    """
    box = []
    for axis in (1, 0):
        inside = np.flatnonzero(mask.any(axis=axis))
        first, last = int(inside[0]) - margin, int(inside[-1]) + 1 + margin
        box.append(slice(max(first, 0), min(last, mask.shape[1 - axis])))
    return box[0], box[1]


def lit_pixels(brightest: np.ndarray) -> np.ndarray:
    """Where photographs show something: not black, in 8 bits nor nearly so beside it.

    Args:
        brightest: `[H, W]`, the largest value over photographs and colours.
    """
    if brightest.dtype != np.uint8:
        return brightest > 0
    nearly = (brightest <= _NEARLY_BLACK).astype(np.uint8)
    count, regions = cv2.connectedComponents(nearly, connectivity=8)
    lit = np.ones(count, bool)
    lit[regions[brightest <= _BLACK]] = False
    return lit[regions]


def _has_two_levels(values: np.ndarray) -> bool:
    """Whether values are those of a mask: some dark, some bright, few between."""
    top = float(values.max(initial=0))
    dark = (values <= top * _LEVEL).mean()
    bright = (values >= top * (1 - _LEVEL)).mean()
    return bool(top > 0 and dark > 0 and dark + bright >= _LEVELS_SHARE)
