"""What is done to photographs that were read, before anything looks at them."""

import dataclasses

import numpy as np

from unips_jax.capture.masks import suggest_mask
from unips_jax.capture.motion import Motion, find_motion
from unips_jax.capture.registration import register
from unips_jax.io.photographs import Capture


def with_suggested_mask(capture: Capture) -> Capture:
    """The same photographs, with the object's mask where it can be told.

    Args:
        capture: photographs without a mask file.

    Returns:
        `mask_contrast` is the figure; below `masks.TRUSTED` the mask is as it was.
    """
    mask, figure = suggest_mask(capture.images, transfer=capture.transfer)
    if mask is None:
        return dataclasses.replace(capture, mask_contrast=figure)
    mask &= capture.mask
    if not mask.any():
        return dataclasses.replace(capture, mask_contrast=0.0)
    # What was left out of the whole image lies around the object: no news.
    return dataclasses.replace(capture, mask=mask, mask_contrast=figure, notes=())


def in_place(capture: Capture) -> tuple[Capture, Motion]:
    """The same photographs, those that moved brought back to the others' place.

    Args:
        capture: the photographs. Where not all of them have content, nothing is
            inside the mask any more.

    Returns:
        The photographs, and how they had moved.
    """
    mask = None if capture.mask.all() else capture.mask
    motion = find_motion(capture.images, mask)
    images, valid, maps = register(capture.images, motion)
    offsets = maps[:, :, 2].copy()
    motion = dataclasses.replace(motion, offsets=offsets)
    inside = capture.mask & valid
    if not offsets.any() or not inside.any():
        return capture, motion
    return dataclasses.replace(capture, images=images, mask=inside), motion


def still(motion: Motion) -> Motion:
    """As after `in_place`: nothing moves any more."""
    return dataclasses.replace(motion, offsets=np.zeros_like(motion.offsets))
