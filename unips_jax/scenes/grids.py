"""Grids of pixels: their places, and fewer of them where that will do."""

import jax.numpy as jnp
from jax import Array


def pixel_grid(size: int) -> tuple[Array, Array]:
    """Pixel centres: u right, v up, in (-1, 1), `[size * size]`."""
    # Flat, as all fields are while rays are marched: the compiler vectorises the last
    # axis only.
    centers = (2 * jnp.arange(size, dtype=jnp.float32) + 1) / size - 1
    u, v = jnp.meshgrid(centers, -centers)
    return u.reshape(-1), v.reshape(-1)


def pick(values: Array, mask: Array, stride: int) -> Array:
    """One masked pixel `[..., h, w]` of each block, `stride` wide: the most central."""
    h, w = mask.shape[0] // stride, mask.shape[1] // stride
    offset = jnp.abs(jnp.arange(stride) - 0.5 * (stride - 1.1))
    rank = 1 + stride - 0.5 * (offset[:, None] + offset) - 1e-3 * offset[:, None]
    blocks = mask.reshape(h, stride, w, stride).transpose(0, 2, 1, 3)
    score = rank * (0.01 + blocks.astype(jnp.float32))  # [h, w, s, s]
    best = jnp.argmax(score.reshape(h, w, -1), -1)
    one_hot = (best[..., None] == jnp.arange(stride**2)).astype(jnp.float32)
    one_hot = one_hot.reshape(h, w, stride, stride)
    tiles = values.reshape(*values.shape[:-2], h, stride, w, stride)
    return jnp.einsum("...hiwj,hwij->...hw", tiles, one_hot)


def stretch(coarse: int, stride: int, first: float | None = None) -> Array:
    """Bilinear enlargement as a matrix, `[coarse * stride, coarse]`.

    `first` is the pixel where the first value belongs, by default its block's middle.
    """
    first = (stride - 1) / 2 if first is None else first
    at = (jnp.arange(coarse * stride) - first) / stride
    at = jnp.clip(at, 0, coarse - 1)
    return jnp.maximum(1 - jnp.abs(at[:, None] - jnp.arange(coarse)), 0.0)


def spread(values: Array, mask: Array, stride: int) -> Array:
    """Enlarges what was computed at `pick`ed pixels, ignoring blocks without any."""
    h, w = values.shape[-2:]
    full = jnp.any(mask.reshape(h, stride, w, stride), axis=(1, 3))
    weight = full.astype(jnp.float32) + 1e-6
    first = (stride - 1) // 2  # the pixel of a whole block that `pick` takes
    rows, columns = stretch(h, stride, first), stretch(w, stride, first).T
    return (rows @ (values * weight) @ columns) / (rows @ weight @ columns)
