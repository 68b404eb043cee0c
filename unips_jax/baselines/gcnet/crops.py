"""What the networks of GCNet, LCNet and PS-FCN are shown: crops, scaled and resized."""

import functools
from typing import Literal, get_args

import jax
import numpy as np
from jax import Array

from unips_jax.checks import require_choice
from unips_jax.io.masks import mask_box

Norm = Literal["range01", "literal10", "none"]
Per = Literal["image", "stack"]

_PEAK = {"range01": 0.1, "literal10": 10.0}


def normalise(
    images: np.ndarray, mask: np.ndarray, *, norm: Norm, per: Per
) -> tuple[np.ndarray, np.ndarray]:
    """Scales images so that their maximum over the mask is where `norm` puts it.

    At 0.1 ("range01"), at 10 ("literal10"), or as it is ("none"); one maximum for each
    image, or one for the stack. Images that are black inside the mask are left as they
    are. Returns the images, and the factor of each, `[N]`.
    """
    require_choice("norm", norm, get_args(Norm))
    require_choice("per", per, get_args(Per))
    gain = np.ones(len(images), np.float32)
    if norm != "none":
        peaks = images[:, mask].max(axis=(1, 2)).astype(np.float32)
        if per == "stack":
            peaks = np.full_like(peaks, peaks.max())
        gain = np.where(peaks > 0, _PEAK[norm] / np.where(peaks > 0, peaks, 1), 1)
        gain = gain.astype(np.float32)
    return images * gain[:, None, None, None], gain


def box(mask: np.ndarray, margin: int | None) -> tuple[slice, slice]:
    """Rows and columns of the mask's box with a margin; None: the whole image."""
    if margin is None:
        return slice(0, mask.shape[0]), slice(0, mask.shape[1])
    return mask_box(mask, margin)


def masked(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Images `[N, H, W, 3]`, float32, black outside the mask `[H, W]`."""
    return np.where(mask[..., None], images, 0).astype(np.float32)


@functools.partial(jax.jit, static_argnames="side")
def resized(images: Array, mask: Array, side: int) -> tuple[Array, Array]:
    """Images `[N, H, W, 3]` and mask `[H, W]` at another size, half-pixel bilinear."""
    resize = functools.partial(jax.image.resize, method="linear", antialias=False)
    return (resize(images, (len(images), side, side, 3)), resize(mask, (side, side)))
