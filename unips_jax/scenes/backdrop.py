"""A table below the object and a wall behind it, for scenes without a mask.

Planes, met by the camera's rays in closed form; cloth sways their normals a little.
The object throws shadows on them, and they hide what is behind them from the object.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from unips_jax.scenes.draws import Draws
from unips_jax.scenes.noise import Point, dot, normalize

_FAR = 1e4  # beyond any light


class Backdrop(NamedTuple):
    """A table and a wall."""

    present: Array  # whether the scene has them; all below is for those that do
    normals: Array  # `[2, 3]`, unit, towards the object
    offsets: Array  # `[2]`, how far behind the origin; `_FAR` where absent
    waves: Array  # `[2, 3]`, of the cloth's normals: cycles per unit in the world
    slopes: Array  # `[2]`, their amplitude


class Ground(NamedTuple):
    """What of a backdrop is seen, flat `[P]`."""

    seen: Array  # where it is in front
    point: Point  # in the world
    normal: Point  # unit, towards the viewer's side


def draw_backdrop(draws: Draws, rate: float, possible: Array) -> Backdrop:
    """Draws a wall that faces the viewer, and mostly a table before it, if possible."""
    present = draws.chance(rate) & possible
    table = draws.chance(0.65)
    # The table is seen from 15 to 75 degrees above it; 0 would be edge on.
    elevation = draws.uniform(0.26, 1.3)
    lean = draws.uniform(-0.12, 0.12)
    tilt = draws.uniform(-0.25, 0.25, 2)
    up = (lean, jnp.cos(elevation), jnp.sin(elevation))
    ahead = (tilt[0], tilt[1], jnp.ones(()))
    normals = jnp.stack([jnp.stack(normalize(n)) for n in (up, ahead)])
    below, behind = draws.uniform(0.45, 0.95), draws.uniform(0.3, 1.0)
    further = draws.uniform(0.9, 2.0)
    offsets = jnp.stack(
        [jnp.where(table, below, _FAR), jnp.where(table, further, behind)]
    )
    direction = draws.direction(2)
    cycles = draws.log_uniform(0.4, 3.0, 2)
    cloth = draws.chance(0.35, 2) * draws.uniform(0.0, 0.35, 2)
    return Backdrop(
        present=present,
        normals=normals,
        offsets=jnp.where(present, offsets, _FAR),
        waves=direction * cycles[:, None],
        slopes=cloth,
    )


def widen_window(draws: Draws, backdrop: Backdrop, window: Array) -> Array:
    """Shows more than the object, off centre; `draws` has at least 3 numbers."""
    zoom = draws.uniform(1.1, 2.2)
    shift = draws.uniform(-0.5, 0.5, 2) * (zoom - 1) * window[2]
    wide = jnp.concatenate([window[:2] + shift, window[2:] * zoom])
    return jnp.where(backdrop.present, wide, window)


def meet(
    backdrop: Backdrop, rays: tuple[Point, Point], mask: Array, point: Point
) -> Ground:
    """Where rays `[P]` (origins, directions) meet the backdrop before the object."""
    origin, direction = rays
    way = tuple(p - o for p, o in zip(point, origin, strict=True))
    nearest = jnp.where(mask, dot(way, direction), jnp.inf)
    seen = jnp.zeros_like(mask)
    normal: Point = tuple(jnp.zeros_like(c) for c in point)
    place = point
    for plane in range(2):
        n = tuple(backdrop.normals[plane])
        facing = dot(n, direction)
        t = -(dot(n, origin) + backdrop.offsets[plane]) / jnp.minimum(facing, -1e-3)
        met = backdrop.present & (facing < -0.02) & (t > 0) & (t < nearest)
        here: Point = tuple(o + t * d for o, d in zip(origin, direction, strict=True))
        swayed = _facing(_sway(backdrop, plane, here), direction)
        place = tuple(jnp.where(met, a, b) for a, b in zip(here, place, strict=True))
        normal = tuple(
            jnp.where(met, a, b) for a, b in zip(swayed, normal, strict=True)
        )
        nearest = jnp.where(met, t, nearest)
        seen = seen | met
    return Ground(seen, place, normal)


def _sway(backdrop: Backdrop, plane: int, point: Point) -> Point:
    wave, n = backdrop.waves[plane], backdrop.normals[plane]
    phase = 2 * math.pi * dot(tuple(wave), point)
    along = wave - jnp.dot(wave, n) * n
    along = along / jnp.maximum(jnp.linalg.norm(along), 1e-3)
    height = backdrop.slopes[plane] * jnp.cos(phase)
    return normalize(tuple(n[i] + height * along[i] for i in range(3)))


def _facing(normal: Point, direction: Point) -> Point:
    """Normals turned until the viewer sees their front."""
    lack = jnp.maximum(0.05 + dot(normal, direction), 0.0)
    return normalize(
        tuple(n - lack * d for n, d in zip(normal, direction, strict=True))
    )


def above(backdrop: Backdrop, vectors: Array) -> Array:
    """Mirrors directions or positions `[N, 3]` that lie behind a plane."""
    for plane in range(2):
        used = backdrop.present & (backdrop.offsets[plane] < _FAR)
        normal = backdrop.normals[plane]
        behind = jnp.minimum(vectors @ normal, 0.0)
        vectors = vectors - 2 * used * behind[:, None] * normal
    return vectors


def ray_clearance(
    backdrop: Backdrop, origin: Point, direction: Point, reach: Array
) -> Array:
    """As `tracing.clearance`: -0.5 where a ray meets a plane before `reach`, else 1."""
    clear = jnp.ones_like(origin[0])
    for plane in range(2):
        n = tuple(backdrop.normals[plane])
        height = dot(n, origin) + backdrop.offsets[plane]
        falling = jnp.maximum(-dot(n, direction), 0.0)
        clear = jnp.where(height < falling * reach, -0.5, clear)
    return clear


def open_sky(backdrop: Backdrop, directions: Array) -> Array:
    """How much of each direction's surroundings no plane hides, `[D]` in [0, 1]."""
    sharpness = math.sqrt(directions.shape[0] / 1.8)
    cosine = directions @ backdrop.normals.T  # [D, 2]
    free = jnp.clip(0.5 + sharpness * cosine, 0.0, 1.0)
    return jnp.prod(jnp.where(backdrop.offsets < _FAR, free, 1.0), axis=1)
