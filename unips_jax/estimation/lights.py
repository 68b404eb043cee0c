"""The lights that the network guesses on its way to the normals."""

from typing import Any

import jax
import numpy as np

from unips_jax.estimation.chunks import CHUNK_IMAGES, CHUNK_TOKENS, in_pieces
from unips_jax.estimation.frame import FrameKind
from unips_jax.estimation.streaming import canonical_photographs, padded_size
from unips_jax.io.color import Transfer
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import Network


def guess_lights(
    params: Any,
    images: np.ndarray,
    mask: np.ndarray,
    *,
    config: ModelConfig,
    transfer: Transfer = "linear",
    frame: FrameKind = "mask",
) -> np.ndarray | None:
    """Guesses the mean direction of each photograph's light.

    Costs the encoder's share of an estimate.

    Args:
        params: the network's parameters.
        images: `[N, H, W, 3]`, uint8, uint16 or float32.
        mask: `[H, W]`, bool.
        config: the network's configuration.
        transfer: how values encode light.
        frame: see `estimate_normals`.

    Returns:
        `[N, 3]`, weighted by power: about 1 long for one lamp, 0 for light that comes
        equally from everywhere (see `scenes.Scene.light_means`). None where the network
        makes no guesses.
    """
    if not config.guesses:
        return None
    count = len(images)
    size = padded_size(count)
    views = [(images, mask, 1)]
    if config.mirror:
        views.append((images[:, :, ::-1], mask[:, ::-1], -1))
    total = np.zeros((count, 3), np.float32)
    for pictures, inside, sign in views:
        inputs, _, _ = canonical_photographs(
            pictures, inside, size, frame, transfer, config
        )
        lights = _guess(params, inputs, np.arange(size) < count, config=config)
        total += np.asarray(lights).reshape(size, 3)[:count] * [sign, 1, 1]
    return total / len(views)


def _lights(
    params: Any, images: jax.Array, valid: jax.Array, *, config: ModelConfig
) -> jax.Array:
    encoded: Any = Network(config).apply(
        {"params": params},
        images,
        valid,
        by_image=in_pieces(CHUNK_IMAGES),
        by_place=in_pieces(max(1, CHUNK_TOKENS // len(images))),
        method="encode",
    )
    return encoded.guesses.lights


_guess = jax.jit(_lights, static_argnames="config")
