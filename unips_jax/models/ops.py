"""Pure array functions the network is built from. Arrays are channels-last."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.typing import DTypeLike

# Up to this many inputs of a strided convolution's output they are copied together.
_FEW_INPUTS = 64


def wide_dtype(dtype: DTypeLike) -> np.dtype:
    """The type for softmax, norms and sums: float32, or float64 if that is given."""
    return np.dtype(np.float64 if jnp.dtype(dtype) == np.float64 else np.float32)


def leading(x: Array, ndim: int) -> Array:
    """Adds axes of length 1 before the others, up to `ndim`, to broadcast by."""
    return x.reshape((1,) * (ndim - x.ndim) + x.shape)


def known(condition: Callable[[], Any]) -> bool:
    """Whether a condition on shapes holds; False if unknown, as under `jax.export`."""
    try:
        return bool(condition())
    except jax.errors.InconclusiveDimensionOperation:
        return False


def resize_bilinear(x: Array, size: Sequence[int]) -> Array:
    """Resizes `[..., H, W, C]` with half-pixel centres and no antialiasing."""
    shape = (*x.shape[:-3], *size, x.shape[-1])
    return jax.image.resize(x, shape, "linear", antialias=False)


def resize_mask_nearest(mask: Array, size: tuple[int, int]) -> Array:
    """Resizes `[..., H, W]` by taking source index `floor(i * H / size)`."""
    height, width = mask.shape[-2:]
    rows = np.arange(size[0]) * height // size[0]
    columns = np.arange(size[1]) * width // size[1]
    return mask[..., rows[:, None], columns[None, :]]


def adaptive_average_matrix(size: int, bins: int) -> np.ndarray:
    """Weights of adaptive average pooling along one axis, `[bins, size]`.

    Bin i averages the cells from floor(i * size / bins) to ceil((i + 1) * size / bins).
    """
    weights = np.zeros((bins, size), np.float32)
    for i in range(bins):
        start, stop = i * size // bins, -(-(i + 1) * size // bins)
        weights[i, start:stop] = 1 / (stop - start)
    return weights


def adaptive_average_pool(x: Array, bins: int) -> Array:
    """Averages `[..., H, W, C]` over a grid of bins: `[..., bins, bins, C]`."""
    rows = adaptive_average_matrix(x.shape[-3], bins).astype(x.dtype)
    columns = adaptive_average_matrix(x.shape[-2], bins).astype(x.dtype)
    return jnp.einsum("ih,jw,...hwc->...ijc", rows, columns, x)


def window_partition(x: Array, window_size: int) -> Array:
    """Cuts maps `[B, H, W, C]` into windows `[B * windows, window_size**2, C]`."""
    b, h, w, c = x.shape
    x = x.reshape(b, h // window_size, window_size, w // window_size, window_size, c)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(-1, window_size**2, c)


def window_reverse(windows: Array, height: int, width: int) -> Array:
    """Puts the windows of `window_partition` back together: `[B, H, W, C]`."""
    window_size = round(windows.shape[1] ** 0.5)
    rows, columns = height // window_size, width // window_size
    x = windows.reshape(-1, rows, columns, window_size, window_size, windows.shape[-1])
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(-1, height, width, windows.shape[-1])


def shift_mask(
    height: int, width: int, window_size: int, shift_size: int
) -> np.ndarray:
    """What shifted windows add to logits: -100 between regions (Swin, Sec. 3.2).

    For a (padded) map that was rolled: `[windows, window_size**2, window_size**2]`.
    """

    def regions(size: int) -> np.ndarray:
        index = np.arange(size)
        return (index >= size - window_size) * 1 + (index >= size - shift_size) * 1

    labels = 3 * regions(height)[:, None] + regions(width)[None, :]
    x = labels.reshape(height // window_size, window_size, -1, window_size)
    x = x.transpose(0, 2, 1, 3).reshape(-1, window_size**2)
    return np.where(x[:, :, None] == x[:, None, :], 0.0, -100.0).astype(np.float32)


def relative_position_index(window_size: int) -> np.ndarray:
    """The row in the bias table of every pair of tokens in a window: `[w**2, w**2]`."""
    y, x = np.divmod(np.arange(window_size**2), window_size)
    dy = y[:, None] - y[None, :] + window_size - 1
    dx = x[:, None] - x[None, :] + window_size - 1
    return dy * (2 * window_size - 1) + dx


def bilinear_sample(grid: Array, rows: Array, columns: Array, *, zeros: bool) -> Array:
    """Reads `[h, w, ...]` at P places, in cells; 0 is the first cell's centre.

    Beyond the border are zeros, or with `zeros=False` the values at the border.
    """
    h, w = grid.shape[:2]
    rows, columns = jnp.asarray(rows), jnp.asarray(columns)
    if not zeros:
        rows = jnp.clip(rows, 0, h - 1)
        columns = jnp.clip(columns, 0, w - 1)
    flat = grid.reshape(h * w, -1)
    top, left = jnp.floor(rows), jnp.floor(columns)
    total = jnp.zeros((), grid.dtype)
    for dy in (0, 1):
        for dx in (0, 1):
            y, x = top + dy, left + dx
            weight = (1 - abs(rows - y)) * (1 - abs(columns - x))
            inside = (y >= 0) & (y < h) & (x >= 0) & (x < w)
            index = jnp.clip(y, 0, h - 1) * w + jnp.clip(x, 0, w - 1)
            corner = jnp.take(flat, index.astype(jnp.int32), axis=0)
            weight = jnp.where(inside, weight, 0).astype(grid.dtype)
            total = total + corner * weight[:, None]
    return total.reshape(-1, *grid.shape[2:])


def convolution(
    x: Array,
    kernel: Array,
    strides: Sequence[int],
    padding: Sequence[tuple[int, int]],
    **options: Any,
) -> Array:
    """`jax.lax.conv_general_dilated` for `nn.Conv` to call: fast to train on CPU.

    The value is the library's. The derivative by the kernel is a sum of plain products,
    one per cell of the kernel: as a convolution, its transpose is up to ten times
    slower on CPU. `ValueError` for dilations and groups.
    """
    for name in ("lhs_dilation", "rhs_dilation", "feature_group_count"):
        value = options.get(name, 1)
        if np.any(np.asarray(value) != 1):
            raise ValueError(f"{name}: expected 1, got {value}")
    return _convolution(x, kernel, tuple(strides), tuple(padding))


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _convolution(x: Array, kernel: Array, strides: Any, padding: Any) -> Array:
    numbers = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(
        x, kernel, strides, padding, dimension_numbers=numbers
    )


@functools.partial(_convolution.defjvp, symbolic_zeros=True)
def _convolution_jvp(strides: Any, padding: Any, primals: Any, tangents: Any) -> Any:
    (x, kernel), (dx, dkernel) = primals, tangents
    y = _convolution(x, kernel, strides, padding)
    dy = jnp.zeros_like(y)
    if not isinstance(dx, SymbolicZero):
        dy += _convolution(dx, kernel, strides, padding)
    if isinstance(dkernel, SymbolicZero):
        return y, dy
    if strides == (1, 1):
        return y, dy + _by_cells(x, dkernel, padding)
    if kernel[..., 0].size <= _FEW_INPUTS:
        return y, dy + _by_patches(x, dkernel, strides, padding, y.shape)
    return y, dy + _convolution(x, dkernel, strides, padding)


def _by_cells(x: Array, dkernel: Array, padding: Any) -> Array:
    """A product for each cell of the kernel, shifted: the convolution of stride 1."""
    pixels, dy = x.reshape(-1, x.shape[-1]), jnp.zeros((), x.dtype)
    columns = pixels.T
    if jax.default_backend() == "cpu":  # one transpose for all cells: a third less time
        columns = jax.lax.optimization_barrier(columns)
    for i, j in np.ndindex(dkernel.shape[:2]):
        product = jax.lax.dot_general(columns, dkernel[i, j], (((0,), (0,)), ((), ())))
        product = product.reshape(*x.shape[:3], -1)
        shifts = (
            (before - k, after + k + 1 - size, 0)
            for k, size, (before, after) in zip(
                (i, j), dkernel.shape[:2], padding, strict=True
            )
        )
        zero = jnp.zeros((), product.dtype)
        dy += jax.lax.pad(product, zero, ((0, 0, 0), *shifts, (0, 0, 0)))
    return dy


def _by_patches(
    x: Array, dkernel: Array, strides: Any, padding: Any, shape: tuple[int, ...]
) -> Array:
    """One product with all that the kernel sees from each place: few channels only."""
    x = jnp.pad(x, ((0, 0), *padding, (0, 0)))
    _, height, width, _ = shape
    seen = [
        x[:, i : i + height * strides[0] : strides[0]][
            :, :, j : j + width * strides[1] : strides[1]
        ]
        for i, j in np.ndindex(dkernel.shape[:2])
    ]
    patches = jnp.concatenate(seen, axis=-1)
    patches = patches.reshape(-1, patches.shape[-1])
    flat = dkernel.reshape(-1, dkernel.shape[-1])
    return (patches @ flat).reshape(shape)


def normalize(x: Array) -> Array:
    """Divides `[..., 3]` by its length, in float32, with finite gradients at zero.

    Zero where `x` is shorter than 1e-12, NaN where its squared length is not finite.
    """
    x = x.astype(wide_dtype(x.dtype))
    squared = jnp.sum(jnp.square(x), axis=-1, keepdims=True)
    zero = squared <= 1e-12**2  # false for NaN
    unit = jnp.where(zero, 0.0, x * jax.lax.rsqrt(jnp.where(zero, 1.0, squared)))
    # NaN by a difference: a constant one would stop a search for where they begin.
    return jnp.where(jnp.isfinite(squared), unit, squared - squared)


def gelu(x: Array) -> Array:
    """The exact GELU, x times the normal distribution function."""
    # Through erf: `jax.nn.gelu` takes erfc, which costs four times as much on CPU and
    # gains digits only where the result is next to zero.
    return x * (0.5 + 0.5 * jax.lax.erf(x * np.asarray(0.5**0.5, x.dtype)))


def largest(x: Array, axis: int) -> Array:
    """The maximum along an axis, with one element's gradient."""
    # The gradient of `jnp.max` is shared by the elements that equal the maximum. Where
    # a compiler computes those anew, a digit apart, there is none, and it becomes NaN.
    indices = jax.lax.broadcasted_iota(jnp.int32, x.shape, axis % x.ndim)
    first = jnp.argmax(x, axis=axis, keepdims=True).astype(jnp.int32)
    return jnp.sum(jnp.where(indices == first, x, 0), axis=axis)


def sinusoids(height: int, width: int) -> Array:
    """Sines and cosines of a grid's rows and columns, `[height, width, 16]`.

    Four octaves of each: the longest period is twice the side, each next one half.
    """

    def waves(size: int) -> Array:
        centres = (jnp.arange(size, dtype=jnp.float32) + 0.5) / size
        phases = jnp.pi * centres[:, None] * np.array([[1, 2, 4, 8]], np.float32)
        return jnp.concatenate([jnp.sin(phases), jnp.cos(phases)], axis=-1)

    rows = jnp.broadcast_to(waves(height)[:, None], (height, width, 8))
    columns = jnp.broadcast_to(waves(width)[None], (height, width, 8))
    return jnp.concatenate([rows, columns], axis=-1)
