"""Pictures that the page shows, and the mask that is drawn on one."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, as_linear, srgb_encode
from unips_jax.io.door import new_file
from unips_jax.io.images import read_image_file
from unips_jax.pictures.maps import shrink

_THUMBNAIL, PICTURE = 240, 1024


def thumbnail(image: np.ndarray, transfer: Transfer) -> np.ndarray:
    """A small photograph, uint8."""
    step = max(1, max(image.shape[:2]) // (4 * _THUMBNAIL))  # little is converted
    image = np.nan_to_num(image[::step, ::step], posinf=0, neginf=0)
    linear = shrink(as_linear(image, transfer), _THUMBNAIL)
    if transfer == "linear":
        linear = linear / (float(np.percentile(linear, 99.5)) or 1.0)
    return np.rint(255 * srgb_encode(np.clip(linear, 0, 1))).astype(np.uint8)


def write_preview(path: Path, normals: np.ndarray) -> None:
    """Coarse normals as a picture, transparent outside the object."""
    inside = 255 * normals.any(axis=-1, keepdims=True)
    colors = np.rint(127.5 * (normals + 1))
    picture = np.concatenate([colors, inside], axis=-1).astype(np.uint8)
    with new_file(path) as file:
        Image.fromarray(picture).save(file, format="png")


def drawn_mask(drawn: Path, shape: tuple[int, ...]) -> np.ndarray:
    """What was drawn, in a photograph's size: bool."""
    values = read_image_file(drawn, max_pixels=PICTURE**2).pixels.max(axis=-1)
    return cv2.resize(values.astype(np.float32), shape[1::-1]) > 127


def full_mask(drawn: Path, photograph: Path, max_pixels: int) -> np.ndarray:
    """What was drawn, at least a pixel, in the size of a photograph's file: bool."""
    shape = read_image_file(photograph, max_pixels=max_pixels).pixels.shape
    mask = drawn_mask(drawn, shape)
    if not mask.any():
        raise InputError("the mask is empty: draw over the object, or take it all")
    return mask
