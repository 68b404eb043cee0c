"""Lights, base colour and relightable pictures on disk.

lights.json       each photograph's light
lights.lp         directions, as RTI software reads them
relight.ptm       a polynomial texture map; info.json and plane_*.jpg for web pages
base_color.exr    linear, float32
base_color.png    16 bits, sRGB
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.io.color import Transfer, as_linear, in_srgb, srgb_encode
from unips_jax.io.door import write_json, write_whole
from unips_jax.io.formats.raster import marked_srgb
from unips_jax.io.images import encode_image, write_exr
from unips_jax.lighting.light_fit import (
    Lights,
    Scales,
    albedo_scales,
    irradiance,
    robust_albedo,
    strips,
)

# Kinds of light, and the least share of a lamp.
_KINDS = {"lamp": 0.75, "both": 0.25, "surroundings": 0.0}
_SAMPLE = 20000
_BRIGHT = 0.8  # base colour that the brightest percent is brought to

_CONVENTIONS = {
    "frame": "x right, y up, z towards the viewer",
    "direction": "unit, to the key light or, in surroundings, of all light's mean",
    "directness": "1 for a lamp, 0 for light equally from everywhere",
    "color": "irradiance of the key on what faces it, linear, relative to the "
    "photographs' mean of all light",
    "intensity": "mean of the color",
    "harmonics": "radiance of all light in the same unit, [9][red, green, blue]: real, "
    "orthonormal, in the order 1, y, z, x, xy, yz, 3z^2 - 1, xz, x^2 - y^2",
    "exif_orientation": "by which the photographs are turned, 1 as stored to 8",
}


def write_lights(
    folder: Path, names: Sequence[str], lights: Lights, *, orientation: int = 1
) -> None:
    """Writes `lights.json` and `lights.lp` into a folder that exists.

    `orientation` is EXIF's, 1 to 8, by which the photographs were turned.
    """
    photographs: list[dict[str, Any]] = [
        {
            "file": name,
            "direction": _rounded(lights.directions[index]),
            "directness": _rounded(lights.directness[index]),
            "color": _rounded(lights.colors[index]),
            "intensity": _rounded(lights.colors[index].mean()),
            "harmonics": _rounded(lights.harmonics[index]),
        }
        for index, name in enumerate(names)
    ]
    conventions = dict(_CONVENTIONS)
    content: dict[str, Any] = {
        "conventions": conventions,
        "exif_orientation": orientation,
        "photographs": photographs,
    }
    if lights.lamp_shares is not None:
        for photograph, share in zip(photographs, lights.lamp_shares, strict=True):
            photograph["kind"] = next(
                k for k, least in _KINDS.items() if share >= least
            )
            photograph["lamp_share"] = _rounded(share)
        conventions |= {
            "kind": "lamp, both or surroundings: a lamp gives three quarters of the "
            "light or more, one quarter or more, or less",
            "lamp_share": "of the power of all light, 0 to 1",
        }
    if lights.near is not None:
        content["lamp_distance"] = lights.near.distance
        conventions["lamp_distance"] = (
            "of near lamps from the photograph's middle, in its widths; directions and "
            "colors are those at the middle"
        )
    write_json(folder / "lights.json", content, indent=1)
    lines = [str(len(names))]
    for name, direction in zip(names, lights.directions, strict=True):
        # As a comment would begin.
        shown = f'"{name}"' if name.startswith(("#", "//")) else name
        lines.append(f"{shown} {' '.join(f'{x:.6f}' for x in direction)}")
    text = "\n".join(lines) + "\n"
    data = text.encode(errors="surrogateescape")
    write_whole(folder / "lights.lp", data, sync=False)


def write_base_color(folder: Path, color: np.ndarray) -> dict[str, Any]:
    """Writes `base_color.exr` and `.png`; returns what the record keeps."""
    comments = "base colour, linear, up to a factor; 0: no surface"
    write_exr(folder / "base_color.exr", {"RGB": color}, comments)
    encoded = np.rint(65535 * srgb_encode(color)).astype(np.uint16)
    # Without a tag 16 bits are taken as linear.
    picture = marked_srgb(encode_image(".png", encoded))
    write_whole(folder / "base_color.png", picture, sync=False)
    return {"scale": f"the brightest percent is {_BRIGHT}", "transfer": "png srgb"}


def base_color(
    images: np.ndarray,
    normals: np.ndarray,
    mask: np.ndarray,
    lights: Lights,
    *,
    transfer: Transfer = "linear",
    to_srgb: np.ndarray | None = None,
) -> np.ndarray:
    """The base colour of every pixel, `[H, W, 3]`, float32, in [0, 1].

    The albedo that explains the photographs best, for matt surfaces, shadows and
    highlights spared; up to one factor, and to the lights' common colour. `to_srgb`:
    see `Encoding`.
    """
    color = np.zeros((*mask.shape, 3), np.float32)
    mask = mask & (normals != 0).any(-1)
    rows, columns = np.nonzero(mask)
    pick = np.random.default_rng(0).permutation(rows.size)[:_SAMPLE]
    some = rows[pick], columns[pick]
    scales = albedo_scales(
        as_linear(images[:, *some], transfer), irradiance(lights, normals[some], some)
    )
    scales = Scales(*(values.astype(np.float32) for values in scales))
    for part in strips(images):
        inside = mask[part]
        if inside.any():
            pixels = as_linear(images[:, part][:, inside], transfer)
            place = np.nonzero(inside)
            place = place[0] + part.start, place[1]
            light = irradiance(lights, normals[place], place).astype(np.float32)
            color[part][inside] = robust_albedo(pixels, light, scales=scales)
    color = in_srgb(color, to_srgb)
    if mask.any():
        color *= _BRIGHT / max(float(np.quantile(color[mask].max(-1), 0.99)), 1e-12)
    return np.clip(color, 0, 1)


def _rounded(values: np.ndarray) -> Any:
    return np.round(np.asarray(values, float), 6).tolist()
