"""The way in and out of the classical baselines: an object's pixels as rows.

Pixels are solved in chunks of one fixed size, so that each solver compiles once per
number of images, whatever the object.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.baselines.method import Observed, Unsupported

LUMA = (0.299, 0.587, 0.114)  # BT.601
CHUNK = 16384  # pixels at once; the largest array is [CHUNK, N, 3]


def object_pixels(
    observed: Observed, *, name: str, minimum: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Checks a method's input and takes the object's pixels.

    Returns `[P, N, 3]`, float32, in row order, and the boolean mask: numbers count
    where above 0. `Unsupported`, naming the method, if there are fewer than `minimum`
    images, the mask is empty, or images are black or not finite inside it; `ValueError`
    if shapes do not fit.
    """
    images, mask = np.asarray(observed.images), np.asarray(observed.mask) > 0
    if images.ndim != 4 or images.shape[-1] != 3 or images.shape[1:3] != mask.shape:
        raise ValueError(
            f"{name}: expected images [N, H, W, 3] and mask [H, W], got "
            f"{images.shape} and {mask.shape}"
        )
    if len(images) < minimum:
        raise Unsupported(f"{name}: needs at least {minimum} images, got {len(images)}")
    if not mask.any():
        raise Unsupported(f"{name}: needs a mask of the object; this one is empty")
    pixels = np.moveaxis(images[:, mask], 0, 1).astype(np.float32)  # [P, N, 3]
    if not np.isfinite(pixels).all() or pixels.max() <= 0:
        raise Unsupported(f"{name}: the images are black or not finite inside the mask")
    return pixels, mask


def normal_map(vectors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A map of unit normals `[H, W, 3]`, zero outside the mask, of pixels' vectors.

    Zero or non-finite ones become (0, 0, 1).
    """
    vectors = np.asarray(vectors, np.float64)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    good = np.isfinite(length) & (length > 0)
    unit = np.where(good, vectors / np.where(good, length, 1), (0.0, 0.0, 1.0))
    normals = np.zeros((*mask.shape, 3), np.float32)
    normals[mask] = unit
    return normals


def map_pixels(
    function: Callable[..., Array],
    values: np.ndarray,
    directions: np.ndarray,
    **options: object,
) -> np.ndarray:
    """Applies a per-pixel solver to all pixels, a bounded chunk at a time: `[P, 3]`.

    `function`, at module level so that its compilation is kept, maps one pixel's values
    `[N]` and the directions `[N, 3]` to `[3]`; its options are hashable.
    """
    count = len(values)
    chunk = min(CHUNK, 1 << max(count - 1, 1).bit_length())
    padded = np.zeros((-(-count // chunk) * chunk, values.shape[1]), np.float32)
    padded[:count] = values
    lights = jnp.asarray(directions, jnp.float32)
    solve = _chunk_solver(function, tuple(sorted(options.items())))
    with jax.default_matmul_precision("highest"):
        parts = [
            np.asarray(solve(jnp.asarray(padded[start : start + chunk]), lights))
            for start in range(0, len(padded), chunk)
        ]
    return np.concatenate(parts)[:count]


@functools.cache
def _chunk_solver(
    function: Callable[..., Array], options: tuple[tuple[str, object], ...]
) -> Callable[[Array, Array], Array]:
    solve = functools.partial(function, **dict(options))
    return jax.jit(jax.vmap(solve, in_axes=(0, None)))
