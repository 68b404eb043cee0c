"""Materials: a subset of the Principled BSDF with solid procedural textures.

Base colour, roughness and metallic vary over the surface. The reflectance itself is in
`unips_jax.lighting.reflectance`.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from unips_jax.lighting.reflectance import Surface
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.noise import Point, dot, gradient_noise, rotate, sine

# Rows: MATERIALS. Columns: weight of noise, rings, tiles, weave, spots; scale low and
# high; contrast; saturation; value low and high; roughness low and high; chance that
# it is metallic; chance that chips of another kind show.
_TRAITS = np.array(
    [
        [0.4, 0.0, 0.1, 0.7, 0.2, 2.0, 8.0, 0.5, 0.7, 0.05, 0.9, 0.6, 1.0, 0.0, 0.0],
        [1.0, 0.0, 0.1, 0.0, 0.3, 1.0, 5.0, 0.35, 0.15, 0.2, 0.8, 0.5, 1.0, 0.0, 0.0],
        [0.3, 1.0, 0.0, 0.0, 0.0, 0.6, 2.0, 0.5, 0.5, 0.1, 0.7, 0.25, 0.8, 0.0, 0.0],
        [0.4, 0.2, 1.0, 0.0, 0.0, 1.0, 3.0, 0.6, 0.4, 0.1, 0.9, 0.1, 0.7, 0.0, 0.0],
        [1.0, 0.1, 0.0, 0.0, 0.6, 1.0, 5.0, 0.7, 0.4, 0.05, 0.6, 0.6, 1.0, 0.0, 0.0],
        [0.7, 0.2, 0.0, 0.1, 0.2, 0.8, 5.0, 0.25, 0.25, 0.4, 0.95, 0.12, 0.6, 1.0, 0.2],
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0, 0.0, 0.5, 0.2, 0.95, 0.2, 1.0, 0.0, 0.0],
        [0.5, 0.0, 0.1, 0.1, 0.2, 1.0, 4.0, 0.3, 0.3, 0.01, 0.08, 0.1, 0.8, 0.0, 0.0],
        [0.4, 0.1, 0.1, 0.0, 0.2, 0.6, 3.0, 0.4, 0.7, 0.05, 0.8, 0.06, 0.3, 0.0, 0.0],
        [0.7, 0.0, 0.0, 0.0, 0.3, 0.8, 4.0, 0.2, 0.7, 0.1, 0.8, 0.15, 0.6, 0.0, 1.0],
    ],
    np.float32,
)


def _color(draws: Draws, value: Array, saturation: Array) -> Array:
    """A colour of given luminance, `[3]`; saturation 0 is grey."""
    hue = draws.unit()
    phase = hue + jnp.asarray([0.0, 1 / 3, 2 / 3])
    rgb = 1 + saturation * jnp.cos(2 * math.pi * phase)
    rgb = rgb / (0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2])
    return jnp.clip(value * rgb, 0.005, 0.97)


def _pattern(
    traits: Array, draws: Draws, seed: Array, point: Point
) -> tuple[Array, Array]:
    """Texture value in [0, 1] and a slow noise, both `[P]`."""
    scale = draws.log_uniform(traits[5], traits[6])
    x, y, z = (c * scale for c in rotate(draws.rotation(), point))
    stretch = draws.uniform(1.0, 3.0)

    def octave(_: None, level: Array) -> tuple[None, Array]:
        f = jnp.exp2(level)
        shift = 7.3 * level
        value = gradient_noise(
            seed + level.astype(jnp.uint32),
            (x * f + shift, y * f * stretch, z * f - shift),
        )
        return None, value

    _, octaves = lax.scan(octave, None, jnp.arange(3, dtype=jnp.float32))
    fractal = jnp.einsum("o,op->p", jnp.asarray([1.0, 0.5, 0.25]), octaves)
    slow = octaves[0]
    ring = jnp.sqrt(x * x + z * z + 1e-6) * 3 + 0.6 * slow + 0.1 * y
    rings = ring - jnp.floor(ring)
    edge = jnp.maximum(
        jnp.abs(x - jnp.round(x)),
        jnp.maximum(jnp.abs(y - jnp.round(y)), jnp.abs(z - jnp.round(z))),
    )
    tiles = jnp.clip((edge - 0.42) * 20, 0.0, 1.0)
    weave = 0.5 + 0.5 * sine(3 * x) * sine(3 * y + 0.25 * sine(z))
    spots = jnp.clip(8 * (fractal - 0.15), 0.0, 1.0)
    weights = traits[:5] * draws.uniform(0.3, 1.0, 5)
    weights = weights / jnp.maximum(jnp.sum(weights), 1e-6)
    parts = (jnp.clip(0.5 + fractal, 0.0, 1.0), rings, tiles, weave, spots)
    value = sum(weights[i] * part for i, part in enumerate(parts))
    return value, slow  # type: ignore[return-value]


def paint(key: Array, rate: float, surface: Surface, point: Point) -> Surface:
    """Paints spots, lines or bands of another colour and gloss, at a rate."""
    key_draws, key_seed = jax.random.split(key)
    draws = Draws(key_draws, 32)
    seed = jax.random.bits(key_seed, (), jnp.uint32) >> 1
    scale = draws.log_uniform(1.5, 10.0)
    value = gradient_noise(seed, tuple(c * scale for c in point))
    spots = value - draws.uniform(0.1, 0.4)
    lines = draws.uniform(0.02, 0.08) - jnp.abs(value)
    along = dot(tuple(draws.direction()), point) * scale
    bands = draws.uniform(-0.2, 0.2) + 0.5 * sine(along + value)
    kind = draws.choice([0.4, 0.3, 0.3])
    inside = jnp.where(kind == 0, spots, jnp.where(kind == 1, lines, bands))
    sharpness = draws.log_uniform(8.0, 60.0) / scale
    share = jnp.clip(inside * sharpness + 0.5, 0.0, 1.0) * draws.chance(rate)
    color = _color(draws, draws.log_uniform(0.02, 0.9), draws.uniform(0.0, 0.7))
    return _coat(surface, share, color, draws.uniform(0.1, 1.0))


def _coat(surface: Surface, share: Array, color: Array, roughness: Array) -> Surface:
    """Something that is no metal over a share `[P]` of a surface."""
    return surface._replace(
        base_color=surface.base_color + share * (color[:, None] - surface.base_color),
        roughness=surface.roughness + share * (roughness - surface.roughness),
        metallic=surface.metallic * (1 - share),
    )


def spot_metal(key: Array, spotted: Array, surface: Surface, point: Point) -> Surface:
    """Spots of one paint, or of rust, on a metal; points are as in `draw_surface`."""
    key_draws, key_seed = jax.random.split(key)
    draws = Draws(key_draws, 16)
    seed = jax.random.bits(key_seed, (), jnp.uint32) >> 1
    scale = draws.log_uniform(1.5, 9.0)
    x, y, z = (c * scale for c in point)
    value = gradient_noise(seed, (x, y, z))
    value = value + 0.4 * gradient_noise(seed + 1, (2.7 * y, 2.7 * z, 2.7 * x))
    inside = value - draws.uniform(-0.15, 0.35)
    share = jnp.clip(inside * draws.log_uniform(6.0, 40.0) + 0.5, 0.0, 1.0) * spotted
    rust = draws.chance(0.5)
    brown = draws.uniform(0.5, 1.3) * jnp.asarray([0.28, 0.12, 0.05])
    color = _color(draws, draws.log_uniform(0.03, 0.9), draws.uniform(0.0, 0.8))
    roughness = jnp.where(rust, draws.uniform(0.6, 1.0), draws.uniform(0.08, 0.6))
    return _coat(surface, share, jnp.where(rust, brown, color), roughness)


def draw_surface(key: Array, kind: Array, point: Point, height: Array) -> Surface:
    """Draws a material, by its index into `MATERIALS`, and evaluates it.

    Points are in the object's frame, scaled to unit radius, each `[P]`; `height [P]`,
    the fine relief, is about [-1, 1]: hollows may be darker.
    """
    key_draws, key_seed = jax.random.split(key)
    draws = Draws(key_draws, 64)
    traits = jnp.asarray(_TRAITS)[kind]
    seed = jax.random.bits(key_seed, (), jnp.uint32) >> 1
    value, slow = _pattern(traits, draws, seed, point)
    level = draws.log_uniform(traits[9], traits[10])
    contrast = traits[7] * draws.uniform(0.3, 1.2)
    saturation = traits[8] * draws.uniform(0.0, 1.0, 2)
    light = _color(draws, level, saturation[0])
    second = level * jnp.maximum(1 - contrast, 0.1)
    same_hue = draws.chance(0.6)
    other = _color(draws, second, saturation[1])
    dark = jnp.where(same_hue, light * second / level, other)
    metal_tints = jnp.asarray([[1.0, 1, 1], [1, 0.8, 0.45], [1, 0.7, 0.55]])
    tint = metal_tints[draws.choice([0.6, 0.2, 0.2])]
    metal = tint * draws.uniform(0.45, 0.95)
    is_metal = draws.chance(traits[13])
    light = jnp.where(is_metal, metal, light)
    dark = jnp.where(is_metal, metal * (1 - 0.6 * contrast), dark)
    hollow = jnp.clip(-height, 0.0, 1.0) * draws.uniform(-0.3, 0.8)
    mix = jnp.clip(value + hollow, 0.0, 1.0)
    color = light[:, None] + mix * (dark - light)[:, None]
    low, high = traits[11], traits[12]
    usual = draws.uniform(low, high)
    rough = usual + draws.uniform(-0.3, 0.3) * contrast * mix
    metallic = jnp.full_like(mix, 1.0) * is_metal
    # Chips: bare metal under paint, or rust on metal.
    chip = draws.chance(traits[14] * 0.7)
    threshold = draws.uniform(0.1, 0.5)
    chipped = jnp.clip((slow + 0.3 * value - threshold) * 15, 0.0, 1.0) * chip
    bare = jnp.where(is_metal, jnp.asarray([0.25, 0.12, 0.06]), metal)
    color = color + chipped * (bare[:, None] - color)
    metallic = metallic + chipped * (1 - 2 * metallic)
    rough = rough + chipped * (draws.uniform(0.3, 0.9) - rough)
    # Wear and polish: roughness that varies on its own, whatever the colour.
    scale = draws.log_uniform(1.5, 9.0)
    worn = gradient_noise(seed + 9, tuple(c * scale for c in point))
    rough = rough + draws.chance(0.65) * draws.uniform(0.0, 0.4) * worn
    matt = draws.chance(0.4) & (usual > 0.5)
    specular = jnp.where(matt, 0.0, draws.uniform(0.3, 1.0))
    return Surface(color, jnp.clip(rough, 0.06, 1.0), metallic, specular)
