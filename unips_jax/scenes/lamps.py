"""A key light per image (a lamp, near or far, or the sun), and its surroundings."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from unips_jax.scenes.config import LIGHT_KINDS, SceneConfig
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.noise import Point, dot
from unips_jax.scenes.surroundings import (
    Environment,
    draw_environment,
    draw_photograph,
    warmth,
    with_sun,
)

# Steps by which any number of points fill a square evenly (Roberts, 2018: R2).
_SPREAD = 0.7548776662, 0.5698402910
_DIRECTIONAL, _ENVIRONMENT, _MIXED, _POINT, _AREA = range(len(LIGHT_KINDS))


class KeyLights(NamedTuple):
    """One light per image."""

    vector: Array  # `[N, 3]`, unit direction towards the light, or its position
    near: Array  # `[N]`, 1 where `vector` is a position
    radius: Array  # `[N]`, angular radius in radians, or radius where near
    # `[N, 3]`, irradiance on a surface that faces the light; near lights: at distance 1
    # from it
    color: Array


class Sides(NamedTuple):
    """From where all of a scene's images are lit."""

    one: Array  # whether from one side only
    corner: Array  # whether from one quadrant only
    axes: Array  # `[2, 3]`, to the middle of the side in the image plane, and across it
    turn: Array  # how far environments turn between images, as a share of a whole turn


def _key_directions(draws: Draws, num_images: int) -> Array:
    """Directions over a cap around the viewer whose width varies by scene.

    As of a lamp that is moved about, or of a rig: in half of the scenes they are spread
    evenly, so that their mean is nearly the view axis.
    """
    lowest = jnp.cos(draws.uniform(0.4, 1.65))
    even = draws.chance(0.5)
    start, places = draws.unit(2), draws.unit(num_images, 2)
    steps = jnp.arange(num_images)[:, None] * jnp.asarray(_SPREAD)
    places = jnp.where(even, (start + steps) % 1.0, places)
    z = 1 - (1 - lowest) * places[:, 0]
    angle = 2 * math.pi * places[:, 1]
    ring = jnp.sqrt(1 - z * z)
    return jnp.stack([ring * jnp.cos(angle), ring * jnp.sin(angle), z], -1)


def draw_sides(draws: Draws, config: SceneConfig) -> Sides:
    """Draws from where a scene is lit; `draws` has at least 4 numbers."""
    one = draws.chance(config.side_rate)
    angle = draws.uniform(0.0, 2 * math.pi)
    cos, sin, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros(())
    return Sides(
        one=one,
        corner=one & draws.chance(0.4),
        axes=jnp.stack([jnp.stack([cos, sin, zero]), jnp.stack([-sin, cos, zero])]),
        turn=jnp.where(one, draws.uniform(0.1, 0.4), 1.0),
    )


def _to_side(sides: Sides, direction: Array) -> Array:
    """Mirrors directions `[N, 3]` that come from elsewhere."""
    for used, axis in zip((sides.one, sides.corner), sides.axes, strict=True):
        behind = jnp.minimum(direction @ axis, 0.0)
        direction = direction - 2 * used * behind[:, None] * axis
    return direction


def draw_lights(
    draws: Draws,
    kind: Array,
    num_images: int,
    sides: Sides | None = None,
    photographs: tuple[Draws, float] | None = None,
    far: Array | None = None,
) -> tuple[KeyLights, Environment]:
    """Draws one scene's lights; what its kind lacks has no brightness.

    From at least 110 + 20 N numbers; `sides` None: from anywhere; `photographs`: what
    draws photographed environments, 6 numbers, and their share; `far`: how far a near
    lamp stands, in radii, 0 for within 4; None: always so.
    """
    turn = 1.0 if sides is None else sides.turn
    environment = draw_environment(draws, num_images, turn)
    sun_seen = None
    if photographs is not None:
        environment, sun_seen = draw_photograph(
            photographs[0], environment, photographs[1]
        )
    direction = _key_directions(draws, num_images)
    if sides is not None:
        direction = _to_side(sides, direction)
    reach = draws.uniform(1.3, 3.0)
    if far is not None:
        reach = jnp.where(far > 0, far, reach)
    distance = reach * draws.uniform(0.8, 1.25, num_images)
    near = (kind == _POINT) | (kind == _AREA)
    area = kind == _AREA
    # The sun turns with its sky.
    high = draws.direction()
    high = high.at[1].set(jnp.abs(high[1]))
    high = jnp.einsum("nji,j->ni", environment.rotation, high)
    from_sky = kind == _ENVIRONMENT
    sun = draws.chance(0.5)
    direction = jnp.where(from_sky, high, direction)
    vector = jnp.where(near, direction * distance[:, None], direction)
    radius = jnp.where(area, draws.uniform(0.1, 0.6), 0.01)
    radius = jnp.where(from_sky, draws.log_uniform(0.01, 0.2), radius)
    brightness = jnp.exp(draws.uniform(-0.3, 0.3, num_images))
    brightness = brightness * jnp.where(near, distance**2, 1.0)
    key_share = jnp.where(from_sky, sun * draws.uniform(0.3, 2.0), 2.5)
    fill = draws.chance(0.5) * draws.log_uniform(0.02, 0.3)
    share = jnp.where(kind == _DIRECTIONAL, 0.0, jnp.where(near, fill, 1.0))
    # The lamp is 0.4 to 12 times as strong as the environment (nine tenths; median 2).
    share = jnp.where(kind == _MIXED, draws.log_uniform(0.3, 4.0), share)
    tint = warmth(draws, 0.4, num_images) * warmth(draws, 0.4)
    color = tint * (brightness * key_share)[:, None]
    if sun_seen is not None:
        # Where the key light is the sun it is the photograph's, with sharp shadows.
        apart = sun_seen.used & from_sky
        towards = jnp.einsum("nji,j->ni", environment.rotation, sun_seen.direction)
        vector = jnp.where(apart, towards, vector)
        color = jnp.where(apart, sun_seen.color * environment.scale[:, None], color)
        rest = sun_seen._replace(color=sun_seen.color * ~apart)
        environment = with_sun(environment, rest)
    ones = jnp.ones(num_images)
    keys = KeyLights(vector, near * ones, radius * ones, color)
    return keys, environment._replace(scale=environment.scale * share)


def key_light_at(
    vector: Array, near: Array, point: Point
) -> tuple[Point, Array, Array]:
    """One key light at points: unit direction, distance and factor on its colour."""
    offset = tuple(vector[i] - near * point[i] for i in range(3))
    squared = jnp.maximum(dot(offset, offset), 1e-4)
    inverse = 1 / jnp.sqrt(squared)
    direction = tuple(c * inverse for c in offset)
    reach = jnp.where(near > 0, squared * inverse, 1e3)
    attenuation = jnp.where(near > 0, 1 / squared, 1.0)
    return direction, reach, attenuation
