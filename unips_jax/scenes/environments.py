"""Photographed environments, as tables of their radiance blurred to five degrees.

`tools/fetch_assets.py` makes the file from 16 environments by Poly Haven (CC0-1.0); it
ships, so that a seed means the same scene everywhere.
"""

import functools
from importlib import resources
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.scenes.noise import Point

BLURS = (0.06, 0.12, 0.25, 0.5, 1.0)
"""About the standard deviations of the lobes, in radians; each twice the one before."""

TABLE_SIZE = (32, 64)
"""Rows from the zenith down, columns around."""

FLUX = 3.0
"""Radiance of an environment and its sun, integrated over the sphere."""


class Tables(NamedTuple):
    """E environments.

    Attributes:
        radiance: `[E, L, *TABLE_SIZE, 3]`, a level for each of `BLURS`, without suns.
        sun_directions: `[E, 3]`, unit, y up.
        sun_colors: `[E, 3]`, irradiance on what faces it; zero where there is none.
    """

    radiance: np.ndarray
    sun_directions: np.ndarray
    sun_colors: np.ndarray


class Photograph(NamedTuple):
    """Which environment surrounds a scene, and how it was changed.

    Attributes:
        number: of the environment.
        share: how much of it there is; the rest is drawn.
        mirror: 1, or -1 where left and right are swapped.
        tint: `[3]`, factors of its colours.
    """

    number: Array
    share: Array
    mirror: Array
    tint: Array


@functools.cache
def load_tables() -> Tables:
    """Reads the file that ships."""
    path = resources.files("unips_jax") / "assets" / "environments.npz"
    with path.open("rb") as file, np.load(file) as arrays:
        return Tables(
            arrays["radiance"].astype(np.float32),
            arrays["sun_directions"],
            arrays["sun_colors"],
        )


def directions_of(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions of an equirectangular picture's pixels.

    Returns:
        Unit vectors, y up, `[height, width, 3]`, and solid angles, `[height, width]`.
    """
    down = (np.arange(height)[:, None] + 0.5) / height * np.pi
    around = (np.arange(width)[None] + 0.5) / width * 2 * np.pi
    x, z = np.sin(down) * np.cos(around), np.sin(down) * np.sin(around)
    y = np.broadcast_to(np.cos(down), x.shape)
    solid = np.sin(down) * (np.pi / height) * (2 * np.pi / width)
    return np.stack([x, y, z], -1), np.broadcast_to(solid, x.shape)


def look_up(photograph: Photograph, direction: Point, blur: Array) -> list[Array]:
    """Radiance from directions, red, green and blue.

    Bilinear in the level whose blur is nearest.

    Args:
        photograph: which one.
        direction: unit, in the environment's frame.
        blur: about the lobe's standard deviation, radians.
    """
    table = load_tables().radiance
    _, levels, height, width, _ = table.shape
    flat = jnp.asarray(table.reshape(-1, 3))
    x, y, z = direction
    level = jnp.round(jnp.log2(jnp.maximum(blur, 1e-3) / BLURS[0]))
    level = jnp.clip(level, 0, levels - 1).astype(jnp.int32)
    row = jnp.arccos(jnp.clip(y, -1.0, 1.0)) * (height / jnp.pi) - 0.5
    column = jnp.arctan2(z, x * photograph.mirror) * (width / (2 * jnp.pi)) - 0.5
    row = jnp.clip(row, 0.0, height - 1.0)
    top, left = jnp.floor(row), jnp.floor(column)
    down, right = row - top, column - left
    first = (photograph.number * levels + level) * (height * width)
    total: Array | float = 0.0
    for i, by_row in enumerate((1 - down, down)):
        place = jnp.minimum(top.astype(jnp.int32) + i, height - 1) * width + first
        for j, weight in enumerate((by_row * (1 - right), by_row * right)):
            at = place + (left.astype(jnp.int32) + j) % width
            total = total + weight[..., None] * flat[at]
    return [total[..., c] * photograph.tint[c] for c in range(3)]  # type: ignore[index]
