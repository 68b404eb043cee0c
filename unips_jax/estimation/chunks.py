"""Work in pieces, so that memory does not grow with pixels and images."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.models.encoding import Pieces

# Images that pass the backbone together.
CHUNK_IMAGES = 2


# Members of sets decoded at once: enough to keep the matrix products busy, few enough
# to stay in cache.
CHUNK_TOKENS = 1024


def map_views(function: Callable[[Any], Any], views: Any) -> Any:
    """`jax.lax.map` over arrays `[V, ...]`, without a loop where there is one view."""
    if jax.tree.leaves(views)[0].shape[0] > 1:
        return jax.lax.map(function, views)
    result = function(jax.tree.map(lambda x: x[0], views))
    return jax.tree.map(lambda x: x[None], result)


def map_chunks(function: Callable[[Any], Any], xs: Any, size: int) -> Any:
    """Applies a function to chunks of the leading axis, rematerialised under `grad`.

    Chunks are evenly sized, the last one padded with zeros.
    """
    total = jax.tree.leaves(xs)[0].shape[0]
    if total <= size:
        return jax.checkpoint(function)(xs)
    parts = split_chunks(xs, size)
    return join_chunks(jax.lax.map(jax.checkpoint(function), parts), total)


def in_pieces(size: int) -> Pieces:
    """`map_chunks` for the modules of an encoder; every chunk has its own dropout.

    Args:
        size: of the chunks.
    """

    def run(module: nn.Module, xs: Any, *rest: Any) -> Any:
        def call(module: Any, part: Any) -> Any:
            return module(part, *rest)

        total = jax.tree.leaves(xs)[0].shape[0]
        if total <= size:
            return nn.remat(call)(module, xs)
        step = nn.scan(
            lambda module, carry, part: (carry, nn.remat(call)(module, part)),
            variable_broadcast="params",
            split_rngs={"params": False, "dropout": True},
        )
        _, parts = step(module, (), split_chunks(xs, size))
        return join_chunks(parts, total)

    return run


def split_chunks(xs: Any, size: int) -> Any:
    """Cuts arrays `[P, ...]` into chunks of at most `size`: `[chunks, p, ...]`.

    Chunks are evenly sized, the last one padded with zeros.
    """
    total = jax.tree.leaves(xs)[0].shape[0]
    chunks = -(-total // size)
    size = -(-total // chunks)

    def split(x: Array) -> Array:
        widths = [(0, chunks * size - total)] + [(0, 0)] * (x.ndim - 1)
        x = jnp.pad(x, widths)
        return x.reshape(chunks, size, *x.shape[1:])

    return jax.tree.map(split, xs)


def join_chunks(parts: Any, total: int) -> Any:
    """Undoes `split_chunks`: `[chunks, p, ...]` to `[total, ...]`."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:total], parts)
