"""Normals, errors and photographs as pictures of 8 bits, white outside the object."""

import cv2
import numpy as np

from unips_jax.io.color import srgb_encode
from unips_jax.io.masks import mask_box

ERROR_LIMIT_DEG = 80.0
"""Error maps are clipped here, as in the seed paper's figures."""

COLOURS = "inferno"

_MAPS = {"inferno": cv2.COLORMAP_INFERNO, "viridis": cv2.COLORMAP_VIRIDIS}


def colours_of(share: np.ndarray, name: str = COLOURS) -> np.ndarray:
    """Values in [0, 1] as RGB in [0, 1], of "inferno" or "viridis" (by OpenCV)."""
    levels = np.arange(256, dtype=np.uint8)[:, None]
    table = cv2.applyColorMap(levels, _MAPS[name])[:, 0, ::-1] / 255
    return table[np.clip(np.asarray(share) * 256, 0, 255).astype(np.uint8)]


def normals_picture(normals: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(n + 1) / 2 as RGB: `[H, W, 3]`, uint8; white outside the mask."""
    finite = np.nan_to_num(normals, nan=0, posinf=0, neginf=0)
    return _on_white(np.clip((finite + 1) / 2, 0, 1), mask)


def error_picture(errors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Errors `[H, W]` from black (0) to bright yellow (80 degrees and more), uint8."""
    return _on_white(colours_of(errors / ERROR_LIMIT_DEG), mask)


def photograph_picture(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A linear image, exposed so that 1% of the object is white, as sRGB, uint8."""
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
