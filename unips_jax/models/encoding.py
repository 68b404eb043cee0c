"""What the encoders of both networks are made of and give, and how to run one.

An encoder treats every image alone, but for the communication between the images of a
set, which treats every place of the maps alone. So a caller may have it done in pieces.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from unips_jax.models.config import ModelConfig
from unips_jax.models.light_tokens import LightGuess
from unips_jax.models.set_attention import SAB, AttentionKind

# Images of a large set that attend to it at a time.
_QUERY_CHUNK = 128

# Calls a module, `module(xs, *rest)`, on the leading axis of `xs`, whole or in pieces.
Pieces = Callable[..., Any]


class Guesses(NamedTuple):
    """What an encoder may find out on its way, for B sets of N images."""

    normals: Array  # [B, h, w, 3], along those at the contexts' cells, any length
    lights: Array  # [B, N, 3], mean directions (see `scenes.Scene.light_means`)
    kinds: LightGuess | None = None  # from light tokens


class Encoded(NamedTuple):
    """What an encoder makes of sets of images."""

    contexts: Array  # [..., N, g, g, context_dim], g = context_size
    guesses: Guesses | None = None


def whole(module: nn.Module, xs: Any, *rest: Any) -> Any:
    """The one piece: calls the module on all of `xs` at once."""
    return module(xs, *rest)  # type: ignore[operator]


def communications(
    config: ModelConfig, dims: Sequence[int], attention: AttentionKind
) -> list[nn.Module]:
    """The set attention blocks between the images, one for each map's channels."""
    block = nn.remat(SAB, static_argnums=(3,)) if config.remat else SAB
    return [
        block(
            features=dim,
            num_heads=config.communication_heads,
            mlp_dim=int(dim * config.communication_mlp_ratio),
            attention=attention,
            use_layer_norm=False,
            dropout_rate=config.dropout_rate,
            query_chunk=_QUERY_CHUNK,
            dtype=jnp.dtype(config.dtype),
        )
        for dim in dims
    ]


def communicate(
    block: nn.Module,
    level: Array,
    num_images: int,
    valid: Array | None,
    deterministic: bool,
    by_place: Pieces = whole,
) -> Array:
    """Lets the images of a set (N maps in a row) exchange features at each place."""
    sets = level.reshape(-1, num_images, *level.shape[1:])
    sets = jnp.moveaxis(sets, 1, -2)  # [M / N, h, w, N, C]
    places = sets.reshape(-1, *sets.shape[-2:])
    places = by_place(block, places, valid, deterministic)
    return jnp.moveaxis(places.reshape(sets.shape), -2, 1).reshape(level.shape)
