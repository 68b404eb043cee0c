"""Draws the shapes of all kinds, and their fine relief."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.scenes.config import SHAPE_NAMES
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.sdf import (
    NUM_KNOTS,
    NUM_WAVES,
    Detail,
    Shape,
    pack,
    profile_through,
)
from unips_jax.scenes.slots import LATHE, TRAITS, bounding_sphere, draw_slots, is_flat

# Columns: chance of waves, least and greatest slope, least and greatest frequency.
_WAVES = np.array(
    [
        [0.6, 0.05, 0.5, 0.5, 2.5],
        [0.35, 0.05, 0.4, 0.5, 3.0],
        [0.1, 0.05, 0.2, 0.5, 3.0],
        [0.25, 0.05, 0.3, 0.5, 3.0],
        [0.2, 0.05, 0.2, 0.5, 2.0],
        [0.8, 0.2, 0.9, 0.5, 6.0],
        [0.5, 0.05, 0.25, 0.4, 2.5],
    ],
    np.float32,
)


def draw_detail(
    draws: Draws,
    key: Array,
    kind: Array,
    frequencies: tuple[float, float] = (4.0, 14.0),
    slopes: tuple[float, float] = (0.04, 0.5),
    *,
    always: bool = False,
) -> Detail:
    """Draws a fine relief from at least 14 numbers; `key` is for the noise.

    Some have none, unless there is to be one `always`.
    """
    frequency = draws.log_uniform(*frequencies)
    slope = draws.log_uniform(*slopes)
    pattern = draws.choice([0.45, 0.12, 0.12, 0.12, 0.12])
    wavy = draws.chance(0.6)
    flat = draws.chance(jnp.where(is_flat(kind), 0.1, 0.3))
    slope = slope if always else jnp.where(flat, 0.0, slope)
    amplitude = slope / frequency
    share = (pattern == jnp.arange(5)) * amplitude
    return Detail(
        seed=jax.random.bits(key, (), jnp.uint32) >> 1,
        rotation=draws.rotation(),
        frequency=frequency,
        noise=amplitude * 0.8 * jnp.where(pattern == 0, 1.0, 0.5 * wavy),
        groove=share[1] * 0.5,
        ridge=share[2] * 0.25,
        dimple=share[3] * jnp.where(draws.chance(0.5), 0.4, -0.4),
        weave=share[4] * 0.25,
        groove_width=draws.uniform(0.12, 0.3),
    )


def _profile(draws: Draws, rate: Array) -> tuple[Array, Array]:
    """Draws `Shape.profile` (a third are cones, some none), and its steepest slope."""
    away = draws.uniform(-0.2, 0.2, NUM_KNOTS - 2)
    heights = jnp.linspace(-1.0, 1.0, NUM_KNOTS).at[1:-1].add(away)
    widths = draws.log_uniform(0.2, 1.0, NUM_KNOTS)
    ends = jnp.stack([widths[0], widths[-1]])
    straight = jnp.interp(heights, jnp.asarray([-1.0, 1.0]), ends)
    widths = jnp.where(draws.chance(1 / 3), straight, widths)
    widths = jnp.where(draws.chance(rate), widths / jnp.max(widths), 1.0)
    profile = profile_through(heights, widths, draws.log_uniform(0.01, 0.2))
    return profile, jnp.max(jnp.abs(jnp.diff(widths) / jnp.diff(heights)))


def _slab(draws: Draws, rate: Array, middle: Array, radius: Array) -> Array:
    """Draws `Shape.slab`, far away where the ends are not flat."""
    half = draws.uniform(0.35, 0.75) * radius
    offset = draws.uniform(-0.25, 0.25) * radius
    return jnp.stack([middle + offset, jnp.where(draws.chance(rate), half, 1e3)])


def as_mesh(draws: Draws, shape: Shape, meshes: Array, rate: float) -> Shape:
    """A mesh of `[M, G, G, G]` for a share of the drawn shapes; its relief stays."""
    is_mesh = draws.chance(rate)
    stretch = (
        draws.uniform(0.65, 1.0, 3)
        .at[0]
        .multiply(jnp.where(draws.chance(0.5), 1.0, -1.0))
    )
    grid = meshes[draws.choice(np.ones(len(meshes)))]
    plain = {
        "center": jnp.zeros(3),
        "radius": jnp.ones(()),
        "step_scale": jnp.ones(()),
        "kind": jnp.int32(SHAPE_NAMES.index("mesh")),
    }
    changed: dict[str, Any] = {"grid": grid, "stretch": stretch}
    for name, value in plain.items():
        old = getattr(shape, name)
        changed[name] = value if rate == 1 else jnp.where(is_mesh, value, old)
    return shape._replace(**changed, is_mesh=None if rate == 1 else is_mesh)


def draw_shape(key: Array, kind: Array) -> Shape:
    """Draws an object of a kind, an index into `SHAPE_KINDS`."""
    key_slots, key_waves, key_detail, key_seed, key_profile = jax.random.split(key, 5)
    draws = Draws(key_slots, 256)
    traits = jnp.asarray(TRAITS)[kind]
    primitives, reach = draw_slots(draws, kind)
    lathe = (kind == LATHE).astype(jnp.float32)
    mirror = draws.chance(traits[8]).astype(jnp.float32)
    twist = jnp.where(draws.chance(traits[7]), draws.uniform(-2.5, 2.5), 0.0)
    center, radius = bounding_sphere(primitives, reach, lathe, mirror)

    draws = Draws(key_waves, 64)
    wave = jnp.asarray(_WAVES)[kind]
    slope = draws.uniform(wave[1], wave[2]) * draws.chance(wave[0])
    base = draws.log_uniform(wave[3], wave[4])
    frequency = base * jnp.asarray([1.0, 1.3, 1.9, 2.7, 3.9]) / radius * 1.4
    roll_off = draws.uniform(0.5, 1.1)
    amplitude = (
        slope * 0.12 / frequency * (frequency / frequency[0]) ** (0.9 - roll_off)
    )
    warp = draws.uniform(0.0, 0.2) / jnp.maximum(amplitude[0], 1e-3)
    gradient = (
        jnp.sum(amplitude * frequency) * 6.3 * (1 + 6.3 * warp * amplitude[0]) * 0.5
    )
    twisting = jnp.abs(twist) * radius * 0.7 * (1 - lathe)
    outline = Draws(key_profile, 32)
    profile, steepest = _profile(outline, traits[9])
    slab = _slab(outline, traits[10], center[1], radius)
    tapering = 1.4 * steepest
    return Shape(
        slots=pack(primitives),
        lathe=lathe,
        mirror=mirror * (1 - lathe),
        twist=twist * (1 - lathe),
        profile=profile,
        slab=slab,
        waves=jnp.concatenate(
            [
                draws.direction(NUM_WAVES) * frequency[:, None],
                draws.unit(NUM_WAVES, 1),
                amplitude[:, None],
            ],
            -1,
        ),
        wave_warp=warp,
        wave_ridge=jnp.where(draws.chance(0.35), draws.uniform(0.3, 1.0), 0.0),
        step_scale=1
        / (
            (1 + 0.5 * gradient)
            * jnp.sqrt(1 + 0.5 * twisting**2)
            * jnp.sqrt(1 + 0.25 * tapering**2)
        ),
        detail=draw_detail(Draws(key_detail, 32), key_seed, kind),
        center=center,
        radius=radius + jnp.sum(amplitude),
        kind=kind,
    )
