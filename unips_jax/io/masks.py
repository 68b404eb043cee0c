"""Masks: which pixels show the object."""

from pathlib import Path

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, as_linear
from unips_jax.io.images import ImageFile, read_image_file, require_finite

_BLACK = 2  # levels of 255 that count as black
# Of white light, the same, and next to black: what a JPEG leaves around an object.
_BLACK_SHARE, _NEARLY_SHARE = 0.0006, 0.0145
_FLOOR_MOST, _REACH_MOST = 0.03, 0.025  # of white: a background that is black at all
_ALONG = 0.3  # of the frame
_SPECK, _SPECK_SHARE = 4, 0.0005  # pixels, and of all: noise that goes beyond the rest
_LEVELS_SHARE = 0.9
_LEVEL = 1 / 16


def read_mask(path: Path) -> np.ndarray:
    """Reads a mask: `[H, W]` bool; see `mask_of`."""
    return mask_of(read_image_file(path))


def mask_of(file: ImageFile) -> np.ndarray:
    """What a mask's image marks, at least a pixel: `[H, W]` bool.

    Inside is where the brightest channel is above half of the image's largest value,
    whatever that is. So neither the noise of a JPEG nor a soft edge counts as object.

    Where transparency varies, the same rule for alpha must hold too. If what it leaves
    is no mask itself (nine in ten pixels nearly black or nearly the brightest, both
    met) but one colour or a cut-out photograph, alpha alone decides.
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
    """Where values are above half of their largest (of 0, nowhere)."""
    return values > values.max() / 2


def mask_box(mask: np.ndarray, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns of the box around a mask that is not empty, with a margin."""
    box = []
    for axis in (1, 0):
        inside = np.flatnonzero(mask.any(axis=axis))
        first, last = int(inside[0]) - margin, int(inside[-1]) + 1 + margin
        box.append(slice(max(first, 0), min(last, mask.shape[1 - axis])))
    return box[0], box[1]


def lit_pixels(
    brightest: np.ndarray, transfer: Transfer, mask: np.ndarray
) -> np.ndarray:
    """Where photographs are neither black, in 8 bits, nor nearly so next to it.

    Nearly is up to 1.4% of white, the brightest 0.5% of the mask `[H, W]`, in light.
    `brightest` is `[H, W]`, the largest value over photographs and colours.
    """
    if brightest.dtype != np.uint8:
        return brightest > 0
    black = brightest <= _BLACK
    white = np.percentile(brightest[mask], 99.5, method="lower")
    nearly = _NEARLY_SHARE * as_linear(white, transfer)
    return _without(black | (as_linear(brightest, transfer) <= nearly), black)


def lit_without_mask(brightest: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Where photographs of no mask show more than black and a sensor's noise.

    Black is 0.06% of white, the brightest 0.5%. What is nearly so is black next to it,
    up to 1.4%, or, where most of the frame is dark, to what its noise reaches; then
    also what lies along the frame. All in light: the bits do not matter. `brightest` as
    in `lit_pixels`.
    """
    light = as_linear(brightest, transfer)
    white = float(np.percentile(light, 99.5)) or 1.0
    frame = np.ones(light.shape, bool)
    frame[1:-1, 1:-1] = False
    floor = float(np.median(light[frame]))
    nearly = _NEARLY_SHARE * white
    black = light <= _BLACK_SHARE * white
    if brightest.dtype == np.uint8:
        black |= brightest <= _BLACK
    if floor > _FLOOR_MOST * white:
        return _without(light <= nearly, black)
    spread = 1.4826 * float(np.median(np.abs(light[frame] - floor)))
    reach = float(np.clip(floor + 4 * spread, nearly, _REACH_MOST * white))
    dark = light <= reach
    _, regions = cv2.connectedComponents(dark.astype(np.uint8), connectivity=8)
    along = np.bincount(regions[frame & dark], minlength=regions.max() + 1)
    lit = _without(dark, black | (along > _ALONG * frame.sum())[regions])
    _, parts, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8))
    specks = stats[:, cv2.CC_STAT_AREA] <= max(_SPECK, _SPECK_SHARE * lit.sum())
    return lit & ~specks[parts]


def _without(dark: np.ndarray, black: np.ndarray) -> np.ndarray:
    """All but the dark regions that have a black pixel."""
    count, regions = cv2.connectedComponents(dark.astype(np.uint8), connectivity=8)
    lit = np.ones(count, bool)
    lit[regions[black & dark]] = False
    return lit[regions]


def _has_two_levels(values: np.ndarray) -> bool:
    """Whether values are those of a mask: some dark, some bright, few between."""
    top = float(values.max(initial=0))
    dark = (values <= top * _LEVEL).mean()
    bright = (values >= top * (1 - _LEVEL)).mean()
    return bool(top > 0 and dark > 0 and dark + bright >= _LEVELS_SHARE)
