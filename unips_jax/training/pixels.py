"""Which pixels of an object a step trains on, and how much each of them counts."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

BLOCK = 4  # pixels of a block: top left, top right, bottom left, bottom right
# Pairs of a block's pixels that are neighbours.
_FROM, _TO = np.array([0, 2, 0, 1]), np.array([1, 3, 2, 3])


class DrawnPixels(NamedTuple):
    """Pixels of an object."""

    places: Array  # `[P]`, into the flattened image; of 2 x 2 blocks, four in a row
    inside: Array  # `[P]`, which of them are on the mask


def draw_pixels(mask: Array, count: int, key: Array) -> DrawnPixels:
    """Draws different pixels of a mask `[H, W]`; some outside where it is small."""
    flat = mask.reshape(-1)
    order = jnp.where(flat, jax.random.uniform(key, flat.shape, jnp.float32), -1)
    chosen, index = jax.lax.top_k(order, min(count, flat.size))
    return DrawnPixels(index, chosen >= 0)


def draw_blocks(mask: Array, count: int, key: Array) -> DrawnPixels:
    """Draws blocks of 2 x 2 pixels that reach into a mask `[H, W]`, H and W even.

    `count` pixels, rounded down to whole blocks, at least one.
    """
    height, width = mask.shape
    cells = mask.reshape(height // 2, 2, width // 2, 2)
    blocks = jnp.any(cells, axis=(1, 3))
    cell, _ = draw_pixels(blocks, max(1, count // BLOCK), key)
    row, column = 2 * (cell // (width // 2)), 2 * (cell % (width // 2))
    first = row * width + column
    index = (first[:, None] + jnp.array([0, 1, width, width + 1])).reshape(-1)
    return DrawnPixels(index, mask.reshape(-1)[index])


def steepness(normals: Array, inside: Array) -> Array:
    """How much true normals `[P, 3]` change within each block, `[P]` in [0, 2]."""
    blocks, change = inside.reshape(-1, BLOCK), _changes(normals)
    pairs = blocks[:, _FROM] & blocks[:, _TO]
    mean = jnp.sum(pairs * jnp.linalg.norm(change, axis=-1), axis=-1)
    mean /= jnp.maximum(jnp.sum(pairs, axis=-1), 1)
    return jnp.repeat(mean, BLOCK)


def neighbour_distances(
    predicted: Array, true: Array, weights: Array
) -> tuple[Array, Array]:
    """How differently normals change from pixel to pixel than the true ones, squared.

    Of normals `[P, ..., 3]` of blocks, weights `[P, ...]` 0 outside the mask. Returns
    `[P / 4, 4, ...]` squared distances, one for each pair of neighbours, and their
    weights, of one block as large as its pixels' together.
    """
    error = _changes(predicted) - _changes(true)
    weights = weights.reshape(-1, BLOCK, *weights.shape[1:])
    pairs = jnp.minimum(weights[:, _FROM], weights[:, _TO])
    return jnp.sum(jnp.square(error), axis=-1), pairs


def _changes(values: Array) -> Array:
    blocks = values.reshape(-1, BLOCK, *values.shape[1:])
    return blocks[:, _TO] - blocks[:, _FROM]
