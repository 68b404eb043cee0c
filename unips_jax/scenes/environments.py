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

from unips_jax.lighting.environment import pixels_around, sphere
from unips_jax.scenes.noise import Point

BLURS = (0.06, 0.12, 0.25, 0.5, 1.0)
"""About the standard deviations of the lobes, in radians; each twice the one before."""

TABLE_SIZE = (32, 64)
"""Rows from the zenith down, columns around."""

FLUX = 3.0
"""Radiance of an environment and its sun, integrated over the sphere."""


class Tables(NamedTuple):
    """E environments."""

    # `[E, L, *TABLE_SIZE, 3]`, a level for each of `BLURS`, without suns
    radiance: np.ndarray
    sun_directions: np.ndarray  # `[E, 3]`, unit, y up
    # `[E, 3]`, irradiance on what faces it; zero where there is none
    sun_colors: np.ndarray


class Photograph(NamedTuple):
    """Which environment surrounds a scene, and how it was changed."""

    number: Array
    share: Array  # how much of it there is; the rest is drawn
    mirror: Array  # 1, or -1 where left and right are swapped
    tint: Array  # `[3]`, factors of its colours


@functools.cache
def load_tables() -> Tables:
    """The file that ships."""
    path = resources.files("unips_jax") / "assets" / "environments.npz"
    with path.open("rb") as file, np.load(file) as arrays:
        return Tables(
            arrays["radiance"].astype(np.float32),
            arrays["sun_directions"],
            arrays["sun_colors"],
        )


def directions_of(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions `[height, width, 3]` of a table's pixels, and their solid angles."""
    # A quarter turn from `lighting.environment.sphere`: seeds had it before.
    towards, solid = map(np.asarray, sphere(height, width))
    return towards[..., [2, 1, 0]] * np.array([1, 1, -1], np.float32), solid


def look_up(photograph: Photograph, direction: Point, blur: Array) -> list[Array]:
    """Radiance from unit directions in the environment's frame: red, green, blue.

    Bilinear in the level whose blur, about the lobe's standard deviation in radians, is
    nearest.
    """
    table = load_tables().radiance
    _, levels, height, width, _ = table.shape
    flat = jnp.asarray(table.reshape(-1, 3))
    x, y, z = direction
    level = jnp.round(jnp.log2(jnp.maximum(blur, 1e-3) / BLURS[0]))
    level = jnp.clip(level, 0, levels - 1).astype(jnp.int32)
    first = (photograph.number * levels + level) * (height * width)
    rows, columns, down, right = pixels_around(
        -z, y, x * photograph.mirror, height, width
    )
    total = jnp.zeros((1, 3))
    for row, by_row in zip(rows, (1 - down, down), strict=True):
        for column, share in zip(columns, (1 - right, right), strict=True):
            weight = by_row * share
            total = total + weight[..., None] * flat[row * width + first + column]
    return [total[..., c] * photograph.tint[c] for c in range(3)]
