"""Normals from images, by one pure, differentiable function.

Source: UniPS (Ikehata, CVPR 2022), Sec. 4. Departures from the paper: images need not
be square. The encoder sees the smallest square around the mask (zeros where it leaves
the image), and every pixel is decoded at its own place and size. Our network's normals
are the mean over the images and the mirrored images.
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from unips_jax.models import chunks, ops
from unips_jax.models.config import check_lights
from unips_jax.models.network import (
    UniversalNetwork,
    check_images,
    check_mask,
    decode,
    encode,
    with_uniform_contexts,
)
from unips_jax.models.views import FrameKind, make_views, normalize_images


def estimate_normals(
    network: UniversalNetwork,
    images: ArrayLike,
    mask: ArrayLike | None = None,
    *,
    valid: ArrayLike | None = None,
    lights: ArrayLike | None = None,
    frame: FrameKind = "mask",
    uniform_contexts: bool = False,
) -> Array:
    """Estimates an object's normals from images under different, unknown light.

    Pure and jitted; works under `jit`, under `vmap` over objects and under `grad` with
    respect to images and network. The encoder runs over a few images at a time and the
    decoder over a few thousand set members, both recomputed in the backward pass: what
    they hold is bounded in all three, beside a few copies of the images. Stretches
    without masked pixels are skipped (not under `vmap`, which computes both branches of
    a condition: use `jax.lax.map` over objects to keep that).

    On NVIDIA GPUs JAX multiplies float32 matrices with 10 bits of mantissa unless
    `jax.default_matmul_precision("highest")` surrounds the call.

    Args:
        network: from `load_weights`.
        images: `[N, H, W, 3]`, linear RGB, of any scale (each is divided by its mean).
            Photographs of 8 bits are sRGB: `unips_jax.io.color.as_linear` first.
        mask: `[H, W]`, non-zero on the object; None: the whole image.
        valid: `[N]`, bool: images that count, so that sets can be padded; None: all.
            Where none counts, normals are zero.
        lights: `[N, 3]`, the lights that are known, towards each lamp (x right, y up, z
            towards the viewer). Lengths are how well: 1 exactly, else the cosine of the
            error to expect, 0 not at all. Not for the paper's network.
        frame: what the encoder's square surrounds, the "mask" or the whole "image".
        uniform_contexts: an ablation, see `with_uniform_contexts`. It and `frame` are
            static: under a `jit` of your own name them in `static_argnames`.

    Returns:
        `[H, W, 3]`: unit normals inside the mask, x right, y up, z towards the viewer;
        zero outside. NaN inside where a value that is not finite reached them: one
        inside the mask reaches them all, through its image's context.

    Raises:
        TypeError: if the network is not one.
        ValueError: if the shapes do not fit each other, or images, mask, `valid` or
            lights are sharded over Explicit axes of a mesh.

    Source: UniPS (Ikehata, CVPR 2022), Sec. 4.
    """
    images = jnp.asarray(images)
    check_images(network, images.shape)
    mask = jnp.ones(images.shape[1:3], bool) if mask is None else jnp.asarray(mask)
    check_mask(mask.shape, images.shape)
    valid = None if valid is None else jnp.asarray(valid, bool)
    if valid is not None and valid.shape != images.shape[:1]:
        raise ValueError(
            f"valid: expected one flag per image, {images.shape[:1]}, got {valid.shape}"
        )
    lights = None if lights is None else _checked_lights(network, images, lights)
    given = {"images": images, "mask": mask, "valid": valid, "lights": lights}
    for name, array in given.items():
        spec = () if array is None else jax.typeof(array).sharding.spec
        split = [axis for axis in spec if axis is not None]
        if split:
            raise ValueError(
                f"{name}: expected a mesh of AxisType.Auto, got Explicit axes {split}; "
                "make it by jax.make_mesh(..., axis_types=(AxisType.Auto,) * n)"
            )
    return _estimate(
        network,
        images.astype(ops.wide_dtype(images.dtype)),
        mask.astype(bool),
        valid,
        lights,
        frame_kind=frame,
        uniform_contexts=uniform_contexts,
    )


def _checked_lights(
    network: UniversalNetwork, images: Array, lights: ArrayLike
) -> Array:
    lights = jnp.asarray(lights)
    check_lights(network.config, lights.shape, images.shape[0])
    return lights.astype(ops.wide_dtype(lights.dtype))


@functools.partial(jax.jit, static_argnames=("frame_kind", "uniform_contexts"))
def _estimate(
    network: UniversalNetwork,
    images: Array,
    mask: Array,
    valid: Array | None,
    lights: Array | None,
    *,
    frame_kind: FrameKind,
    uniform_contexts: bool,
) -> Array:
    n, height, width, _ = images.shape
    # A mask that an outer `jit` knows would be worked through by its compiler.
    mask = jax.lax.optimization_barrier(mask)
    some: Array | bool = True
    if valid is not None:  # without any image, all are taken, as zeros
        # What does not count weighs 0, and 0 times NaN is NaN.
        images = jnp.where(valid[:, None, None, None], images, 0)
        lights = None if lights is None else jnp.where(valid[:, None], lights, 0)
        some = jnp.any(valid)
        valid = valid | ~some
    images = normalize_images(images, mask)
    views = make_views(images, mask, network.config, frame_kind, lights)
    encoding = encode(network, views, valid, **chunks.bounded(n))
    if uniform_contexts:
        encoding = with_uniform_contexts(encoding, views)

    # Masked pixels first, so that whole chunks beyond them can be skipped. Gathered
    # before the loop: in it, each chunk's gradient would be as large as the images.
    count = height * width
    (index,) = jnp.nonzero(mask.reshape(-1), size=count, fill_value=count)
    flat = images.reshape(n, count, 3)
    pixels = jnp.moveaxis(jnp.take(flat, index, axis=1, mode="clip"), 0, 1)

    def decode_chunk(part: tuple[Array, Array]) -> Array:
        def run(part: tuple[Array, Array]) -> Array:
            pixels, index = part
            places = index // width, index % width
            return decode(network, encoding, pixels, places, valid)

        # Zeros that vary over the devices of a `shard_map` as the result does.
        result = jax.eval_shape(run, part)
        zeros = jnp.zeros(result.shape, result.dtype)
        used = (encoding.contexts, *jax.tree.leaves(network.params["decoder"]))
        varying = sum(leaf.reshape(-1)[0].astype(zeros.dtype) for leaf in used)
        empty = jnp.where(False, varying, zeros)
        return jax.lax.cond(part[1][0] < count, run, lambda _: empty, part)

    size = chunks.pixels_at_a_time(encoding.contexts)
    decoded = chunks.map_chunks(decode_chunk, (pixels, index), size)
    normals = jnp.zeros((count, 3), decoded.dtype)
    normals = jnp.where(some, normals.at[index].set(decoded, mode="drop"), 0)
    return normals.reshape(height, width, 3)
