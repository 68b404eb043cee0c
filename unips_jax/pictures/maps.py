"""Normals, errors and photographs as pictures of 8 bits, white outside the object."""

import cv2
import matplotlib
import numpy as np

from unips_jax.io.color import srgb_encode
from unips_jax.io.masks import mask_box

ERROR_LIMIT_DEG = 80.0
"""Error maps are clipped here, as in the seed paper's figures."""

COLOURS = "inferno"


def normals_picture(normals: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(n + 1) / 2 as RGB.

    Args:
        normals: `[H, W, 3]`, unit or zero.
        mask: `[H, W]`, bool.

    Returns:
        `[H, W, 3]`, uint8.
    """
    finite = np.nan_to_num(normals, nan=0, posinf=0, neginf=0)
    return _on_white(np.clip((finite + 1) / 2, 0, 1), mask)


def error_picture(errors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Errors from black (0) to bright yellow (80 degrees and more).

    Args:
        errors: `[H, W]`, degrees.
        mask: `[H, W]`, bool.

    Returns:
        `[H, W, 3]`, uint8.
    """
    share = np.clip(errors / ERROR_LIMIT_DEG, 0, 1)
    return _on_white(matplotlib.colormaps[COLOURS](share)[..., :3], mask)


def photograph_picture(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A linear image, exposed so that 1% of the object is white, as sRGB.

    Args:
        image: `[H, W, 3]`, linear, of any scale.
        mask: `[H, W]`, bool.

    Returns:
        `[H, W, 3]`, uint8.
    """
    white = float(np.percentile(image[mask].max(axis=-1), 99))
    linear = np.clip(image / white if white > 0 else image, 0, 1)
    return _on_white(srgb_encode(linear), mask)


def shrink(picture: np.ndarray, limit: int) -> np.ndarray:
    """The picture with its longer side at most `limit` pixels, by area averages."""
    height, width = picture.shape[:2]
    scale = limit / max(height, width)
    if scale >= 1:
        return picture
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def frame(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the mask with a margin of 3% around, to look at."""
    longer = max(side.stop - side.start - 1 for side in mask_box(mask))
    return mask_box(mask, 2 + int(0.03 * longer))


def _on_white(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.where(mask[..., None], picture, 1)).astype(np.uint8)
