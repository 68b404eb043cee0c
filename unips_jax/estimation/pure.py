"""Normals from images, by one pure, differentiable function.

Source: UniPS (Ikehata, CVPR 2022), Sec. 4. Departures from the paper: images need not
be square. The encoder sees the smallest square around the mask (zeros where it leaves
the image), and every pixel is decoded at its own place and size. The normals may be the
mean over the images and the mirrored images, as those of our network are.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from unips_jax.estimation.chunks import (
    CHUNK_IMAGES,
    CHUNK_TOKENS,
    in_pieces,
    map_chunks,
    map_views,
)
from unips_jax.estimation.frame import (
    Frame,
    FrameKind,
    canonical_images,
    context_cells,
    normalize_images,
    square_frame,
)
from unips_jax.models import ops
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import Network, read_contexts

Params = Any


class SurfaceMaps(NamedTuple):
    """Normals, and what else a network with heads says of each pixel.

    Zero outside the mask.

    Attributes:
        normals: `[..., 3]`, unit.
        error: `[...]`, degrees: nine pixels in ten have normals less far off.
        base_color: `[..., 3]`, linear, in [0, 1], up to scale; of metals their
            reflectance.
        roughness: `[...]`, in [0, 1], perceptual, as in glTF and Blender.
        metallic: `[...]`, in [0, 1].
    """

    normals: Array
    error: Array
    base_color: Array
    roughness: Array
    metallic: Array


def encode(
    params: Params,
    images: Array,
    valid: Array | None = None,
    *,
    config: ModelConfig,
    uniform_contexts: bool = False,
) -> Array:
    """Global lighting contexts, with bounded memory in images and in pixels.

    Args:
        params: the network's parameters.
        images: `[N, s, s, 4]`, from `canonical_images`.
        valid: `[N]`, bool: which images count; None: all.
        config: the network's configuration.
        uniform_contexts: replace each image's contexts by their mean over the mask
            (the paper's Table 5, to see what their spatial variation gives).

    Returns:
        `[N, s/4, s/4, context_dim]`.
    """
    encoded: Any = Network(config).apply(
        {"params": params},
        images,
        valid,
        by_image=in_pieces(CHUNK_IMAGES),
        by_place=in_pieces(max(1, CHUNK_TOKENS // len(images))),
        method="encode",
    )
    contexts = encoded.contexts
    if uniform_contexts:
        _, height, width, _ = contexts.shape
        inside = ops.resize_mask_nearest(images[..., 3], (height, width))[..., None]
        inside = inside.astype(contexts.dtype)
        total = jnp.sum(contexts * inside, axis=(1, 2), keepdims=True)
        mean = total / jnp.maximum(jnp.sum(inside, axis=(1, 2), keepdims=True), 1)
        contexts = jnp.broadcast_to(mean, contexts.shape)
    return contexts


def decode(
    params: Params,
    contexts: Array,
    pixels: Array,
    places: tuple[Array, Array],
    frame: Frame,
    valid: Array | None = None,
    *,
    width: int,
    config: ModelConfig,
    maps: bool = False,
) -> Any:
    """Normals of pixels, from their sets.

    Args:
        params: the network's parameters.
        contexts: `[V, N, s/4, s/4, context_dim]`, from `encode`, of one view or two:
            the images, and the mirrored images (`ModelConfig.mirror`).
        pixels: `[P, N, 3]`, normalised RGB.
        places: rows and columns of the pixels in the image, `[P]` each.
        frame: the square that was encoded, `[V]`.
        valid: `[N]`, bool: which images count; None: all.
        width: columns of the image.
        config: the network's configuration.
        maps: also give the maps of a network that has them.

    Returns:
        Unit normals, `[P, 3]`; of two views the mean, mirrored back. With `maps`
        `SurfaceMaps`.
    """

    def of_view(view: tuple[Array, Frame, Array]) -> Any:
        contexts, frame, mirrored = view
        return decode_view(
            params,
            contexts,
            pixels,
            places,
            frame,
            mirrored,
            valid,
            width=width,
            config=config,
            maps=maps,
        )

    mirrored = jnp.arange(len(contexts)) == 1
    normals, *rest = map_views(of_view, (contexts, frame, mirrored))
    normals = mean_of_views(normals)
    if not maps:
        return normals
    return SurfaceMaps(normals, *(jnp.mean(value, axis=0) for value in rest[0]))


def decode_view(
    params: Params,
    contexts: Array,
    pixels: Array,
    places: tuple[Array, Array],
    frame: Frame,
    mirrored: Array | bool,
    valid: Array | None = None,
    *,
    width: int | Array,
    config: ModelConfig,
    maps: bool = False,
) -> Any:
    """Normals of pixels from one view, mirrored back if it is.

    Args:
        params: the network's parameters.
        contexts: `[N, s/4, s/4, context_dim]`, of the view.
        pixels: see `decode`.
        places: see `decode`; in the image that is not mirrored.
        frame: the square of the view.
        mirrored: whether the view is that of the mirrored images.
        valid: see `decode`.
        width: columns of the image.
        config: the network's configuration.
        maps: also give the maps of a network that has them.

    Returns:
        A tuple: unit normals, `[P, 3]`, and with `maps` a `models.heads.Maps`.
    """
    rows, columns = places
    columns = jnp.where(mirrored, width - 1 - columns, columns)
    cells = context_cells(rows, columns, frame, config)
    read = jnp.swapaxes(read_contexts(contexts, *cells, config=config), 0, 1)
    method = "decode_maps" if maps else "decode"
    decoded: Any = Network(config).apply(
        {"params": params}, pixels, read, valid, method=method
    )
    normals, *rest = decoded if maps else (decoded,)
    signs = jnp.array([[-1, 1, 1]], normals.dtype)
    return jnp.where(mirrored, normals * signs, normals), *rest


def mean_of_views(normals: Array) -> Array:
    """The mean of unit normals `[V, P, 3]` over the views: `[P, 3]`, unit length."""
    return normals[0] if len(normals) == 1 else ops.normalize(jnp.sum(normals, 0))


def estimate_normals(
    params: Params,
    images: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    config: ModelConfig,
    valid: ArrayLike | None = None,
    frame: FrameKind = "mask",
    uniform_contexts: bool = False,
) -> Array:
    """Estimates an object's normals from images under different, unknown light.

    Pure and jitted; works under `jit`, under `vmap` over objects and under `grad` with
    respect to images and parameters. The encoder runs over a few images at a time and
    the decoder over a few thousand set members, both recomputed in the backward pass,
    so that memory beyond inputs and outputs is bounded in all three. Stretches without
    masked pixels are skipped (not under `vmap`, which computes both branches of a
    condition: use `jax.lax.map` over objects to keep that).

    Images need not be square: the encoder sees the smallest square around the mask,
    with zeros where it leaves the image, and no aspect ratio changes. Our network also
    sees the mirrored images, and the normals are the mean.

    On NVIDIA GPUs JAX multiplies float32 matrices with 10 bits of mantissa unless
    `jax.default_matmul_precision("highest")` surrounds the call.

    Args:
        params: the network's parameters.
        images: `[N, H, W, 3]`, linear RGB, of any scale (each is divided by its mean).
        mask: `[H, W]`, non-zero on the object; None: the whole image.
        config: the network's configuration.
        valid: `[N]`, bool: images that count, so that sets can be padded; None: all.
            Where none counts, normals are zero.
        frame: what the encoder's square surrounds, the "mask" or the whole "image".
        uniform_contexts: an ablation, see `encode`.

    Returns:
        `[H, W, 3]`: unit normals inside the mask, x right, y up, z towards the viewer;
        zero outside. NaN inside where a value that is not finite reached them: one
        inside the mask reaches them all, through its image's context.

    Raises:
        ValueError: if the shapes do not fit each other.

    Source: UniPS (Ikehata, CVPR 2022), Sec. 4.
    """
    return _checked(
        params,
        images,
        mask,
        valid,
        config=config,
        frame_kind=frame,
        uniform_contexts=uniform_contexts,
    )


def estimate_maps(
    params: Params,
    images: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    config: ModelConfig,
    valid: ArrayLike | None = None,
    frame: FrameKind = "mask",
) -> SurfaceMaps:
    """Estimates normals, their error, and the material, in one pass.

    Everything that `estimate_normals` promises holds, and its normals are the same. The
    other maps have no gradient with respect to what the network made of the contexts.

    Args:
        params: parameters of a network with heads (`ModelConfig.has_maps`).
        images: see `estimate_normals`, as the other arguments.
        mask: `[H, W]`.
        config: the network's configuration.
        valid: `[N]`, bool.
        frame: what the encoder's square surrounds.

    Returns:
        Arrays `[H, W, ...]`.

    Raises:
        ValueError: if the shapes do not fit each other, or the network has no heads.
    """
    if not config.has_maps:
        raise ValueError(
            "config: expected a network with heads (head_dim above 0), got one "
            "without; estimate_normals needs none"
        )
    return _checked(
        params, images, mask, valid, config=config, frame_kind=frame, maps=True
    )


def _checked(
    params: Params,
    images: ArrayLike,
    mask: ArrayLike | None,
    valid: ArrayLike | None,
    **options: Any,
) -> Any:
    images = jnp.asarray(images)
    if images.ndim != 4 or images.shape[-1] != 3 or 0 in images.shape:
        raise ValueError(
            f"images: expected [N, H, W, 3] with at least one image and pixel, got "
            f"{images.shape}; grey images must be repeated over three channels"
        )
    mask = jnp.ones(images.shape[1:3], bool) if mask is None else jnp.asarray(mask)
    if mask.shape != images.shape[1:3]:
        raise ValueError(
            f"mask: expected the images' [H, W] = {images.shape[1:3]}, got {mask.shape}"
        )
    if valid is not None and jnp.shape(valid) != images.shape[:1]:
        raise ValueError(
            f"valid: expected one flag per image, {images.shape[:1]}, got "
            f"{jnp.shape(valid)}"
        )
    return _estimate(
        params,
        images.astype(ops.wide_dtype(images.dtype)),
        mask.astype(bool),
        None if valid is None else jnp.asarray(valid, bool),
        **options,
    )


@functools.partial(
    jax.jit, static_argnames=("config", "frame_kind", "uniform_contexts", "maps")
)
def _estimate(
    params: Params,
    images: Array,
    mask: Array,
    valid: Array | None,
    *,
    config: ModelConfig,
    frame_kind: FrameKind,
    uniform_contexts: bool = False,
    maps: bool = False,
) -> Any:
    n, height, width, _ = images.shape
    # A mask that an outer `jit` knows would be worked through by its compiler.
    mask = jax.lax.optimization_barrier(mask)
    some: Array | bool = True
    if valid is not None:  # without any image, all are taken, and nothing is given
        some = jnp.any(valid)
        valid = valid | ~some
    images = normalize_images(images, mask)

    def view_of(images: Array, mask: Array) -> tuple[Array, Frame]:
        frame = square_frame(mask, frame_kind)
        size, antialias = config.canonical_size, config.antialias
        return canonical_images(images, mask, frame, size, antialias), frame

    views = [view_of(images, mask)]
    if config.mirror:
        views.append(view_of(images[:, :, ::-1], mask[:, ::-1]))
    inputs, frame = jax.tree.map(lambda *view: jnp.stack(view), *views)
    contexts = map_views(
        lambda view: encode(
            params, view, valid, config=config, uniform_contexts=uniform_contexts
        ),
        inputs,
    )

    # Masked pixels first, so that whole chunks beyond them can be skipped. Gathered
    # before the loop: in it, each chunk's gradient would be as large as the images.
    count = height * width
    (index,) = jnp.nonzero(mask.reshape(-1), size=count, fill_value=count)
    flat = images.reshape(n, count, 3)
    pixels = jnp.moveaxis(jnp.take(flat, index, axis=1, mode="clip"), 0, 1)

    def decode_chunk(part: tuple[Array, Array]) -> Any:
        def run(part: tuple[Array, Array]) -> Any:
            pixels, index = part
            places = index // width, index % width
            return decode(
                params,
                contexts,
                pixels,
                places,
                frame,
                valid,
                width=width,
                config=config,
                maps=maps,
            )

        def nothing(result: jax.ShapeDtypeStruct) -> Array:
            # Zeros that vary over the devices of a `shard_map` as the result does.
            zeros = jnp.zeros(result.shape, result.dtype)
            return jnp.where(False, contexts.reshape(-1)[0].astype(zeros.dtype), zeros)

        empty = jax.tree.map(nothing, jax.eval_shape(run, part))
        return jax.lax.cond(part[1][0] < count, run, lambda _: empty, part)

    def place(values: Array) -> Array:
        whole = jnp.zeros((count, *values.shape[1:]), values.dtype)
        whole = jnp.where(some, whole.at[index].set(values, mode="drop"), 0)
        return whole.reshape(height, width, *values.shape[1:])

    decoded = map_chunks(decode_chunk, (pixels, index), max(1, CHUNK_TOKENS // n))
    return jax.tree.map(place, decoded)
