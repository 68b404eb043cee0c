"""Polynomial texture maps: a picture whose light is moved by a mouse.

Each pixel's red, green and blue are biquadratic polynomials of the light direction's x
and y. They are fitted to the photographs and their estimated directions: RTI without a
sphere. Photographs are first brought to the same light by the estimated irradiance, and
to display values (sRGB), since viewers show what the polynomial gives.

Source: Malzbender, Gelb, Wolters, "Polynomial texture maps" (SIGGRAPH 2001); Malzbender
and Gelb, "Polynomial Texture Map (.ptm) file format", version 1.2 (HP Laboratories,
2001): text header, then for red, green and blue a block of six bytes a pixel, bottom
row first; coefficient = (byte - bias) * scale.
"""

from pathlib import Path

import numpy as np

from unips_jax.io.color import Transfer, as_linear, srgb_encode
from unips_jax.lighting.lights import Lights, irradiance, strips

_WHITE = 0.95  # what the brightest half a percent is brought to, linear
_RIDGE = 1e-3  # for photographs that are few, or whose lights are alike


def basis(directions: np.ndarray) -> np.ndarray:
    """The six terms at light directions: x^2, y^2, x y, x, y, 1; `[..., 6]`.

    Args:
        directions: `[..., 3]`, unit.
    """
    x, y = directions[..., 0], directions[..., 1]
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], -1)


def fit_matrix(directions: np.ndarray) -> np.ndarray:
    """What turns a pixel's N values to its six coefficients, `[6, N]`.

    Args:
        directions: `[N, 3]`, unit. Where they do not settle the polynomial, the terms
            of higher degree are small.
    """
    terms = basis(directions)
    pull = _RIDGE * len(terms) * np.diag([1, 1, 1, 0.1, 0.1, 1e-6])
    return np.linalg.solve(terms.T @ terms + pull, terms.T)


def equalised(
    images: np.ndarray, transfer: Transfer, lights: Lights, white: float
) -> np.ndarray:
    """Photographs as if their lights were equally bright and white: display values.

    Args:
        images: `[N, ..., 3]`, uint8, uint16 or float32.
        transfer: how values encode light.
        lights: their lights.
        white: linear value, so brought to the same light, that becomes 1.

    Returns:
        `[N, ..., 3]`, sRGB, in [0, 1].
    """
    gains = 1 / (facing(lights) * white)
    gains = gains.reshape(len(images), *[1] * (images.ndim - 2), 3)
    return srgb_encode(as_linear(images, transfer) * gains)


def facing(lights: Lights) -> np.ndarray:
    """Irradiance of each photograph's light on what faces it, `[N, 3]`, above 0."""
    count = len(lights.directions)
    every = irradiance(lights, lights.directions)  # [N, N, 3]
    return np.maximum(every[np.arange(count), np.arange(count)], 1e-3)


def write_ptm(
    path: Path,
    images: np.ndarray,
    mask: np.ndarray,
    lights: Lights,
    *,
    transfer: Transfer = "linear",
) -> dict[str, float]:
    """Fits a polynomial texture map and writes it, `PTM_FORMAT_RGB`.

    Memory beyond the photographs: 18 bytes a pixel.

    Args:
        path: where.
        images: `[N, H, W, 3]`, uint8, uint16 or float32.
        mask: `[H, W]`, bool; what is outside is black.
        lights: from `estimate_lights`.
        transfer: how values encode light.

    Returns:
        For the record: the white point, and how like the (equalised) photographs the
        map as it is written looks, PSNR in dB over the mask.
    """
    count, height, width, _ = images.shape
    matrix = fit_matrix(lights.directions)
    rows, columns = np.nonzero(mask)
    pick = np.random.default_rng(0).permutation(rows.size)[:20000]
    some = images[:, rows[pick], columns[pick]]
    linear = as_linear(some, transfer) / facing(lights)[:, None]
    white = max(float(np.quantile(linear, 0.995)) / _WHITE, 1e-12)
    sample = _coefficients(equalised(some, transfer, lights, white), matrix)
    scale, bias = _levels(sample)
    stored = np.zeros((3, height, width, 6), np.uint8)
    stored[:] = bias.astype(np.uint8)  # a polynomial of 0
    error, terms = 0.0, basis(lights.directions)
    for part in strips(images):
        inside = mask[part]
        values = equalised(images[:, part][:, inside], transfer, lights, white)
        levels = _coefficients(values, matrix) / scale + bias  # [P, 3, 6]
        levels = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        shown = ((levels - bias) * scale) @ terms.T / 255  # [P, 3, N]
        error += float(
            np.square(np.clip(shown, 0, 1) - values.transpose(1, 2, 0)).sum()
        )
        for color in range(3):
            stored[color, part][inside] = levels[:, color]
    header = (
        f"PTM_1.2\nPTM_FORMAT_RGB\n{width}\n{height}\n"
        f"{' '.join(f'{x:.8g}' for x in scale)}\n{' '.join(str(x) for x in bias)}\n"
    )
    with path.open("wb") as file:
        file.write(header.encode())
        for block in stored:
            file.write(np.ascontiguousarray(block[::-1]).tobytes())
    mean = error / max(rows.size * count * 3, 1)
    return {"white": white, "psnr_db": float(-10 * np.log10(max(mean, 1e-12)))}


def _coefficients(values: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Of display values `[N, P, 3]`: `[P, 3, 6]`, for values up to 255."""
    return np.einsum("kn,npc->pck", 255 * matrix, values)


def _levels(coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales and biases, `[6]`, for bytes that hold nearly all coefficients."""
    low, high = np.quantile(coefficients, [0.0005, 0.9995], axis=(0, 1))
    low, high = np.minimum(low, 0), np.maximum(high, 0)
    # As the header says them.
    scale = np.array([float(f"{x:.8g}") for x in np.maximum(high - low, 1e-3) / 255])
    return scale, np.rint(-low / scale).astype(int)
