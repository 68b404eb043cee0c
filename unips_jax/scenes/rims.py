"""What goes wrong at an object's border: mixed pixels, and masks that miss it.

In photographs a border pixel is partly background, and masks, drawn by hand or by a
network, are a pixel or three too large or too small, jagged, soft or shifted. All of it
is written as products with banded matrices, as the sensor's blur is.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from unips_jax.scenes.draws import Draws
from unips_jax.scenes.grids import pixel_grid, stretch

# How many pixels beyond the object are continued.
REACH = 4
_CELLS = 4


class Rims(NamedTuple):
    """The border of one scene."""

    mixed: Array  # whether border pixels are partly background
    share: Array  # `[H, W]`, the object's share of each pixel where mixed
    background: Array  # `[N, 3, H, W]`
    offset: Array  # `[H, W]`, by how many pixels the mask is too large there, rounded


def band(size: int, amount: Array | float) -> Array:
    """Adds the two neighbours along an axis, weight `amount`, `[size, size]`."""
    index = jnp.arange(size)
    near = jnp.abs(index[:, None] - index) == 1
    return jnp.eye(size) + amount * near


def extend(values: Array, mask: Array, steps: int = REACH) -> Array:
    """Continues `[..., H, W]` beyond the mask by means of neighbours, then by zero."""
    rows, columns = (band(size, 1.0) for size in mask.shape)
    known = mask.astype(jnp.float32)
    values = values * known
    for _ in range(steps):
        near = rows @ known @ columns
        around = (rows @ values @ columns) / jnp.maximum(near, 1.0)
        values = jnp.where(known > 0, values, around)
        known = jnp.where(near > 0, 1.0, known)
    return values


def border_depth(mask: Array, steps: int = REACH) -> Array:
    """How many pixels inside the border, `[H, W]`: 0 just inside, -1 just outside."""
    # Steps across and steps that go along diagonals too take turns, which keeps circles
    # round. The frame is no border.
    rows, columns = (band(size, 1.0) for size in mask.shape)
    inside, outside = mask.astype(jnp.float32), 1.0 - mask
    depth = jnp.where(mask, float(steps), -1.0 - steps)
    for step in range(steps):
        if step % 2:
            inside, outside = rows @ inside @ columns, rows @ outside @ columns
        else:
            inside = rows @ inside + inside @ columns
            outside = rows @ outside + outside @ columns
        inside, outside = jnp.minimum(inside, 1.0), jnp.minimum(outside, 1.0)
        depth = depth + jnp.where(mask, -outside, inside)
    return depth


def draw_rims(draws: Draws, uniform: Array, mean: Array, mask: Array) -> Rims:
    """Draws a background, how far the border mixes with it, and the mask's error.

    `draws` has at least 48 + 3 N numbers; `uniform [H, W]` in [0, 1) is for jagged
    masks; `mean [N, 3]` is the object's mean in each image.
    """
    mixed = draws.chance(0.8)
    # Across one or three pixels: a sharp lens, or a soft one or an enlarged picture.
    amount = draws.uniform(0.1, 1.0)
    rows, columns = (band(size, amount) for size in mask.shape)
    total = rows @ jnp.ones(mask.shape) @ columns
    once = (rows @ (1.0 * mask) @ columns) / total
    twice = (rows @ once @ columns) / total
    share = jnp.where(draws.chance(0.35), twice, once)
    return Rims(
        mixed=mixed,
        share=share,
        background=_draw_background(draws, mean, mask.shape[0]),
        offset=_draw_offset(draws, uniform, mask),
    )


def mix(rims: Rims, images: Array, mask: Array) -> Array:
    """Puts the object `[N, 3, H, W]` before its background."""
    continued = extend(images, mask, 2)
    mixture = rims.background + rims.share * (continued - rims.background)
    sharp = jnp.where(mask, images, rims.background)
    return jnp.where(rims.mixed, mixture, sharp)


def miss(rims: Rims, mask: Array) -> Array:
    """The mask with its error; as it is if that would take most of it."""
    missed = border_depth(mask) + rims.offset > -0.5
    kept = jnp.sum(missed & mask) > 0.5 * jnp.sum(mask)
    return jnp.where(kept, missed, mask)


def _draw_background(draws: Draws, mean: Array, size: int) -> Array:
    """Black cloth, or a table or a wall with stripes, in the light of each image."""
    dark = draws.chance(0.65)
    level = jnp.where(dark, draws.uniform(0.0, 0.08), draws.log_uniform(0.08, 3.0))
    tint = jnp.exp(draws.uniform(-0.3, 0.3, 3))
    light = jnp.exp(draws.uniform(-0.5, 0.5, mean.shape[0]))
    u, v = (x.reshape(size, size) for x in pixel_grid(size))
    # Light falls off to one side; stripes and clouds are the same in all images.
    slope = draws.uniform(-0.7, 0.7, 2, mean.shape[0])[..., None, None]
    wave = draws.uniform(-20.0, 20.0, 2)
    pattern = jnp.sin(wave[0] * u + wave[1] * v + draws.uniform(0.0, 2 * math.pi))
    pattern = draws.uniform(0.0, 0.6) * pattern
    shading = jnp.exp(pattern + slope[0] * u + slope[1] * v)  # [N, H, W]
    color = mean * (level * tint) * light[:, None]
    return color[..., None, None] * shading[:, None]


def _draw_offset(draws: Draws, uniform: Array, mask: Array) -> Array:
    """By how many pixels a mask is too large, `[H, W]`."""
    error = jnp.stack(
        [
            jnp.zeros(()),
            draws.uniform(-2.5, -0.5),
            draws.uniform(0.5, 2.0),
            draws.uniform(1.5, 3.5),
        ]
    )[draws.choice([0.25, 0.25, 0.35, 0.15])]
    size = mask.shape[0]
    u, v = (x.reshape(size, size) for x in pixel_grid(size))
    # Shifted: too large on one side of the mask's centre, too small on the other.
    weight = mask / jnp.maximum(jnp.sum(mask), 1)
    u, v = u - jnp.sum(u * weight), v - jnp.sum(v * weight)
    angle = draws.uniform(0.0, 2 * math.pi)
    side = (u * jnp.cos(angle) + v * jnp.sin(angle)) / jnp.maximum(
        jnp.hypot(u, v), 0.01
    )
    shift = draws.chance(0.3) * draws.uniform(0.0, 1.5)
    # Uneven: an outline drawn by hand. Jagged: pixels decided one by one.
    cells = draws.uniform(-1.0, 1.0, _CELLS, _CELLS)
    cells = stretch(_CELLS, size // _CELLS) @ cells @ stretch(_CELLS, size // _CELLS).T
    uneven = draws.chance(0.3) * draws.uniform(0.0, 2.0)
    jagged = draws.chance(0.5) * draws.log_uniform(0.5, 3.0)
    total = error + shift * side + uneven * cells + jagged * (uniform - 0.5)
    return jnp.where(error == 0, 0.0, jnp.clip(total, -3.0, REACH))
