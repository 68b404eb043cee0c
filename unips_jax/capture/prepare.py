"""What is done to photographs that were read, before anything looks at them."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from unips_jax.capture.advice import filled_holes, small_holes
from unips_jax.capture.masks import suggest_mask
from unips_jax.capture.motion import Motion, find_motion
from unips_jax.capture.registration import register
from unips_jax.errors import InputError
from unips_jax.io.color import as_linear, srgb_encode
from unips_jax.io.images import ImageFile, require_finite
from unips_jax.io.orientation import as_oriented
from unips_jax.io.photographs import Capture


def with_suggested_mask(capture: Capture) -> Capture:
    """The same photographs, with the object's mask where it can be found.

    `mask_contrast` becomes the figure; below `masks.TRUSTED` the mask is as it was.
    """
    guess = suggest_mask(capture.images, transfer=capture.transfer)
    if guess.mask is None:
        return dataclasses.replace(capture, mask_contrast=guess.figure)
    mask = guess.mask & capture.mask
    if not mask.any():
        return dataclasses.replace(capture, mask_contrast=0.0)
    # Black specks on an object are a part of it, and so is what looks like it.
    mask |= guess.mask & small_holes(mask)
    mask |= filled_holes(mask, capture.images)[0]
    if capture.opaque is not None:
        mask &= capture.opaque
    # What was left out of the whole image lies around the object: no news.
    notes = tuple(note for note in capture.notes if not note.endswith(": left out"))
    return dataclasses.replace(
        capture,
        mask=mask,
        mask_contrast=guess.figure,
        mask_rule=guess.rule,
        notes=notes,
    )


def without_ambient(capture: Capture, dark: ImageFile, names: Sequence[str]) -> Capture:
    """The same photographs without the light of a dark frame, taken without the lamp.

    Integers become uint16, so that dark parts keep their levels. `InputError` if the
    dark frame is of another kind, or brighter than a photograph.
    """
    images = capture.images
    dark = as_oriented(dark, capture.exif_orientation)  # the camera stood still
    encoding = capture.encoding or dark.encoding
    if encoding.rule != "--transfer" and not dark.encoding.agrees(encoding):
        raise InputError(
            f"{dark.path}: expected {encoding.transfer} values as the photographs "
            f"({encoding.rule}), got {dark.encoding.transfer} ones "
            f"({dark.encoding.rule}); export it as the others, or give --transfer"
        )
    pixels = encoding.values(dark.pixels)
    if pixels.shape[:2] != images.shape[1:3] or pixels.dtype != images.dtype:
        raise InputError(
            f"{dark.path}: expected a dark frame as the photographs, "
            f"{list(images.shape[1:3])} of {images.dtype}, got "
            f"{list(pixels.shape[:2])} of {pixels.dtype}; take it as the others"
        )
    require_finite(dark.path, pixels[capture.mask])
    ambient = np.maximum(np.nan_to_num(as_linear(pixels, capture.transfer)), 0)
    wide = np.float32 if images.dtype == np.float32 else np.uint16
    result = np.empty(images.shape, wide)
    for index, image in enumerate(images):
        light = np.maximum(as_linear(image, capture.transfer) - ambient, 0)
        if not light[capture.mask].any():
            raise InputError(
                f"{dark.path}: expected less light than in {names[index]}, got more "
                "everywhere; give the frame that was taken without the lamp"
            )
        if capture.transfer == "srgb":
            light = srgb_encode(light)
        if wide is np.uint16:
            light = np.rint(np.clip(light, 0, 1) * 65535)
        result[index] = light
    return dataclasses.replace(capture, images=result)


def in_place(capture: Capture) -> tuple[Capture, Motion]:
    """The photographs with those that moved brought back; and how they had moved.

    Where not all of them have content, nothing is inside the mask any more. The same
    capture, if none moved or nothing would be left inside.
    """
    mask = None if capture.mask.all() else capture.mask
    motion = find_motion(capture.images, mask)
    images, valid, maps = register(capture.images, motion)
    height, width = capture.mask.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2, 1])
    offsets = maps @ middle - middle[:2]  # turned or not
    motion = dataclasses.replace(motion, offsets=offsets)
    inside = capture.mask & valid
    if not offsets.any() or not inside.any():
        return capture, motion
    return dataclasses.replace(capture, images=images, mask=inside), motion


def still(motion: Motion) -> Motion:
    """As after `in_place`: nothing moves any more."""
    return dataclasses.replace(motion, offsets=np.zeros_like(motion.offsets))
