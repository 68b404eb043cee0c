"""What the encoder sees of an object: its images, normalised, in a square frame.

Our network sees an object twice: the images, and the mirrored images; each is a view.
Views are made here from arrays, in JAX (`make_views`), and from photographs that stay
on the host in their storage type, a few rows at a time (`photograph_views`).

Source: UniPS (Ikehata, CVPR 2022), Sec. 4; the frame is ours, so that photographs need
not be square.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from unips_jax.checks import require_choice
from unips_jax.models.config import ModelConfig

FrameKind = Literal["mask", "image"]


class Frame(NamedTuple):
    """The square of the image that the encoder sees; it may leave the image."""

    top: Array
    left: Array
    side: Array


class Views(NamedTuple):
    """An object as the encoder sees it: V views, the images and the mirrored ones."""

    # [V, N, s, s, 4], normalised RGB times mask, and the mask; then nine more channels
    # where the network sees details (`detail_bands`)
    images: Array
    frame: Frame  # in the image, or in the mirrored image, [V] each
    mirrored: Array  # [V], bool
    width: Array  # columns of the image, int32
    # [V, N, 3], known ones, of mirrored images mirrored too
    lights: Array | None = None


def make_views(
    images: Array,
    mask: Array,
    config: ModelConfig,
    kind: FrameKind = "mask",
    lights: Array | None = None,
) -> Views:
    """The views of an object in arrays; differentiable by images and lights.

    `images [N, H, W, 3]` from `normalize_images`, `mask [H, W]`, known `lights [N, 3]`.
    """

    def view(step: int) -> tuple[Array, Frame]:
        inside = mask[:, ::step]
        frame = square_frame(inside, kind)
        return encoder_images(images[:, :, ::step], inside, frame, config), frame

    steps = _steps(config)
    views = [view(step) for step in steps]
    seen, frame = jax.tree.map(lambda *view: jnp.stack(view), *views)
    mirrored = jnp.array([step < 0 for step in steps])
    width = jnp.asarray(mask.shape[1], jnp.int32)
    return Views(seen, frame, mirrored, width, _in_views(lights, steps))


def photograph_views(
    images: np.ndarray,
    mask: np.ndarray,
    linear: Callable[[np.ndarray], np.ndarray],
    config: ModelConfig,
    kind: FrameKind = "mask",
    *,
    lights: np.ndarray | None = None,
    padded: int | None = None,
) -> tuple[Views, np.ndarray]:
    """`normalize_images` and `make_views` of photographs, a few rows at a time.

    `linear` gives values `[..., 3]` as linear light, float32; views get `padded`
    images, the last ones zero. Also returns the gains `[N]`: one over each photograph's
    mean over masked pixels and channels. Nothing here runs in JAX: for a new size of
    photographs it would compile first.
    """
    size, steps = config.canonical_size, _steps(config)
    shape = (len(steps), padded or len(images), size, size, config.input_channels)
    sizes = (size, 2 * size) if config.sees_details else (size,)
    seen, gains = np.zeros(shape, np.float32), np.ones(len(images), np.float32)
    frames = []
    for v, step in enumerate(steps):
        inside = mask[:, ::step]
        frame = square_frame(inside, kind)
        weights = tuple(
            np.concatenate(
                [
                    resize_weights(start, frame.side, s, n, config.antialias)
                    for s in sizes
                ]
            )
            for start, n in zip((frame.top, frame.left), mask.shape, strict=True)
        )
        for i, image in enumerate(images):
            resized, total = _resized(image[:, ::step], inside, frame, weights, linear)
            if total > 0:
                gains[i] = 3 * np.count_nonzero(mask) / total
            parts = (resized[:size, :size], resized[size:, size:])[: len(sizes)]
            gain, antialias = gains[i], config.antialias
            seen[v, i] = _with_details(
                *(_seen(part, inside, frame, gain, antialias) for part in parts)
            )
        frames.append(frame)
    frame = jax.tree.map(lambda *view: np.stack(view), *frames)
    mirrored, width = np.array([step < 0 for step in steps]), np.int32(mask.shape[1])
    if lights is not None:
        lights = np.concatenate([lights, np.zeros((shape[1] - len(lights), 3))])
        lights = _in_views(lights.astype(np.float32), steps)
    return Views(*cast(Any, (seen, frame, mirrored, width, lights))), gains


def _steps(config: ModelConfig) -> tuple[int, ...]:
    """Of the columns in each view."""
    return (1, -1) if config.mirror else (1,)


def _in_views(lights: Any, steps: tuple[int, ...]) -> Any:
    """Lights `[N, 3]` as each view has them: `[V, N, 3]`; None stays None."""
    if lights is None:
        return None
    signs = np.array([[[step, 1, 1]] for step in steps], np.float32)
    return lights[None] * signs


def square_frame(mask: ArrayLike, kind: FrameKind = "mask") -> Frame:
    """The smallest square around the mask or the image, centred on it.

    Of an empty mask it is the image's; NumPy's integers for a NumPy mask. `ValueError`
    if `kind` is neither.
    """
    require_choice("frame", kind, get_args(FrameKind))
    xp = _numpy_of(mask)
    inside = xp.asarray(mask).astype(bool)
    if kind == "image":
        inside = xp.ones_like(inside)
    inside = inside | ~xp.any(inside)
    starts, sizes = [], []
    for axis in (1, 0):
        line = xp.any(inside, axis=axis)
        start, stop = xp.argmax(line), line.size - xp.argmax(line[::-1])
        starts.append(start)
        sizes.append(stop - start)
    side = xp.maximum(*sizes)
    top, left = (
        start + (size - side) // 2 for start, size in zip(starts, sizes, strict=True)
    )
    return Frame(*(x.astype(np.int32) for x in (top, left, side)))


def context_cells(
    rows: Array, columns: Array, frame: Frame, config: ModelConfig
) -> tuple[Array, Array]:
    """Where pixels `[P]` of the image lie on the contexts' grid, in cells, `[P]` each.

    0 is the centre of the first cell, or the first node.
    """
    offset = 0.0 if config.reads_at_corners else 0.5
    # Of cells the first one's centre is place 0, of nodes the first one, at the border.
    nodes = config.sees_details
    cells, first = config.context_size - nodes, 0.0 if nodes else 0.5
    scale = cells / frame.side.astype(float)
    return (
        ((rows - frame.top).astype(float) + offset) * scale - first,
        ((columns - frame.left).astype(float) + offset) * scale - first,
    )


def normalize_images(images: Array, mask: Array) -> Array:
    """Divides images `[N, H, W, 3]` by their means over the mask; zero outside."""
    inside = mask.astype(bool)[..., None]
    means = image_means(images, mask)
    return jnp.where(inside[None], images, 0) / means[:, None, None, None]


def image_means(images: Array, mask: Array) -> Array:
    """Each image's mean over masked pixels and channels, 1 where that is 0: `[N]`."""
    inside = mask.astype(bool)[..., None]
    count = jnp.maximum(jnp.sum(inside) * images.shape[-1], 1)
    total = jnp.sum(jnp.where(inside[None], images, 0), axis=(1, 2, 3))
    mean = total / count.astype(images.dtype)
    return jnp.where(mean > 0, mean, 1)


def canonical_images(
    images: Array, mask: Array, frame: Frame, size: int, antialias: bool = False
) -> Array:
    """The frame's part of the images, resized for the encoder: `[N, s, s, 4]`.

    Bilinear with half-pixel centres; as a product with the separable weights, which
    moves with the frame and has cheap gradients. With antialiasing, what falls between
    the cells is averaged, over the mask only. The last channel is the mask.
    """
    dtype, (height, width) = images.dtype, mask.shape
    rows = resize_weights(frame.top, frame.side, size, height, antialias, dtype)
    columns = resize_weights(frame.left, frame.side, size, width, antialias, dtype)
    resized = jnp.einsum("ih,nhwc,jw->nijc", rows, images, columns, optimize=True)
    steps = jnp.arange(size) * frame.side // size
    inside = (
        mask.astype(dtype)
        .at[frame.top + steps]
        .get(mode="fill", fill_value=0, wrap_negative_indices=False)
    )
    inside = inside.at[:, frame.left + steps].get(
        mode="fill", fill_value=0, wrap_negative_indices=False
    )
    inside = (inside > 0).astype(dtype)[None, :, :, None]
    if antialias:
        covered = jnp.einsum("ih,hw,jw->ij", rows, mask.astype(dtype), columns)
        resized /= jnp.where(covered > 0, covered, 1)[None, ..., None]
    return jnp.concatenate(
        [resized * inside, jnp.broadcast_to(inside, (*resized.shape[:-1], 1))], axis=-1
    )


def encoder_images(
    images: Array, mask: Array, frame: Frame, config: ModelConfig
) -> Array:
    """What the encoder sees in a frame: `[N, s, s, 4]`, and details if it sees any."""
    sizes = (1, 2) if config.sees_details else (1,)
    size, antialias = config.canonical_size, config.antialias
    seen = (canonical_images(images, mask, frame, n * size, antialias) for n in sizes)
    return _with_details(*seen)


def detail_bands(twice: Any) -> Any:
    """The Haar bands of larger images: `[..., 2s, 2s, 4]` to `[..., s, s, 9]`.

    Differences across columns, across rows and across diagonals, zero where the mask
    (the last channel) leaves out one of the four pixels.
    """
    *sets, height, width, channels = twice.shape
    x = twice.reshape(*sets, height // 2, 2, width // 2, 2, channels)
    (a, b), (c, d) = ([x[..., i, :, j, :] for j in (0, 1)] for i in (0, 1))
    inside = a[..., 3:] * b[..., 3:] * c[..., 3:] * d[..., 3:]
    bands = (a - b + c - d, a + b - c - d, a - b - c + d)
    xp = _numpy_of(twice)
    return xp.concatenate([inside * band[..., :3] for band in bands], axis=-1) / 2


def _with_details(images: Any, twice: Any = None) -> Any:
    if twice is None:
        return images
    return _numpy_of(images).concatenate([images, detail_bands(twice)], axis=-1)


def resize_weights(
    start: Array,
    side: Array,
    size: int,
    length: int,
    antialias: bool,
    dtype: Any = np.float32,
) -> Array:
    """Bilinear weights of an axis' pixels for a stretch in cells: `[size, length]`.

    Rows sum to 1 where nothing of their reach is cut off; NumPy's for a NumPy start.
    Antialiasing widens them to the cells where these are larger than pixels.
    """
    xp = _numpy_of(start)
    start, side = xp.asarray(start, dtype), xp.asarray(side, dtype)
    scale = side / size
    places = (xp.arange(size, dtype=dtype) + 0.5) * scale - 0.5
    places = start + xp.clip(places, 0, side - 1)
    distance = xp.abs(places[:, None] - xp.arange(length, dtype=dtype)[None])
    reach = xp.maximum(scale, 1) if antialias else 1
    return xp.maximum(1 - distance / reach, 0) / reach


def _numpy_of(x: Any) -> Any:
    """NumPy for what is on the host, so that nothing is compiled; else JAX's."""
    return np if isinstance(x, np.ndarray | np.generic) else jnp


def _resized(
    image: np.ndarray,
    mask: np.ndarray,
    frame: Frame,
    weights: tuple[Any, ...],
    linear: Callable[[np.ndarray], np.ndarray],
) -> tuple[np.ndarray, float]:
    """A photograph's masked light in cells `[s, s, 4]`, and its sum over pixels."""
    # The last channel is how far the mask covers a cell.
    rows, columns = weights
    inner = slice(max(0, int(frame.left)), int(frame.left) + int(frame.side))
    columns = columns[:, inner]
    resized, total = np.zeros((len(rows), columns.shape[1] * 4), np.float32), 0.0
    step = max(1, 2**18 // mask.shape[1])
    for start in range(0, len(mask), step):
        part = slice(start, start + step)
        inside = mask[part, inner, None]
        if not inside.any():
            continue
        values = np.where(inside, linear(image[part, inner]), 0)
        total += float(np.sum(values, dtype=np.float64))
        values = np.concatenate([values, inside], axis=-1).reshape(len(values), -1)
        reached = np.any(rows[:, part], axis=1)
        resized[reached] += rows[reached, part] @ values
    return columns @ resized.reshape(len(rows), -1, 4), total


def _seen(
    resized: np.ndarray, mask: np.ndarray, frame: Frame, gain: float, antialias: bool
) -> np.ndarray:
    """What `canonical_images` gives, from `_resized`: `[s, s, 4]`."""
    size, (height, width) = len(resized), mask.shape
    if antialias:
        resized[..., :3] /= np.where(resized[..., 3:] > 0, resized[..., 3:], 1)
    steps = np.arange(size) * int(frame.side) // size
    y, x = int(frame.top) + steps, int(frame.left) + steps
    inside = ((y >= 0) & (y < height))[:, None] & (x >= 0) & (x < width)
    inside &= mask.take(y, axis=0, mode="clip").take(x, axis=1, mode="clip")
    resized[..., :3] *= inside[..., None] * np.float32(gain)
    resized[..., 3] = inside
    return resized
