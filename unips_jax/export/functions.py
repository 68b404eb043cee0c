"""What is exported: functions of photographs alone, with shapes that are not known.

They compute what `estimate_normals` computes, and all of it (frame, antialiased
resize, mirrored view, reading of the contexts), so that what loads them needs to know
none of this. `N` photographs, `H` rows and `W` columns, and `P` pixels are symbols when
they are traced; no shape may depend on values.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from unips_jax.models.network import Encoding, UniversalNetwork, decode, encode
from unips_jax.models.views import Frame, image_means, make_views, normalize_images


class EncodedSet(NamedTuple):
    """What the photographs are encoded to, for their pixels to be decoded with."""

    # `[V, s/4, s/4, N, context_dim]`, of the images and the mirrored ones
    contexts: Array
    # `[V, 4]`, int32: top, left and side of the square that was encoded, and the
    # images' width
    views: Array
    gains: Array  # `[N]`: one over each image's mean over masked pixels


def encode_set(network: UniversalNetwork, images: Array, mask: Array) -> EncodedSet:
    """Encodes an object's photographs `[N, H, W, 3]`, float32, linear, of any scale."""
    views = make_views(normalize_images(images, mask), mask, network.config)
    contexts = encode(network, views).contexts
    width = jnp.broadcast_to(views.width, views.frame.side.shape)
    facts = jnp.stack([*views.frame, width], axis=-1).astype(jnp.int32)
    return EncodedSet(contexts, facts, 1 / image_means(images, mask))


def decode_pixels(
    network: UniversalNetwork,
    contexts: Array,
    views: Array,
    gains: Array,
    pixels: Array,
    rows: Array,
    columns: Array,
) -> Array:
    """Decodes pixels of an object: unit normals `[P, 3]`, z towards the viewer.

    `pixels` `[P, N, 3]`, float32, are values in every photograph, `rows` and `columns`
    `[P]` int32 where they are, from the top left; the others come from `encode_set`.
    """
    top, left, side, width = views.T
    mirrored = jnp.arange(len(contexts)) == 1
    encoding = Encoding(contexts, Frame(top, left, side), mirrored, width[0])
    return decode(network, encoding, pixels * gains[:, None], (rows, columns))
