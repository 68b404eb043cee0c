"""`estimate_normals` for photographs: they stay on the host in their storage type."""

import functools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from unips_jax.io.color import Transfer, as_linear
from unips_jax.models import chunks
from unips_jax.models.network import (
    Encoding,
    UniversalNetwork,
    decode,
    encode,
    guessed_lights,
    with_uniform_contexts,
)
from unips_jax.models.views import FrameKind, Views, photograph_views

# Set sizes that are compiled; a set is padded to the next.
_BUCKETS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 96, 128)


class NormalsAndLights(NamedTuple):
    """What the network makes of photographs.

    Attributes:
        normals: `[H, W, 3]`, float32: unit inside the mask, zero outside.
        lights: `[N, 3]`, float32, see `guessed_lights`; None from a network that makes
            no guesses.
    """

    normals: np.ndarray
    lights: np.ndarray | None


def estimate_photographs(
    network: UniversalNetwork,
    images: np.ndarray,
    mask: np.ndarray,
    *,
    transfer: Transfer = "linear",
    frame: FrameKind = "mask",
    uniform_contexts: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """`estimate_normals` for large photographs, which stay in their storage type.

    Gives what `estimate_normals` gives for the linear images, to float order. Memory
    beyond `images`, `mask` and the result does not grow with the number of pixels, and
    with the number of images only by their contexts. Sets are padded to a few sizes, so
    that one compilation serves many.

    Args:
        network: from `load_weights`.
        images: `[N, H, W, 3]`, uint8, uint16 or float32.
        mask: `[H, W]`, bool.
        transfer: how values encode light; "srgb" is undone first.
        frame: see `estimate_normals`.
        uniform_contexts: an ablation, see `with_uniform_contexts`.
        progress: called with the numbers of pixels done and to do.

    Returns:
        `[H, W, 3]`, float32: unit normals inside the mask, zero outside.
    """
    found = estimate_with_lights(
        network,
        images,
        mask,
        transfer=transfer,
        frame=frame,
        uniform_contexts=uniform_contexts,
        progress=progress,
    )
    return found.normals


def estimate_with_lights(
    network: UniversalNetwork,
    images: np.ndarray,
    mask: np.ndarray,
    *,
    transfer: Transfer = "linear",
    frame: FrameKind = "mask",
    uniform_contexts: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> NormalsAndLights:
    """`estimate_photographs`, and the lights that are guessed on the way."""
    count, padded = len(images), padded_size(len(images))
    valid = np.arange(padded) < count
    linear = functools.partial(as_linear, transfer=transfer)
    views, gains = photograph_views(
        images, mask, linear, network.config, frame, padded=padded
    )
    encoding = _encode(network, views, valid, uniform_contexts=uniform_contexts)
    guessed: Any = guessed_lights(jax.device_get(encoding))
    encoding = encoding._replace(guesses=None)

    normals = np.zeros((*mask.shape, 3), np.float32)
    size = chunks.pixels_at_a_time(encoding.contexts)
    done, total = 0, int(np.count_nonzero(mask))
    for y, x in _masked_pixels(mask, size):
        pixels = np.zeros((size, padded, 3), np.float32)
        values = linear(images[:, y, x]) * gains[:, None, None]
        pixels[: y.size, :count] = values.swapaxes(0, 1)
        places = tuple(np.resize(p, size).astype(np.int32) for p in (y, x))
        decoded = _decode(network, encoding, pixels, places, valid)
        normals[y, x] = np.asarray(decoded)[: y.size]
        if progress is not None:
            done += y.size
            progress(done, total)
    return NormalsAndLights(normals, None if guessed is None else guessed[:count])


def padded_size(count: int) -> int:
    """The number of images that a set of `count` is padded to."""
    return next((b for b in _BUCKETS if b >= count), count)


@functools.partial(jax.jit, static_argnames="uniform_contexts")
def _encode(
    network: UniversalNetwork, views: Views, valid: Array, *, uniform_contexts: bool
) -> Encoding:
    encoding = encode(network, views, valid, **chunks.bounded(views.images.shape[1]))
    return with_uniform_contexts(encoding, views) if uniform_contexts else encoding


_decode = jax.jit(decode)


def _masked_pixels(
    mask: np.ndarray, size: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows and columns of the masked pixels, `size` at a time, the last ones fewer."""
    step = max(1, 2**18 // mask.shape[1])
    rest = np.zeros((2, 0), int)
    for top in range(0, mask.shape[0], step):
        y, x = np.nonzero(mask[top : top + step])
        rest = np.concatenate([rest, np.stack([y + top, x])], axis=1)
        while rest.shape[1] >= size:
            yield rest[0, :size], rest[1, :size]
            rest = rest[:, size:]
    if rest.size:
        yield rest[0], rest[1]
