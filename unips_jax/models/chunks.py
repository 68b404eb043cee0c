"""Work in pieces, so that memory does not grow with pixels and images."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.models import ops
from unips_jax.models.encoding import Pieces

# Images that pass the backbone together.
CHUNK_IMAGES = 2
# Members of sets decoded at once: enough to keep the matrix products busy, few enough
# to stay in cache.
CHUNK_TOKENS = 1024


def map_chunks(function: Callable[[Any], Any], xs: Any, size: int) -> Any:
    """A function of `split_chunks` of the leading axis, rematerialised under `grad`."""
    total = jax.tree.leaves(xs)[0].shape[0]
    if ops.known(lambda: total <= size):
        return jax.checkpoint(function)(xs)
    parts = split_chunks(xs, size)
    return join_chunks(jax.lax.map(jax.checkpoint(function), parts), total)


def bounded(num_images: int) -> dict[str, Any]:
    """Options of `encode` that keep its memory from growing with the set."""
    if not isinstance(num_images, int):
        return {}
    return {
        "by_image": in_pieces(CHUNK_IMAGES),
        "by_place": in_pieces(max(1, CHUNK_TOKENS // num_images)),
    }


def pixels_at_a_time(contexts: Array) -> int:
    """Pixels to decode together, from an object's contexts `[V, h, w, N, C]`."""
    views, num_images = contexts.shape[0], contexts.shape[3]
    if not isinstance(num_images, int):  # a symbol under `jax.export`: perhaps eight
        num_images = 8
    return max(1, CHUNK_TOKENS // (views * num_images))


def in_pieces(size: int) -> Pieces:
    """`map_chunks` for an encoder's modules; every chunk has its own dropout."""

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
    """Cuts `[P, ...]` into even chunks up to `size`, padded: `[chunks, p, ...]`."""
    total = jax.tree.leaves(xs)[0].shape[0]
    chunks = -(-total // size)
    if isinstance(total, int):
        size = -(-total // chunks)

    def split(x: Array) -> Array:
        widths = [(0, chunks * size - total)] + [(0, 0)] * (x.ndim - 1)
        x = jnp.pad(x, widths)
        return x.reshape(chunks, size, *x.shape[1:])

    return jax.tree.map(split, xs)


def join_chunks(parts: Any, total: int) -> Any:
    """Undoes `split_chunks`: `[chunks, p, ...]` to `[total, ...]`."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:total], parts)
