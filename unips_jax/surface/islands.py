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
    flat, size = labels.ravel(), labels.size
    total = jax.ops.segment_sum((values * weights).ravel(), flat, size)
    weight = jax.ops.segment_sum(weights.ravel(), flat, size)
    some = weight > 0
    mean = jnp.where(some, total / jnp.where(some, weight, 1), 0)
    return mean[labels], weight[labels]
