"""`estimate_normals` for photographs: they stay on the host in their storage type."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from unips_jax.estimation.chunks import CHUNK_TOKENS
from unips_jax.estimation.frame import Frame, FrameKind, resize_weights, square_frame
from unips_jax.estimation.pure import SurfaceMaps, decode, encode
from unips_jax.io.color import Transfer, as_linear
from unips_jax.models.config import ModelConfig

# Set sizes that are compiled; a set is padded to the next.
_BUCKETS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 96, 128)


def estimate_photographs(
    params: Any,
    images: np.ndarray,
    mask: np.ndarray,
    *,
    config: ModelConfig,
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
        params: the network's parameters.
        images: `[N, H, W, 3]`, uint8, uint16 or float32.
        mask: `[H, W]`, bool.
        config: the network's configuration.
        transfer: how values encode light; "srgb" is undone first.
        frame: see `estimate_normals`.
        uniform_contexts: see `encode`.
        progress: called with the numbers of pixels done and to do.

    Returns:
        `[H, W, 3]`, float32: unit normals inside the mask, zero outside.
    """
    (normals,) = _estimate(
        params,
        images,
        mask,
        config=config,
        transfer=transfer,
        frame=frame,
        uniform_contexts=uniform_contexts,
        progress=progress,
    )
    return normals


def estimate_photograph_maps(
    params: Any,
    images: np.ndarray,
    mask: np.ndarray,
    *,
    config: ModelConfig,
    transfer: Transfer = "linear",
    frame: FrameKind = "mask",
    progress: Callable[[int, int], None] | None = None,
) -> SurfaceMaps:
    """`estimate_maps` for large photographs, as `estimate_photographs` is for normals.

    Args:
        params: parameters of a network with heads (`ModelConfig.has_maps`).
        images: see `estimate_photographs`, as the other arguments.
        mask: `[H, W]`, bool.
        config: the network's configuration.
        transfer: how values encode light.
        frame: what the encoder's square surrounds.
        progress: called with the numbers of pixels done and to do.

    Returns:
        NumPy arrays `[H, W, ...]`, float32, zero outside the mask.
    """
    maps = _estimate(
        params,
        images,
        mask,
        config=config,
        transfer=transfer,
        frame=frame,
        progress=progress,
        maps=True,
    )
    return SurfaceMaps(*maps)  # type: ignore[arg-type]


def _estimate(
    params: Any,
    images: np.ndarray,
    mask: np.ndarray,
    *,
    config: ModelConfig,
    transfer: Transfer,
    frame: FrameKind,
    progress: Callable[[int, int], None] | None,
    uniform_contexts: bool = False,
    maps: bool = False,
) -> list[np.ndarray]:
    """The arrays of `SurfaceMaps`, or the normals alone."""
    n = images.shape[0]
    bucket = padded_size(n)
    valid = np.arange(bucket) < n
    views = [(images, mask)]
    if config.mirror:
        views.append((images[:, :, ::-1], mask[:, ::-1]))
    encoded = []
    for view in views:
        # The gains are the same for both views.
        inputs, square, gains = canonical_photographs(
            *view, bucket, frame, transfer, config
        )
        contexts = _encode_jit(
            params, inputs, valid, config=config, uniform_contexts=uniform_contexts
        )
        encoded.append((contexts, square))
    contexts, square = jax.tree.map(lambda *view: jnp.stack(view), *encoded)

    # Of the arrays of `SurfaceMaps`.
    widths = ((3,), (), (3,), (), ()) if maps else ((3,),)
    results = [np.zeros((*mask.shape, *width), np.float32) for width in widths]
    size = max(1, CHUNK_TOKENS // bucket)
    done, total = 0, int(np.count_nonzero(mask))
    for y, x in _masked_pixels(mask, size):
        pixels = np.zeros((size, bucket, 3), np.float32)
        values = as_linear(images[:, y, x], transfer) * gains[:, None, None]
        pixels[: y.size, :n] = values.swapaxes(0, 1)
        places = tuple(np.resize(p, size).astype(np.int32) for p in (y, x))
        decoded = _decode_jit(
            params,
            contexts,
            pixels,
            places,
            square,
            valid,
            width=mask.shape[1],
            config=config,
            maps=maps,
        )
        for result, value in zip(results, jax.tree.leaves(decoded), strict=True):
            result[y, x] = np.asarray(value)[: y.size]
        if progress is not None:
            done += y.size
            progress(done, total)
    return results


def padded_size(count: int) -> int:
    """The number of images that a set of so many is padded to."""
    return next((b for b in _BUCKETS if b >= count), count)


_encode_jit = jax.jit(encode, static_argnames=("config", "uniform_contexts"))


_decode_jit = jax.jit(decode, static_argnames=("config", "maps"))


def canonical_photographs(
    images: np.ndarray,
    mask: np.ndarray,
    bucket: int,
    kind: FrameKind,
    transfer: Transfer,
    config: ModelConfig,
) -> tuple[np.ndarray, Frame, np.ndarray]:
    """What the encoder sees, `[bucket, s, s, 4]`, its frame, the photographs' gains.

    Args:
        images: `[N, H, W, 3]`, uint8, uint16 or float32.
        mask: `[H, W]`, bool.
        bucket: at least N.
        kind: what the frame surrounds.
        transfer: how values encode light.
        config: the network's configuration.
    """
    frame = square_frame(mask, kind)
    size = config.canonical_size
    resize = tuple(
        np.asarray(resize_weights(start, frame.side, size, length, config.antialias))
        for start, length in zip((frame.top, frame.left), mask.shape, strict=True)
    )
    inputs = np.zeros((bucket, size, size, 4), np.float32)
    gains = np.zeros(len(images), np.float32)
    for i, image in enumerate(images):
        inputs[i], gains[i] = _canonical_photograph(
            image, mask, frame, resize, transfer, config
        )
    return inputs, frame, gains


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


def _canonical_photograph(
    image: np.ndarray,
    mask: np.ndarray,
    frame: Frame,
    resize: tuple[np.ndarray, ...],
    transfer: Transfer,
    config: ModelConfig,
) -> tuple[np.ndarray, float]:
    """`normalize_images` and `canonical_images` of a photograph, a few rows at a time.

    Args:
        image: `[H, W, 3]`.
        mask: `[H, W]`.
        frame: the square that the encoder sees.
        resize: weights of the rows `[s, H]` and columns `[s, W]`.
        transfer: how values encode light.
        config: the network's configuration.

    Returns:
        What the encoder sees, `[s, s, 4]`, and the photograph's gain: one over the mean
        of its masked pixels.
    """
    size = config.canonical_size
    rows, columns = resize
    inner = slice(max(0, int(frame.left)), int(frame.left) + int(frame.side))
    columns = columns[:, inner]
    resized, total = np.zeros((size, columns.shape[1] * 4), np.float32), 0.0
    step = max(1, 2**18 // mask.shape[1])
    for start in range(0, len(mask), step):
        part = slice(start, start + step)
        inside = mask[part, inner, None]
        if not inside.any():
            continue
        values = np.where(inside, as_linear(image[part, inner], transfer), 0)
        total += float(np.sum(values, dtype=np.float64))
        values = np.concatenate([values, inside], axis=-1).reshape(len(values), -1)
        reached = np.any(rows[:, part], axis=1)
        resized[reached] += rows[reached, part] @ values
    out = columns @ resized.reshape(size, -1, 4)
    if config.antialias:
        out[..., :3] /= np.where(out[..., 3:] > 0, out[..., 3:], 1)
    gain = 3 * np.count_nonzero(mask) / total if total > 0 else 1.0

    steps = np.arange(size) * int(frame.side) // size
    y, x = int(frame.top) + steps, int(frame.left) + steps
    inside = ((y >= 0) & (y < mask.shape[0]))[:, None] & (x >= 0) & (x < mask.shape[1])
    inside &= mask.take(y, axis=0, mode="clip").take(x, axis=1, mode="clip")
    out[..., :3] *= inside[..., None] * np.float32(gain)
    out[..., 3] = inside
    return out, gain
