"""Where the object is: a mask suggested from photographs, and pieces of it by a click.

Where the background is plain enough to be sure, its difference decides
(`capture/background.py`), and where that is less than certain the network must agree;
else a network for salient objects does (`capture/salient.py`). What only shines in the
dark is no object (`capture/shine.py`).
"""

from typing import Literal, NamedTuple

import cv2
import numpy as np

from unips_jax.capture.background import mask_on_plain_background, overlap
from unips_jax.capture.salient import mask_of_salient_object
from unips_jax.capture.shine import is_only_shine
from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, as_float, srgb_encode

TRUSTED = 0.60
"""The least figure of a guess that is used without asking."""

_CERTAIN = 0.80  # of the plain background's figure: the network is not asked
_AGREE = 0.80  # overlap of both masks
_CONTRADICTED = 0.5  # figure of a mask that the network contradicts
_SHINE = 0.3  # of one of highlights alone
_SURE = 0.35  # what the network's overlap may lack of 1 at a figure of 0
_SMALLEST = 16  # pixels of a side
_TOLERANCE = 14  # levels of 255, from the colour that was clicked


class MaskGuess(NamedTuple):
    """A mask, unless none was found."""

    mask: np.ndarray | None  # `[H, W]`, bool; None where the figure is below `TRUSTED`
    # how sure it is, in [0, 1]: of a plain background the contrast of outline,
    # threshold and surroundings; of the network how steady its outline is from 30 to 70
    # % of saliency
    figure: float
    # what found the mask; empty if nothing did
    rule: Literal["plain background", "salient object", ""] = ""


def suggest_mask(images: np.ndarray, *, transfer: Transfer = "srgb") -> MaskGuess:
    """Finds the object of photographs `[N, H, W, 3]`, whatever is behind it."""
    if min(images.shape[1:3]) < _SMALLEST:
        return MaskGuess(None, 0.0)
    guess = _guess(images, transfer)
    if guess.mask is not None and is_only_shine(images, guess.mask, transfer):
        return MaskGuess(None, _SHINE)
    return guess


def _guess(images: np.ndarray, transfer: Transfer) -> MaskGuess:
    plain = mask_on_plain_background(images, transfer=transfer)
    contrast = round(plain[1], 2) if plain else 0.0
    if plain and contrast >= _CERTAIN:
        return MaskGuess(plain[0], contrast, "plain background")
    salient = mask_of_salient_object(images, transfer=transfer)
    figure = round(max(1 - (1 - salient[1]) / _SURE, 0.0), 2) if salient else 0.0
    if plain and contrast >= TRUSTED:
        if salient is None or overlap(plain[0], salient[0]) >= _AGREE:
            return MaskGuess(plain[0], contrast, "plain background")
        contrast = _CONTRADICTED
    if salient and figure >= TRUSTED:
        return MaskGuess(salient[0], figure, "salient object")
    return MaskGuess(None, max(figure, contrast))


def toggle_piece(
    mask: np.ndarray, picture: np.ndarray, point: tuple[float, float]
) -> np.ndarray:
    """The mask after a click: the piece under it is taken, or dropped if it was inside.

    A piece is a part of the mask apart from its largest, or a hole in it; elsewhere,
    what is connected and has about the colour that was clicked, in a picture such as
    `mask_picture` gives. `point` is x and y, in pixels.
    """
    height, width = mask.shape
    x, y = int(np.floor(point[0])), int(np.floor(point[1]))
    if picture.shape != (height, width, 3) or picture.dtype != np.uint8:
        raise InputError(
            f"picture: expected uint8 of the mask's size {[height, width, 3]}, got "
            f"{picture.dtype} {list(picture.shape)}; make it with mask_picture"
        )
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(
            f"point: expected one inside {width} x {height} pixels, got {x}, {y}"
        )
    alike = (mask == mask[y, x]).astype(np.uint8)
    # Four neighbours outside, so that a diagonal line of the mask closes a hole.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        alike, connectivity=8 if mask[y, x] else 4
    )
    part = int(labels[y, x])
    piece = labels == part
    if mask[y, x]:
        whole = stats[part, cv2.CC_STAT_AREA] < stats[1:, cv2.CC_STAT_AREA].max()
    else:
        left, top, wide, high = stats[part, :4]
        whole = left > 0 and top > 0 and left + wide < width and top + high < height
    if not whole:
        piece = _of_one_colour(picture, piece, (x, y))
    return mask & ~piece if mask[y, x] else mask | piece


def _of_one_colour(
    picture: np.ndarray, where: np.ndarray, point: tuple[int, int]
) -> np.ndarray:
    """What is connected to the point and has about its colour, specks filled."""
    smooth = np.ascontiguousarray(cv2.medianBlur(picture, 5))
    barred = np.pad(~where, 1, constant_values=True).astype(np.uint8)
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (2 << 8)
    tolerance = (_TOLERANCE,) * 3
    cv2.floodFill(smooth, barred, point, 0, tolerance, tolerance, flags)
    found = (barred[1:-1, 1:-1] == 2).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    return (cv2.morphologyEx(found, cv2.MORPH_CLOSE, kernel) > 0) & where


def mask_picture(images: np.ndarray, *, transfer: Transfer = "srgb") -> np.ndarray:
    """A picture to draw a mask over: the brightest of all photographs, uint8, sRGB."""
    brightest = as_float(images.max(axis=0))
    brightest = brightest / (float(np.percentile(brightest, 99.5)) or 1.0)
    if transfer == "linear":
        brightest = srgb_encode(brightest)
    return np.rint(np.clip(brightest, 0, 1) * 255).astype(np.uint8)
