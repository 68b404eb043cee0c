"""Surroundings as equirectangular pictures, and how they light a surface.

Pictures are `[h, w, 3]`, linear radiance, in the frame of normals (x right, y up, z
towards the viewer): the top row is up, the middle column lies behind the object as the
camera sees it, and right of it is right. So the outer columns are behind the camera.

Glossy light is the radiance around the mirror direction, averaged over GGX's lobe as
seen from its own axis (Karis, "Real shading in Unreal Engine 4", SIGGRAPH 2013 course).
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.lighting.harmonics import BAND, COSINE_LOBE, harmonics

_SIZE = (32, 64)  # of what is blurred
_ROUGHNESS = 0.2  # of the sharpest blurred level; each level adds as much
_LEVELS = 5


@functools.cache
def _lobe_shares() -> tuple[np.ndarray, np.ndarray]:
    """What GGX's lobe leaves of each order of harmonics: roughness `[R]`, `[3, R]`."""
    roughness = np.linspace(0.05, 1, 20)
    angle = np.linspace(0, 1, 4000)[:, None] ** 3 * (np.pi / 2)  # dense at the axis
    cosine = np.cos(angle)
    n_h2, squared = 0.5 + 0.5 * cosine, roughness**4
    weight = cosine * np.sin(angle) / (n_h2 * (squared - 1) + 1) ** 2  # [angles, R]
    weight = weight * np.gradient(angle[:, 0])[:, None]
    shares = [
        (weight * legendre).sum(0) / weight.sum(0)
        for legendre in (np.ones_like(cosine), cosine, 1.5 * cosine**2 - 0.5)
    ]
    padded = np.pad(shares, ((0, 0), (1, 0)), constant_values=1)
    return np.append(0, roughness).astype(np.float32), padded.astype(np.float32)


class Blurred(NamedTuple):
    """An environment, and averages of it."""

    sharp: Array  # `[h, w, 3]`, as it was given
    # `[32, 64, 3]`, the mean over each hemisphere, weighted by the cosine
    diffuse: Array
    # `[5, 32, 64, 3]`, the mean over GGX's lobe for roughness 0.2, 0.4 ... 1.
    glossy: Array


def sphere(height: int, width: int) -> tuple[Array, Array]:
    """Unit vectors `[h, w, 3]` and steradians `[h, w]` of a picture's pixels."""
    rows, columns = (jnp.arange(n, dtype=jnp.float32) for n in (height, width))
    down = (rows + 0.5)[:, None] * (math.pi / height)
    around = ((columns + 0.5) / width - 0.5)[None] * (2 * math.pi)
    level = jnp.sin(down)
    x, z = level * jnp.sin(around), -level * jnp.cos(around)
    y = jnp.broadcast_to(jnp.cos(down), x.shape)
    solid = level * (math.pi / height) * (2 * math.pi / width)
    return jnp.stack([x, y, z], -1), jnp.broadcast_to(solid, x.shape)


def turned(environment: Array, degrees: Array | float) -> Array:
    """The environment turned about the vertical, counter-clockwise from above."""
    width = environment.shape[1]
    shift = jnp.asarray(degrees, jnp.float32) * (width / 360)
    whole = jnp.floor(shift).astype(jnp.int32)
    share = shift - whole
    columns = (jnp.arange(width) + whole) % width
    first, second = environment[:, columns], environment[:, (columns + 1) % width]
    return first + share * (second - first)


def blurred(environment: Array) -> Blurred:
    """What `glossy_light` reads, and `look_up` for diffuse light, of `[h, w, 3]`."""
    flat, solid = _smaller(environment)
    directions, _ = sphere(*_SIZE)
    # Else the compiler would work the tables out.
    directions = jax.lax.optimization_barrier(directions.reshape(-1, 3))
    cosine = directions @ directions.T
    weight = jnp.maximum(cosine, 0) * solid

    def mean(weight: Array) -> Array:
        total = jnp.sum(weight, -1, keepdims=True)
        return (weight @ flat / total).reshape(*_SIZE, 3)

    def lobe(roughness: Array) -> Array:
        squared = jnp.square(jnp.square(roughness))  # alpha's square
        n_h2 = 0.5 + 0.5 * cosine
        return mean(weight / jnp.square(n_h2 * (squared - 1) + 1))

    levels = _ROUGHNESS * jnp.arange(1, _LEVELS + 1, dtype=jnp.float32)
    return Blurred(environment, mean(weight), jax.lax.map(lobe, levels))


def _smaller(environment: Array) -> tuple[Array, Array]:
    """Radiance and steradians, `[2048, 3]` and `[2048]`, of 32 x 64 cells.

    No light is lost or gained: each pixel's is shared out between the cells around it,
    also behind the camera, where the picture's two ends meet.
    """
    height, width, _ = environment.shape
    rows, columns = _shares(height, _SIZE[0]), _shares(width, _SIZE[1], around=True)
    _, solid = sphere(height, width)

    def collected(values: Array) -> Array:
        cells = jnp.einsum("rh,hwk,cw->rck", rows, values, columns)
        return cells.reshape(-1, values.shape[2])

    cells = collected(solid[..., None])
    return collected(environment * solid[..., None]) / cells, cells[:, 0]


def _shares(pixels: int, cells: int, *, around: bool = False) -> np.ndarray:
    """Of each pixel's light those of the cells, `[cells, pixels]`; of a ring or not."""
    place = (np.arange(pixels) + 0.5) * (cells / pixels) - 0.5
    away = np.abs(place - np.arange(cells)[:, None])
    if around:
        away = np.minimum(away, cells - away)
    share = np.maximum(1 - away / max(1.0, cells / pixels), 0)
    return (share / share.sum(0)).astype(np.float32)


def look_up(table: Array, direction: Array) -> Array:
    """Reads a picture `[h, w, 3]` between its pixels, at unit directions `[..., 3]`."""
    height, width, _ = table.shape
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    rows, columns, down, right = pixels_around(x, y, z, height, width)
    above, below = (
        table[row, columns[0]] * (1 - right[..., None])
        + table[row, columns[1]] * right[..., None]
        for row in rows
    )
    return above * (1 - down[..., None]) + below * down[..., None]


def pixels_around(
    x: Array, y: Array, z: Array, height: int, width: int
) -> tuple[tuple[Array, Array], tuple[Array, Array], Array, Array]:
    """The pixels around unit directions: rows, columns, and the second ones' shares."""
    # At the poles and behind the camera derivatives of the angles are not finite.
    row = jnp.arccos(jnp.clip(y, -0.999999, 0.999999)) * (height / math.pi) - 0.5
    pole = x * x + z * z < 1e-12
    angle = jnp.arctan2(jnp.where(pole, 0.0, -x), jnp.where(pole, 1.0, z))
    column = angle * (width / (2 * math.pi)) - 0.5
    row = jnp.clip(row, 0.0, height - 1.0)
    top, left = jnp.floor(row), jnp.floor(column)
    first_row, first_column = top.astype(jnp.int32), left.astype(jnp.int32)
    rows = first_row, jnp.minimum(first_row + 1, height - 1)
    columns = first_column % width, (first_column + 1) % width
    return rows, columns, row - top, column - left


def glossy_light(environment: Blurred, mirror: Array, roughness: Array) -> Array:
    """Mean radiance `[..., 3]` over the lobes of rough mirrors, of unit directions."""
    place = jnp.clip(roughness / _ROUGHNESS, 0.0, _LEVELS)[..., None]
    total = look_up(environment.sharp, mirror) * jnp.maximum(1 - place, 0.0)
    for level in range(_LEVELS):
        share = jnp.maximum(1 - jnp.abs(place - (level + 1)), 0.0)
        total = total + look_up(environment.glossy[level], mirror) * share
    return total


def harmonic_light(
    coefficients: Array, normal: Array, mirror: Array, roughness: Array
) -> tuple[Array, Array]:
    """Diffuse and glossy light of spherical harmonics, below 0 where the series is.

    The mean over each hemisphere, weighted by the cosine, and that over the lobe around
    the mirror direction, `[..., 3]` each. `coefficients` `[1, 4 or 9, 3]` are of
    radiance, see `unips_jax.lighting.harmonics`; `normal` and `mirror` unit,
    `roughness` in [0, 1].
    """
    count = len(coefficients)
    band = BAND[:count]
    share = (COSINE_LOBE / math.pi)[band].astype(np.float32)
    diffuse = (harmonics(normal, jnp)[..., :count] * share) @ coefficients
    grid, shares = _lobe_shares()
    left = jnp.stack([jnp.interp(roughness, grid, row) for row in shares], -1)
    glossy = harmonics(mirror, jnp)[..., :count] * left[..., band]
    return diffuse, glossy @ coefficients
