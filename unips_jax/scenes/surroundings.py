"""Distant surroundings: drawn or photographed, turned anew for every image.

Drawn ones are a sky gradient plus rectangular lobes (windows, lamps, soft boxes,
clouds). Their radiance can be asked for already blurred, which is all that rough
reflections and a coarse set of basis directions need.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from unips_jax.scenes.draws import Draws, rotation_about
from unips_jax.scenes.environments import Photograph, load_tables, look_up
from unips_jax.scenes.noise import Point, rotate, sine

NUM_LOBES = 6


class Environment(NamedTuple):
    """Distant surroundings."""

    rotation: Array  # `[N, 3, 3]`, world to the environment's frame (y up)
    zenith: Array  # `[3]`, radiance, as the next two
    horizon: Array
    ground: Array
    axes: Array  # `[S, 3, 3]`, rows: right, up and centre of each lobe
    half: Array  # `[S, 2]`, half extents in the lobe's tangent plane
    color: Array  # `[S, 3]`, radiance
    clutter: Array  # contrast of fine structure seen in reflections
    clutter_frequency: Array  # its cycles per unit of direction
    scale: Array  # `[N]`, brightness in each image
    # one in its place, whole or in part; None where no scene has any
    photograph: Photograph | None = None


def _smooth_step(x: Array) -> Array:
    """From -0.5 at x <= -1.5 to 0.5 at x >= 1.5."""
    x = jnp.clip(x * (2 / 3), -1.0, 1.0)
    return x * (0.75 - 0.25 * x * x)


def environment_radiance(
    environment: Environment, rotation: Array, direction: Point, blur: Array
) -> tuple[Array, Array, Array]:
    """Radiance from unit directions in the world, averaged over a lobe.

    `rotation` is one image's, `blur` about the lobe's standard deviation, in radians.
    """
    d = rotate(rotation, direction)
    up = d[1]
    sky = 0.5 + _smooth_step(up / (0.08 + blur))
    rise = jnp.clip(up, 0.0, 1.0) * (1 - 0.5 * blur)
    colors = []
    for c in range(3):
        above = environment.horizon[c] + rise * (
            environment.zenith[c] - environment.horizon[c]
        )
        colors.append(environment.ground[c] + sky * (above - environment.ground[c]))
    if environment.photograph is not None:
        share = environment.photograph.share
        seen = look_up(environment.photograph, d, blur)
        colors = [c + share * (s - c) for c, s in zip(colors, seen, strict=True)]
    inverse = 1 / (blur + 0.01)

    def lobe(_: None, parameters: tuple[Array, Array]) -> tuple[None, Array]:
        axes, half = parameters
        x, y, z = rotate(axes, d)
        inside = _smooth_step((x + half[0]) * inverse)
        inside = inside - _smooth_step((x - half[0]) * inverse)
        high = _smooth_step((y + half[1]) * inverse)
        inside = inside * (high - _smooth_step((y - half[1]) * inverse))
        return None, inside * (0.5 + _smooth_step(z * inverse))

    # As a loop, so that the lobes are computed once and not per colour.
    _, lobes = lax.scan(lobe, None, (environment.axes, environment.half))
    light = jnp.einsum("sc,s...->c...", environment.color, lobes)
    colors = [color + light[c] for c, color in enumerate(colors)]
    f = environment.clutter_frequency
    wave = sine(f * d[0] + 0.3 * sine(1.7 * f * d[1])) * sine(f * d[2] + 1.3 * f * d[1])
    wave = wave + 0.5 * sine(2.3 * f * d[0] - 1.9 * f * d[2] + 0.2)
    gain = 1 + environment.clutter * wave / (1 + (6 * f * blur) ** 2)
    gain = jnp.maximum(gain, 0.0)
    return colors[0] * gain, colors[1] * gain, colors[2] * gain


def surroundings(environment: Environment, directions: Array, blur: float) -> Array:
    """Radiance from directions `[D, 3]` in each image, before scaling, `[N, 3, D]`."""
    x, y, z = directions.T
    width = jnp.float32(blur)
    return jax.vmap(
        lambda r: jnp.stack(environment_radiance(environment, r, (x, y, z), width))
    )(environment.rotation)


def sphere_points(count: int) -> np.ndarray:
    """Spherical Fibonacci points, `[count, 3]`."""
    index = np.arange(count)
    z = 1 - (2 * index + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * index
    ring = np.sqrt(1 - z * z)
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)
    return points.astype(np.float32)


def warmth(draws: Draws, amount: float, *shape: int) -> Array:
    """Colours along daylight to lamp light, `[*shape, 3]`, green 1."""
    warm = draws.uniform(-1.0, 1.0, *shape)[..., None]
    return jnp.exp(amount * warm * jnp.asarray([0.5, 0.0, -0.6]))


def draw_environment(
    draws: Draws, num_images: int, turn: Array | float = 1.0
) -> Environment:
    """Draws a sky, a room, a studio or a mixture of lobes from 80 + 5 N numbers."""
    kind = draws.choice([0.3, 0.3, 0.2, 0.2])
    sky, room, studio = kind == 0, kind == 1, kind == 2
    dim = draws.log_uniform(0.02, 0.25)
    level = jnp.where(sky, 1.0, jnp.where(studio, 0.2 * dim, dim))
    zenith = level * warmth(draws, 0.7) * draws.uniform(0.5, 1.2)
    zenith = zenith * jnp.where(sky, jnp.asarray([0.6, 0.8, 1.2]), 1.0)
    horizon = level * warmth(draws, 0.5) * draws.uniform(0.5, 1.5)
    ground = level * warmth(draws, 0.5) * draws.uniform(0.05, 0.5)
    shape = (NUM_LOBES,)
    center = draws.direction(*shape)
    # Most light comes from above: in eight photographed environments a surface that
    # faces up gets 2.5 to 30 times (median 6) the light of one that faces down.
    above = draws.chance(jnp.where(sky | room, 0.95, 0.8), *shape)
    y = jnp.abs(center[:, 1]) * jnp.where(above, 1.0, -1.0)
    center = center.at[:, 1].set(y)
    helper = jnp.where(jnp.abs(y)[:, None] > 0.9, jnp.eye(3)[0], jnp.eye(3)[1])
    right = jnp.cross(helper, center)
    right = right / jnp.linalg.norm(right, axis=-1, keepdims=True)
    axes = jnp.stack([right, jnp.cross(center, right), center], -2)
    small = draws.log_uniform(0.06, 0.4, NUM_LOBES, 2)
    large = draws.log_uniform(0.15, 0.7, NUM_LOBES, 2)
    half = jnp.where((sky | studio)[None, None], large, small)
    used = draws.chance(jnp.where(studio, 0.5, 0.6), *shape).at[0].set(True)
    power = draws.log_uniform(0.2, 3.0, *shape) * used
    area = 4 * half[:, 0] * half[:, 1]
    radiance = power / (area + 0.05) * jnp.where(sky, 0.4, 1.0)
    color = radiance[:, None] * warmth(draws, 0.7, *shape)
    # Per image: any rotation for some scenes, for the others about the vertical only.
    free = draws.rotation(num_images)
    angles = turn * draws.uniform(-math.pi, math.pi, num_images)
    yaw = rotation_about(1, angles)
    tilt = rotation_about(0, draws.uniform(-0.6, 0.6))
    # Where light is to come from one side, it turns about the vertical only.
    rotation = jnp.where(draws.chance(0.25) & (turn >= 1), free, yaw @ tilt)
    return Environment(
        rotation=rotation,
        zenith=zenith,
        horizon=horizon,
        ground=ground,
        axes=axes,
        half=half,
        color=color,
        clutter=draws.uniform(0.0, 0.9),
        clutter_frequency=draws.log_uniform(1.0, 5.0),
        scale=jnp.exp(draws.uniform(-0.5, 0.5, num_images)),
    )


class Sun(NamedTuple):
    """Of a photographed environment."""

    used: Array  # whether the scene has such an environment
    direction: Array  # `[3]`, in the environment's frame
    color: Array  # `[3]`, irradiance on what faces it


def draw_photograph(
    draws: Draws, environment: Environment, rate: float
) -> tuple[Environment, Sun]:
    """Puts photographed environments in the place of a share of the drawn ones."""
    tables = load_tables()
    used = draws.chance(rate)
    part = jnp.where(draws.chance(0.7), 1.0, draws.uniform(0.4, 1.0))
    share = used * part
    index = draws.choice(jnp.ones(len(tables.radiance)))
    mirror = jnp.where(draws.chance(0.5), 1.0, -1.0)
    tint = warmth(draws, 0.4)
    flip = jnp.stack([mirror, jnp.ones(()), jnp.ones(())])
    direction = jnp.asarray(tables.sun_directions)[index] * flip
    color = jnp.asarray(tables.sun_colors)[index] * tint * share
    changed = environment._replace(
        color=environment.color * (1 - share),
        clutter=environment.clutter * (1 - share),
        photograph=Photograph(index, share, mirror, tint),
    )
    return changed, Sun(used, direction, color)


def with_sun(environment: Environment, sun: Sun) -> Environment:
    """The sun as one more lobe, three degrees wide, in the place of the first."""
    helper = jnp.where(jnp.abs(sun.direction[1]) > 0.9, jnp.eye(3)[0], jnp.eye(3)[1])
    right = jnp.cross(helper, sun.direction)
    right = right / jnp.linalg.norm(right)
    axes = jnp.stack([right, jnp.cross(sun.direction, right), sun.direction])
    half = 0.025
    values = (
        (environment.axes, axes),
        (environment.half, jnp.full(2, half)),
        (environment.color, sun.color / (4 * half * half)),
    )
    axes, halves, color = (
        old.at[0].set(jnp.where(sun.used, new, old[0])) for old, new in values
    )
    return environment._replace(axes=axes, half=halves, color=color)
