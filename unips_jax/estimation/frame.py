"""What the encoder sees of an object: its images, normalised, in a square frame.

Source: UniPS (Ikehata, CVPR 2022), Sec. 4; the frame is ours, so that photographs need
not be square.
"""

from typing import Any, Literal, NamedTuple, get_args

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from unips_jax.checks import require_choice
from unips_jax.models.config import ModelConfig

FrameKind = Literal["mask", "image"]


class Frame(NamedTuple):
    """The square of the image that the encoder sees; it may leave the image.

    Attributes:
        top: row of its first pixel.
        left: column of its first pixel.
        side: its side in pixels.
    """

    top: Array
    left: Array
    side: Array


def square_frame(mask: ArrayLike, kind: FrameKind = "mask") -> Frame:
    """The smallest square around the mask or the image, centred on it.

    Args:
        mask: `[H, W]`, non-zero on the object.
        kind: "mask" or "image"; an empty mask gives the image's square.

    Returns:
        The frame, integers.

    Raises:
        ValueError: if `kind` is neither.
    """
    require_choice("frame", kind, get_args(FrameKind))
    mask = jnp.asarray(mask).astype(bool)
    inside = mask if kind == "mask" else jnp.ones_like(mask)
    inside = inside | ~jnp.any(inside)
    starts, sizes = [], []
    for axis in (1, 0):
        line = jnp.any(inside, axis=axis)
        start, stop = jnp.argmax(line), line.size - jnp.argmax(line[::-1])
        starts.append(start)
        sizes.append(stop - start)
    side = jnp.maximum(*sizes)
    top, left = (
        start + (size - side) // 2 for start, size in zip(starts, sizes, strict=True)
    )
    return Frame(top, left, side)


def context_cells(
    rows: Array, columns: Array, frame: Frame, config: ModelConfig
) -> tuple[Array, Array]:
    """Where pixels lie on the grid of the contexts of a frame.

    Args:
        rows: of the pixels in the image, `[P]`, integers.
        columns: likewise.
        frame: what was encoded.
        config: the network's configuration.

    Returns:
        Rows and columns in cells, `[P]` each; 0 is the centre of the first cell.
    """
    offset = 0.0 if config.reads_at_corners else 0.5
    scale = config.context_size / frame.side.astype(float)
    return (
        ((rows - frame.top).astype(float) + offset) * scale - 0.5,
        ((columns - frame.left).astype(float) + offset) * scale - 0.5,
    )


def normalize_images(images: Array, mask: Array) -> Array:
    """Divides each image by its mean over masked pixels and channels; zero outside.

    Args:
        images: `[N, H, W, 3]`.
        mask: `[H, W]`.

    Returns:
        `[N, H, W, 3]`; an all-black image stays black.
    """
    inside = mask.astype(bool)[..., None]
    means = image_means(images, mask)
    return jnp.where(inside[None], images, 0) / means[:, None, None, None]


def image_means(images: Array, mask: Array) -> Array:
    """Each image's mean over masked pixels and channels, or 1 where that is 0: `[N]`.

    Args:
        images: `[N, H, W, 3]`.
        mask: `[H, W]`.
    """
    inside = mask.astype(bool)[..., None]
    count = jnp.maximum(jnp.sum(inside) * images.shape[-1], 1)
    total = jnp.sum(jnp.where(inside[None], images, 0), axis=(1, 2, 3))
    mean = total / count.astype(images.dtype)
    return jnp.where(mean > 0, mean, 1)


def canonical_images(
    images: Array, mask: Array, frame: Frame, size: int, antialias: bool = False
) -> Array:
    """The frame's part of the images, resized for the encoder.

    Bilinear with half-pixel centres; as a product with the separable weights, which
    moves with the frame and has cheap gradients.

    Args:
        images: `[N, H, W, 3]`, normalised, zero outside the mask.
        mask: `[H, W]`.
        frame: which square.
        size: the canonical size s.
        antialias: average what falls between the cells, over the mask only.

    Returns:
        `[N, s, s, 4]`: images times mask, and the mask.
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


def resize_weights(
    start: Array,
    side: Array,
    size: int,
    length: int,
    antialias: bool,
    dtype: Any = jnp.float32,
) -> Array:
    """Bilinear weights of an axis' pixels for the cells that a stretch becomes.

    Args:
        start: the stretch's first pixel.
        side: its length in pixels.
        size: how many cells it becomes.
        length: pixels of the axis.
        antialias: widen the weights to the cells where these are larger than pixels.
        dtype: of the weights.

    Returns:
        `[size, length]`; rows sum to 1 where nothing of their reach is cut off.
    """
    start, side = jnp.asarray(start, dtype), jnp.asarray(side, dtype)
    scale = side / size
    places = (jnp.arange(size, dtype=dtype) + 0.5) * scale - 0.5
    places = start + jnp.clip(places, 0, side - 1)
    distance = jnp.abs(places[:, None] - jnp.arange(length, dtype=dtype)[None])
    reach = jnp.maximum(scale, 1) if antialias else 1
    return jnp.maximum(1 - distance / reach, 0) / reach
