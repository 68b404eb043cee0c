"""Sums over pixels in pieces, each piece's gradient computed with its value."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from unips_jax.models.chunks import join_chunks, split_chunks


def chunked_sum(
    function: Callable[[Any, Any, Any], tuple[Array, Any]],
    params: Any,
    xs: Any,
    constants: Any,
    size: int | None,
) -> tuple[Array, Any]:
    """Sums a function over chunks of the leading axis, in bounded memory.

    Where a derivative is asked for, each chunk's gradient is computed together with its
    value, and the derivative is the product with it. So nothing of a chunk is kept or
    recomputed, and all of it stays in cache. `function(params, xs, constants)` returns
    a sum, and arrays with the chunk's leading axis: they come back, `[P, ...]`, without
    a derivative. The last chunk is padded with zeros; size None: all at once.
    """
    total = jax.tree.leaves(xs)[0].shape[0]
    parts = split_chunks((xs, constants), size or total)
    value, arrays = _chunked_sum(function, params, *parts)
    return value, join_chunks(arrays, total)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _chunked_sum(
    function: Any, params: Any, xs: Any, constants: Any
) -> tuple[Array, Any]:
    values, arrays = jax.lax.map(lambda part: function(params, *part), (xs, constants))
    return jnp.sum(values), arrays


@_chunked_sum.defjvp
def _chunked_sum_jvp(function: Any, primals: Any, tangents: Any) -> Any:
    params, *parts = primals
    run = jax.value_and_grad(function, argnums=(0, 1), has_aux=True)

    def add(total: Any, part: Any) -> tuple[Any, Any]:
        (value, arrays), (by_params, by_x) = run(params, *part)
        return jax.tree.map(jnp.add, total, (value, by_params)), (arrays, by_x)

    first = jax.tree.map(lambda x: x[0], tuple(parts))
    (value, _), _ = jax.eval_shape(run, params, *first)
    zeros = jnp.zeros((), value.dtype), jax.tree.map(jnp.zeros_like, params)
    (value, by_params), (arrays, by_xs) = jax.lax.scan(add, zeros, tuple(parts))
    change = optax.tree.vdot((by_params, by_xs), tangents[:2])
    still = jax.tree.map(jnp.zeros_like, arrays)
    return (value, arrays), (change.astype(value.dtype), still)
