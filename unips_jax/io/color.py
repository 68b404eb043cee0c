"""How pixel values encode light: transfer functions, in NumPy."""

from typing import Literal

import numpy as np
from numpy.typing import DTypeLike

Transfer = Literal["linear", "srgb"]


def as_float(image: np.ndarray) -> np.ndarray:
    """An image's values in float32; integers are divided by their type's largest.

    Args:
        image: uint8, uint16 or float32, of any shape.
    """
    if image.dtype.kind == "u":
        return image.astype(np.float32) / np.iinfo(image.dtype).max
    return image.astype(np.float32, copy=False)


def usual_transfer(dtype: DTypeLike) -> Transfer:
    """How files of a type encode light: 8 bit sRGB, the rest linear.

    Cameras, phones and programs write 8 bit so; raw converters for measurement, data
    sets and renderers write 16 bit and float so.

    Args:
        dtype: of the stored pixels.
    """
    return "srgb" if np.dtype(dtype) == np.uint8 else "linear"


def as_linear(image: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Values of linear light, float32, in [0, 1] for integers.

    Args:
        image: uint8, uint16 or float32, of any shape.
        transfer: how its values encode light.
    """
    values = as_float(image)
    if transfer == "srgb":
        low = values / 12.92
        high = ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4
        values = np.where(values <= 0.04045, low, high).astype(np.float32)
    return values


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function (IEC 61966-2-1): linear to display values.

    Args:
        linear: values in [0, 1]; others are clipped.
    """
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
