"""What is exported: functions of photographs alone, with shapes that are not known.

They compute what `estimate_normals` computes, and all of it (frame, antialiased
resize, mirrored view, reading of the contexts), so that what loads them needs to know
none of this. `N` photographs, `H` rows and `W` columns, and `P` pixels are symbols when
they are traced; no shape may depend on values.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.estimation.frame import (
    Frame,
    canonical_images,
    image_means,
    normalize_images,
    square_frame,
)
from unips_jax.estimation.pure import decode_view, mean_of_views
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import Network

Params = Any

# Pixels that are decoded at a time in `estimate`: with eight photographs a thousand
# members of sets, which stay in cache.
_CHUNK = 128


class EncodedSet(NamedTuple):
    """What the photographs are encoded to, for their pixels to be decoded with.

    Attributes:
        contexts: `[V, N, s/4, s/4, context_dim]`, of the images and the mirrored ones.
        views: `[V, 4]`, int32: top, left and side of the square that was encoded, and
            the images' width.
        gains: `[N]`: one over each image's mean over masked pixels.
    """

    contexts: Array
    views: Array
    gains: Array


def encode_set(
    params: Params, images: Array, mask: Array, *, config: ModelConfig
) -> EncodedSet:
    """Encodes the photographs of an object.

    Args:
        params: the network's parameters.
        images: `[N, H, W, 3]`, float32, linear RGB of any scale.
        mask: `[H, W]`, bool.
        config: the network's configuration.
    """
    normalized = normalize_images(images, mask)
    gains = 1 / image_means(images, mask)
    inputs, frames = [], []
    for step in (1, -1) if config.mirror else (1,):
        view, inside = normalized[:, :, ::step], mask[:, ::step]
        frame = square_frame(inside)
        size, antialias = config.canonical_size, config.antialias
        inputs.append(canonical_images(view, inside, frame, size, antialias))
        width = jnp.asarray(mask.shape[1], jnp.int32)
        frames.append(jnp.stack([jnp.asarray(x, jnp.int32) for x in (*frame, width)]))
    encoded: Any = Network(config).apply(
        {"params": params}, jnp.stack(inputs), method="encode"
    )
    return EncodedSet(encoded.contexts, jnp.stack(frames), gains)


def decode_pixels(
    params: Params,
    contexts: Array,
    views: Array,
    gains: Array,
    pixels: Array,
    rows: Array,
    columns: Array,
    *,
    config: ModelConfig,
) -> Array:
    """Decodes pixels of an object.

    Args:
        params: the network's parameters.
        contexts: from `encode_set`.
        views: likewise.
        gains: likewise.
        pixels: `[P, N, 3]`, float32: the pixels' values in every photograph.
        rows: `[P]`, int32: where they are, from the top.
        columns: `[P]`, int32, from the left.
        config: the network's configuration.

    Returns:
        Unit normals, `[P, 3]`, x right, y up, z towards the viewer.
    """
    pixels = pixels * gains[:, None]
    normals = [
        decode_view(
            params,
            contexts[i],
            pixels,
            (rows, columns),
            Frame(views[i, 0], views[i, 1], views[i, 2]),
            i == 1,
            width=views[i, 3],
            config=config,
        )[0]
        for i in range(contexts.shape[0])
    ]
    return mean_of_views(jnp.stack(normals))


def estimate(
    params: Params, images: Array, mask: Array, *, config: ModelConfig
) -> Array:
    """Normals of photographs, with bounded memory in pixels.

    Args:
        params: the network's parameters.
        images: `[N, H, W, 3]`, float32, linear RGB of any scale.
        mask: `[H, W]`, bool.
        config: the network's configuration.

    Returns:
        `[H, W, 3]`: unit normals inside the mask, zero outside.
    """
    encoded = encode_set(params, images, mask, config=config)
    n, height, width, _ = images.shape
    count = height * width
    # Masked pixels first, so that whole chunks beyond them can be skipped.
    inside = mask.reshape(count)
    (index,) = jnp.nonzero(inside, size=count, fill_value=count)
    chunks = (count + _CHUNK - 1) // _CHUNK
    index = jnp.pad(index, (0, chunks * _CHUNK - count), constant_values=2**31 - 1)
    flat = images.reshape(n, count, 3)

    def decode_chunk(index: Array) -> Array:
        def run(index: Array) -> Array:
            pixels = jnp.swapaxes(jnp.take(flat, index, axis=1, mode="clip"), 0, 1)
            places = index // width, index % width
            return decode_pixels(params, *encoded, pixels, *places, config=config)

        empty = jnp.zeros((_CHUNK, 3), images.dtype)
        return jax.lax.cond(index[0] < count, run, lambda _: empty, index)

    decoded = jax.lax.map(decode_chunk, index.reshape(chunks, _CHUNK))
    normals = jnp.zeros((count, 3), images.dtype)
    normals = normals.at[index].set(decoded.reshape(-1, 3), mode="drop")
    return normals.reshape(height, width, 3)
