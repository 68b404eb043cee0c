"""`estimate_normals` for photographs: they stay on the host in their storage type."""

import functools
import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar, get_args

import jax
import numpy as np
from jax import Array

from unips_jax.checks import require, require_choice
from unips_jax.estimation.programs import default_device, kept
from unips_jax.io.color import Transfer, as_linear, usual_transfer
from unips_jax.models import chunks
from unips_jax.models.config import check_lights
from unips_jax.models.network import (
    Encoding,
    Lamps,
    UniversalNetwork,
    check_images,
    check_mask,
    decode,
    encode,
    guessed_lamps,
    guessed_lights,
    with_uniform_contexts,
)
from unips_jax.models.views import FrameKind, Views, photograph_views

Progress = Callable[[int, int], None]
Preview = Callable[[np.ndarray], None]
"""Called with normals of a coarse grid, `[h, w, 3]`, zero outside the mask."""

_PREVIEW_CHUNKS = 8
_STRIP = 2**20  # pixels of the photographs
_T = TypeVar("_T")
_R = TypeVar("_R")

# Set sizes that are compiled; a set is padded to the next.
_BUCKETS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48, 64, 80, 96, 128)


class NormalsAndLights(NamedTuple):
    """What the network makes of photographs."""

    normals: np.ndarray  # `[H, W, 3]`, float32: unit inside the mask, zero outside
    # `[N, 3]`, float32, see `guessed_lights`; None from a network that makes no guesses
    lights: np.ndarray | None
    lamps: Lamps | None = None  # from a network that has tokens for kinds of light


def estimate_photographs(
    network: UniversalNetwork,
    images: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    transfer: Transfer | None = None,
    frame: FrameKind = "mask",
    lights: np.ndarray | None = None,
    fast: bool = False,
    uniform_contexts: bool = False,
    progress: Progress | None = None,
) -> np.ndarray:
    """`estimate_normals` for large photographs, which stay in their storage type.

    Gives what `estimate_normals` gives for the linear images, to float order. Memory
    beyond `images`, `mask` and the result does not grow with the number of pixels, and
    with the number of images only by their contexts. Sets are padded to a few sizes, so
    that one compilation serves many.

    Args:
        network: from `load_weights`.
        images: `[N, H, W, 3]`, uint8, uint16 or floats, for "srgb" in [0, 1].
        mask: `[H, W]`, not 0 on the object; None for all of the image.
        transfer: how values encode light; "srgb" is undone first. None: "srgb" of 8
            bits, else "linear", as files without a tag are read.
        frame: see `estimate_normals`.
        lights: see `estimate_normals`.
        fast: decode the mirrored view at few pixels (one in 16 of objects of 384 pixels
            or more, all below 192), in 60 to 70 % of the time. What it costs in degrees
            is in docs/results.md.
        uniform_contexts: an ablation, see `with_uniform_contexts`.
        progress: called with the numbers of pixels done and to do.

    Returns:
        `[H, W, 3]`, float32: unit normals inside the mask, zero outside.

    Raises:
        TypeError: if the network is not one.
        ValueError: if shapes or types do not fit, or transfer or frame is unknown.
    """
    found = estimate_with_lights(
        network,
        images,
        mask,
        transfer=transfer,
        frame=frame,
        lights=lights,
        fast=fast,
        uniform_contexts=uniform_contexts,
        progress=progress,
    )
    return found.normals


def estimate_with_lights(
    network: UniversalNetwork,
    images: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    transfer: Transfer | None = None,
    frame: FrameKind = "mask",
    lights: np.ndarray | None = None,
    fast: bool = False,
    uniform_contexts: bool = False,
    progress: Progress | None = None,
    preview: Preview | None = None,
) -> NormalsAndLights:
    """`estimate_photographs`, and the guessed lights; `preview` gets a coarse grid."""
    images = np.asarray(images)
    if images.dtype.kind == "V" and jax.numpy.issubdtype(images.dtype, np.floating):
        images = images.astype(np.float32)  # bfloat16, which NumPy does not know
    check_images(network, images.shape)
    require(
        images.dtype.kind in "uf",
        f"images: expected uint8, uint16 or floats, got {images.dtype}",
    )
    mask = np.ones(images.shape[1:3]) if mask is None else np.asarray(mask)
    mask = mask.astype(bool)
    check_mask(mask.shape, images.shape)
    transfer = usual_transfer(images.dtype) if transfer is None else transfer
    require_choice("transfer", transfer, get_args(Transfer))
    network = jax.device_put(network, default_device())
    if lights is not None:
        lights = np.asarray(lights)
        check_lights(network.config, lights.shape, len(images))
        require(
            bool(np.isfinite(lights).all()),
            "lights: expected finite numbers, 0 for what is not known, got others",
        )
    count, padded = len(images), padded_size(len(images))
    valid = np.arange(padded) < count
    linear = functools.partial(as_linear, transfer=transfer)
    views, gains = photograph_views(
        images, mask, linear, network.config, frame, lights=lights, padded=padded
    )
    contexts, *guessed = _encode(network, views, valid, uniform=uniform_contexts)
    own, *lamps = (np.asarray(x)[:count] for x in guessed) if guessed else (None,)
    encoding = Encoding(contexts, *views[1:4])

    def values(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Normalised pixels `[P, padded, 3]`."""
        pixels = np.zeros((y.size, padded, 3), np.float32)
        with np.errstate(invalid="ignore"):  # infinity in a black image is NaN
            seen = linear(images[:, y, x]) * gains[:, None, None]
        pixels[:, :count] = seen.swapaxes(0, 1)
        return pixels

    decoder = functools.partial(_decode_pixels, network, values=values, valid=valid)
    if preview is not None:
        _show_coarse(preview, decoder, encoding, mask)
    if fast and len(contexts) > 1:
        normals = _decode_fast(decoder, encoding, mask, progress)
    else:
        normals = decoder(encoding, mask, progress=progress)
    return NormalsAndLights(normals, own, Lamps(*lamps) if lamps else None)


def _decode_pixels(
    network: UniversalNetwork,
    encoding: Encoding,
    mask: np.ndarray,
    *,
    values: Callable[[np.ndarray, np.ndarray], np.ndarray],
    valid: np.ndarray,
    every: int = 1,
    progress: Progress | None = None,
) -> np.ndarray:
    """Normals of the masked pixels, `[H, W, 3]`, a chunk on every core at a time.

    With `every` above 1 only of every such row and column (see `_grid`).
    """
    mask = mask[_grid(every)]
    normals = np.zeros((*mask.shape, 3), np.float32)
    size = chunks.pixels_at_a_time(encoding.contexts)
    done, total = 0, int(np.count_nonzero(mask))
    if not total:
        return normals
    first = np.zeros(size, np.int32)
    # Here, since settings that hold for a block are those of this thread alone.
    example = values(first, first), (first, first)
    decode_chunk = _decode.compiled(network, encoding, *example, valid)

    def decoded(place: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        y, x = (np.resize(every * p + every // 2, size).astype(np.int32) for p in place)
        (found,) = decode_chunk(network, encoding, values(y, x), (y, x), valid)
        return np.asarray(found)

    for (y, x), found in _side_by_side(decoded, _masked_pixels(mask, size)):
        normals[y, x] = found[: y.size]
        if progress is not None:
            done += y.size
            progress(done, total)
    return normals


def _grid(every: int) -> tuple[slice, slice]:
    """Rows and columns in the middle of squares of pixels."""
    return (slice(every // 2, None, every),) * 2


def _show_coarse(
    preview: Preview,
    decoder: Callable[..., np.ndarray],
    encoding: Encoding,
    mask: np.ndarray,
) -> None:
    """Decodes a few chunks of pixels on a grid, if that is little of the work."""
    pixels = _PREVIEW_CHUNKS * chunks.pixels_at_a_time(encoding.contexts)
    step = max(4, math.ceil((np.count_nonzero(mask) / pixels) ** 0.5))
    if mask[_grid(step)].any():
        preview(decoder(encoding, mask, every=step))


def _decode_fast(
    decoder: Callable[..., np.ndarray],
    encoding: Encoding,
    mask: np.ndarray,
    progress: Progress | None,
) -> np.ndarray:
    """The mean over both views, of which the second is decoded at few pixels."""
    # What it changes is smooth: it is spread from one pixel in 16 to those around.
    from scipy import ndimage

    step = min(4, int(encoding.frame.side[0]) // 96)
    if step < 2:  # few pixels would not be fewer
        return decoder(encoding, mask, progress=progress)
    seen, mirrored = (_view(encoding, index) for index in (0, 1))
    normals = decoder(seen, mask, progress=progress)
    grid = _grid(step)
    change = decoder(mirrored, mask, every=step)
    change -= np.where(mask[grid][..., None], normals[grid], 0)
    # A strip of rows at a time, with what reaches into it: no second picture is held.
    height, width = mask.shape
    rows = step * max(16, _STRIP // (step * width))
    for top in range(0, height, rows):
        first, last = max(top - 4 * step, 0), min(top + rows + 4 * step, height)
        few = np.zeros((last - first, width, 4), np.float32)
        seeds = few[grid]
        seeds[..., :3] = change[first // step :][: len(seeds)]
        seeds[..., 3] = mask[first:last][grid]
        spread = ndimage.gaussian_filter(few, 0.6 * step, axes=(0, 1))
        spread = spread[top - first :][:rows]
        part, weight = normals[top : top + rows], spread[..., 3:]
        spread = spread[..., :3] / np.maximum(weight, 1e-4)
        total = 2 * part + np.where(weight > 1e-4, spread, 0)
        length = np.linalg.norm(total, axis=-1, keepdims=True)
        inside = mask[top : top + rows, :, None]
        part[...] = np.where(inside, total / np.maximum(length, 1e-12), 0)
    return normals


def _view(encoding: Encoding, index: int) -> Encoding:
    """One view of an encoding."""
    part = slice(index, index + 1)
    frame, mirrored = jax.tree.map(
        lambda x: x[part], (encoding.frame, encoding.mirrored)
    )
    return encoding._replace(
        contexts=encoding.contexts[part], frame=frame, mirrored=mirrored
    )


def _side_by_side(
    function: Callable[[_T], _R], items: Iterable[_T]
) -> Iterator[tuple[_T, _R]]:
    """Items and results, in order, with a thread for every core."""
    # One call alone does not keep two cores busy: its products are small.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
    with ThreadPoolExecutor(min(cores, 8)) as pool:
        running: deque[tuple[_T, Future[_R]]] = deque()
        try:
            for item in items:
                running.append((item, pool.submit(function, item)))
                if len(running) > 2 * min(cores, 8):
                    first, future = running.popleft()
                    yield first, future.result()
            while running:
                first, future = running.popleft()
                yield first, future.result()
        finally:
            for _, future in running:
                future.cancel()


def padded_size(count: int) -> int:
    """The number of images that a set of `count` is padded to."""
    return next((b for b in _BUCKETS if b >= count), count)


@functools.partial(kept, rarely_run=True)
def _encode(
    network: UniversalNetwork, views: Views, valid: Array, *, uniform: bool
) -> tuple[Array, ...]:
    """Contexts, and what the network guesses of lights, then of lamps."""
    encoding = encode(network, views, valid, **chunks.bounded(views.images.shape[1]))
    guesses: list[Array] = []
    lights, lamps = guessed_lights(encoding), guessed_lamps(encoding, views.lights)
    if lights is not None:
        guesses = [lights, *(lamps or ())]
    if uniform:
        encoding = with_uniform_contexts(encoding, views)
    return (encoding.contexts, *guesses)


@kept
def _decode(*arguments: Any) -> tuple[Array]:
    return (decode(*arguments),)


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
