"""Connected parts of a mask, inside compiled functions."""

import jax
import jax.numpy as jnp

from unips_jax.surface.equations import links, to_bottom, to_left, to_right, to_top


def label_islands(inside: jax.Array) -> jax.Array:
    """Numbers the parts of a mask `[H, W]` that are connected by edges (not corners).

    Every pixel points to a smaller one of its part; pointers are shortened and roots
    tied together until nothing changes, in about log(H W) rounds. Returns int32: the
    flat index of each part's first pixel; outside, the pixel's own. Source: Y.
    Shiloach, U. Vishkin, "An O(log n) parallel connectivity algorithm" (1982).
    """
    shape, last = inside.shape, jnp.int32(inside.size)
    linked = links(inside)
    start = jnp.arange(inside.size, dtype=jnp.int32)

    def round_(state):
        labels, _ = state
        grid = labels.reshape(shape)
        least = grid
        for edge, fetch in (
            (linked.right, to_left),
            (to_right(linked.right), to_right),
            (linked.down, to_top),
            (to_bottom(linked.down), to_bottom),
        ):
            least = jnp.minimum(least, jnp.where(edge, fetch(grid), last))
        new = labels.at[labels].min(least.ravel())
        new = new[new]
        new = new[new]
        return new, (new != labels).any()

    labels, _ = jax.lax.while_loop(lambda state: state[1], round_, (start, True))
    return labels.reshape(shape)


def island_means(
    values: jax.Array, weights: jax.Array, labels: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The weighted mean of each island at its pixels, `[H, W]`, and sum of weights."""
    # Each row's pieces are summed first: in float32, millions of pixels added to one
    # sum one by one get lost (a count would end at 16.8 million).
    column = jnp.arange(labels.shape[1], dtype=jnp.int32)[None]
    begins = jnp.pad(labels[:, 1:] != labels[:, :-1], ((0, 0), (1, 0)))
    first = jax.lax.cummax(jnp.where(begins, column, 0), axis=1)
    piece = jnp.arange(labels.size, dtype=jnp.int32).reshape(labels.shape)
    piece = (piece - column + first).ravel()

    def sums(summands: jax.Array) -> jax.Array:
        of_pieces = jax.ops.segment_sum(summands.ravel(), piece, labels.size)
        return jax.ops.segment_sum(of_pieces, labels.ravel(), labels.size)

    total, weight = sums(values * weights), sums(weights)
    some = weight > 0
    mean = jnp.where(some, total / jnp.where(some, weight, 1), 0)
    return mean[labels], weight[labels]
