"""Meshes by others among the shapes, as grids of signed distances.

`tools/fetch_assets.py DIR --shapes` makes the file from packages whose meshes are free;
it does not ship. A grid is a cube from -1 to 1 around the unit sphere, x first.
"""

import functools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.errors import InputError
from unips_jax.scenes.config import SceneConfig
from unips_jax.scenes.noise import Point, dot


@functools.cache
def _read(path: str) -> np.ndarray:
    try:
        with open(path, "rb") as file, np.load(file) as arrays:
            grids = arrays["distance"]
    except Exception as error:  # damaged archives raise what they like
        raise InputError(
            f"mesh_file {path!r}: expected a file by `python tools/fetch_assets.py DIR "
            f"--shapes` ({error})"
        ) from None
    if grids.ndim != 4 or len(set(grids.shape[1:])) != 1:
        raise InputError(
            f"mesh_file {path!r}: expected [M, G, G, G] distances, got {grids.shape}"
        )
    return grids


def load_meshes(config: SceneConfig) -> np.ndarray | None:
    """The grids `[M, G, G, G]` that a configuration wants, float16."""
    # They are arguments of what renders: constants of their size compile slowly.
    return _read(str(Path(config.mesh_file))) if config.mesh_rate else None


def cell_of(grid: Any) -> float:
    """The side of a grid's cells."""
    return 2 / (grid.shape[-1] - 1)


def grid_distance(grid: Array, point: Point) -> Array:
    """Signed distance between the nodes of a grid, linear; beyond the cube it grows."""
    size, flat = grid.shape[-1], grid.reshape(-1)
    inside = tuple(jnp.clip(c, -1.0, 1.0) for c in point)
    away = tuple(c - i for c, i in zip(point, inside, strict=True))
    places = [(c + 1) / cell_of(grid) for c in inside]
    first = [jnp.clip(p.astype(jnp.int32), 0, size - 2) for p in places]
    x, y, z = (p - f for p, f in zip(places, first, strict=True))
    corner = (first[0] * size + first[1]) * size + first[2]

    def edge(offset: int) -> Array:
        low, high = (
            flat.at[corner + offset + step].get(mode="promise_in_bounds")
            for step in (0, 1)
        )
        low = low.astype(jnp.float32)
        return low + z * (high.astype(jnp.float32) - low)

    near, far = (
        edge(step) + y * (edge(step + size) - edge(step)) for step in (0, size * size)
    )
    return near + x * (far - near) + jnp.sqrt(dot(away, away))
