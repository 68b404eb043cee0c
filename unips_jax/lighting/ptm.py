"""Polynomial texture maps: a picture whose light is moved by a mouse.

Each pixel's red, green and blue are biquadratic polynomials of the light direction's x
and y. They are fitted to the photographs and their estimated directions: RTI without a
sphere. Photographs are first brought to the same light by the estimated irradiance, and
to display values (sRGB), since viewers show what the polynomial gives.

Written as one file, `.ptm`, and as pictures for web pages, as Relight writes and
OpenLIME shows them.

Sources: Malzbender, Gelb, Wolters, "Polynomial texture maps" (SIGGRAPH 2001);
Malzbender and Gelb, "Polynomial Texture Map (.ptm) file format", version 1.2 (HP
Laboratories, 2001): text header, then for red, green and blue a block of six bytes a
pixel, bottom row first; coefficient = (byte - bias) * scale. Ponchio, Corsini,
Scopigno, "A compact representation of relightable images for the web" (Web3D 2018), and
the files that Relight writes: `info.json` and JPEGs, one for each coefficient, whose
three colours are those of the picture; coefficient = (level - bias) * scale, levels and
values from 0 to 1, in the order 1, x, y, x^2, x y, y^2.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import simplejpeg

from unips_jax.io.color import Transfer, as_linear, in_srgb, srgb_encode
from unips_jax.io.door import new_file, write_json, write_whole
from unips_jax.lighting.light_fit import Lights, irradiance, strips
from unips_jax.lighting.near import falloffs

_WHITE = 0.95  # what the brightest half a percent is brought to, linear
_RIDGE = 1e-3  # for photographs that are few, or whose lights are alike
_PLANES = (5, 3, 4, 0, 2, 1)  # Relight's terms among ours
_JPEG_QUALITY = 95


def basis(directions: np.ndarray) -> np.ndarray:
    """The six terms at unit directions: x^2, y^2, x y, x, y, 1; `[..., 6]`."""
    x, y = directions[..., 0], directions[..., 1]
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], -1)


def fit_matrix(directions: np.ndarray) -> np.ndarray:
    """What turns a pixel's N values to its six coefficients, `[6, N]`."""
    # Where directions do not settle the polynomial, terms of higher degree are small.
    terms = basis(directions)
    pull = _RIDGE * len(terms) * np.diag([1, 1, 1, 0.1, 0.1, 1e-6])
    return np.linalg.solve(terms.T @ terms + pull, terms.T)


def equalised(
    images: np.ndarray,
    transfer: Transfer,
    lights: Lights,
    white: float,
    index: Any = ...,
    to_srgb: np.ndarray | None = None,
) -> np.ndarray:
    """Photographs `[N, ..., 3]` as if their lights were equally bright and white.

    sRGB, in [0, 1]; `white` is the linear value, so brought to the same light, that
    becomes 1. `index` has taken the pixels from whole images, where lamps that are near
    are not equally bright.
    """
    linear = _evenly_lit(images, transfer, lights, index)
    return srgb_encode(in_srgb(linear, to_srgb) / white)


def _evenly_lit(
    images: np.ndarray, transfer: Transfer, lights: Lights, index: Any
) -> np.ndarray:
    strength = facing(lights).reshape(len(images), *[1] * (images.ndim - 2), 3)
    near = lights.near
    if near is not None:
        places = near.places[index]
        falloff = falloffs(lights.directions, near.distance, places)
        strength = strength * falloff[..., None].astype(np.float32)
    return as_linear(images, transfer) / strength


def facing(lights: Lights) -> np.ndarray:
    """Irradiance of each photograph's light on what faces it, `[N, 3]`, above 0."""
    count = len(lights.directions)
    every = irradiance(lights, lights.directions)  # [N, N, 3]
    return np.maximum(every[np.arange(count), np.arange(count)], 1e-3)


class TextureMap(NamedTuple):
    """A fit to photographs; its coefficients are computed as they are written."""

    images: np.ndarray  # `[N, H, W, 3]`, uint8, uint16 or float32
    mask: np.ndarray  # `[H, W]`, bool; what is outside is black
    lights: Lights
    transfer: Transfer
    white: float  # linear value, in even light, that is shown as 1
    matrix: np.ndarray  # see `fit_matrix`
    sample: np.ndarray  # `[P, 3, 6]`, coefficients of some pixels
    to_srgb: np.ndarray | None = None  # see `Encoding`

    def strips(self) -> Iterator[tuple[slice, np.ndarray, np.ndarray, np.ndarray]]:
        """Yields some rows, their mask, coefficients and the photographs' values."""
        for part in strips(self.images):
            inside = self.mask[part]
            rows, columns = np.nonzero(inside)
            values = equalised(
                self.images[:, part][:, inside],
                self.transfer,
                self.lights,
                self.white,
                (rows + part.start, columns),
                self.to_srgb,
            )
            yield part, inside, _coefficients(values, self.matrix), values

    def levels(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest of nearly all coefficients, and 0, `[3, 6]`."""
        low, high = np.quantile(self.sample, [0.0005, 0.9995], axis=0)
        return np.minimum(low, 0), np.maximum(high, 0)


def fit_texture_map(
    images: np.ndarray,
    mask: np.ndarray,
    lights: Lights,
    *,
    transfer: Transfer = "linear",
    to_srgb: np.ndarray | None = None,
) -> TextureMap:
    """Fits a polynomial texture map; `lights` come from `estimate_lights`."""
    rows, columns = np.nonzero(mask)
    pick = np.random.default_rng(0).permutation(rows.size)[:20000]
    index = rows[pick], columns[pick]
    some = images[:, *index]
    linear = in_srgb(_evenly_lit(some, transfer, lights, index), to_srgb)
    white = max(float(np.quantile(linear, 0.995)) / _WHITE, 1e-12)
    matrix = fit_matrix(lights.directions)
    values = equalised(some, transfer, lights, white, index, to_srgb)
    sample = _coefficients(values, matrix)
    return TextureMap(images, mask, lights, transfer, white, matrix, sample, to_srgb)


def write_ptm(path: Path, fit: TextureMap) -> dict[str, float]:
    """Writes a texture map as `PTM_FORMAT_RGB`.

    Memory beyond the photographs: 18 bytes a pixel. Returns, for the record, the white
    point, and how like the (equalised) photographs the map as it is written looks, PSNR
    in dB over the mask.
    """
    height, width = fit.mask.shape
    low, high = fit.levels()
    low, high = low.min(0) * 255, high.max(0) * 255
    # As the header holds them.
    scale = np.array([float(f"{x:.8g}") for x in np.maximum(high - low, 1e-3) / 255])
    bias = np.rint(-low / scale).astype(int)
    stored = np.zeros((3, height, width, 6), np.uint8)
    stored[:] = bias.astype(np.uint8)  # a polynomial of 0
    error, count, terms = 0.0, 0, basis(fit.lights.directions)
    for part, inside, coefficients, values in fit.strips():
        levels = _bytes(coefficients * 255 / scale + bias)  # [P, 3, 6]
        shown = ((levels - bias) * scale) @ terms.T / 255  # [P, 3, N]
        error += float(
            np.square(np.clip(shown, 0, 1) - values.transpose(1, 2, 0)).sum()
        )
        count += values.size
        for color in range(3):
            stored[color, part][inside] = levels[:, color]
    header = (
        f"PTM_1.2\nPTM_FORMAT_RGB\n{width}\n{height}\n"
        f"{' '.join(f'{x:.8g}' for x in scale)}\n{' '.join(str(x) for x in bias)}\n"
    )
    with new_file(path) as file:
        file.write(header.encode())
        for block in stored:
            file.write(np.ascontiguousarray(block[::-1]).tobytes())
    mean = error / max(count, 1)
    return {"white": fit.white, "psnr_db": float(-10 * np.log10(max(mean, 1e-12)))}


def write_planes(folder: Path, fit: TextureMap) -> None:
    """Writes a texture map as Relight does: `info.json`, `plane_0.jpg` to `_5.jpg`."""
    height, width = fit.mask.shape
    low, high = (ends[:, _PLANES].T for ends in fit.levels())  # [6, 3]
    scale = np.maximum(high - low, 1e-5)
    bias = -low / scale
    planes = np.empty((6, height, width, 3), np.uint8)
    planes[:] = _bytes(255 * bias)[:, None, None]  # a polynomial of 0
    for part, inside, coefficients, _ in fit.strips():
        ordered = coefficients[..., _PLANES].transpose(2, 0, 1)  # [6, P, 3]
        planes[:, part][:, inside] = _bytes(
            255 * (ordered / scale[:, None] + bias[:, None])
        )
    for index, plane in enumerate(planes):
        # A colour is a coefficient's: none has fewer pixels.
        data = simplejpeg.encode_jpeg(
            plane, quality=_JPEG_QUALITY, colorspace="RGB", colorsubsampling="444"
        )
        write_whole(folder / f"plane_{index}.jpg", data, sync=False)
    info = {
        "width": width,
        "height": height,
        "format": "jpg",
        "type": "ptm",
        "colorspace": "rgb",
        "lights": np.round(fit.lights.directions, 4).ravel().tolist(),
        "nplanes": 18,
        "quality": _JPEG_QUALITY,
        "materials": [{"scale": scale.ravel().tolist(), "bias": bias.ravel().tolist()}],
    }
    write_json(folder / "info.json", info)


def _coefficients(values: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Of display values `[N, P, 3]`: `[P, 3, 6]`."""
    return np.einsum("kn,npc->pck", matrix, values)


def _bytes(levels: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)
