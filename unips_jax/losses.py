"""The training loss.

Source: UniPS (Ikehata, CVPR 2022), Sec. 4.3 and supplement: squared distance between
true and predicted unit normals, averaged over pixels, at two samplings, summed.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax import ops
from unips_jax.canonical import canonical_images, normalize_images, square_frame
from unips_jax.config import ModelConfig
from unips_jax.models.unips import UniPS


def squared_distance(predicted: Array, true: Array) -> Array:
    """Squared distance of unit normals: `[..., 3]` to `[...]`, in [0, 4]."""
    return jnp.sum(jnp.square(predicted - true), axis=-1)


def masked_mean(values: Array, mask: Array) -> Array:
    """Mean of `[...]` where the mask is set; 0 for an empty mask."""
    count = jnp.maximum(jnp.sum(mask), 1)
    return jnp.sum(jnp.where(mask, values, 0)) / count


def draw_pixels(mask: Array, count: int, key: Array) -> tuple[Array, Array]:
    """Draws masked pixels uniformly, without replacement.

    Args:
        mask: `[H, W]`, bool.
        count: how many.
        key: for the draw.

    Returns:
        Indices `[count]` into the flattened image, and which of them are masked pixels,
        `[count]`: fewer than `count` where the mask is smaller.
    """
    flat = mask.reshape(-1)
    order = jnp.where(flat, jax.random.uniform(key, flat.shape), -1)
    chosen, index = jax.lax.top_k(order, min(count, flat.size))
    return index, chosen >= 0


def object_losses(
    params: Any,
    images: Array,
    mask: Array,
    normals: Array,
    keys: Array,
    *,
    config: ModelConfig,
    num_pixels: int,
    grid_loss: bool = True,
    deterministic: bool = False,
) -> tuple[Array, dict[str, Array]]:
    """The losses of B objects.

    Args:
        params: the network's parameters.
        images: `[B, N, H, W, 3]`, linear, of any scale.
        mask: `[B, H, W]`, bool.
        normals: `[B, H, W, 3]`, unit length inside the mask.
        keys: `[B]`, for pixels and dropout.
        config: the network's configuration.
        num_pixels: full-resolution pixels to draw.
        grid_loss: include the sampling at the contexts' grid.
        deterministic: no dropout.

    Returns:
        The losses `[B]`, and metrics, `[B]` each: the mean angular error in degrees
        over the drawn pixels.
    """
    network = UniPS(config)
    grid = config.canonical_size // 4
    draws = jax.vmap(jax.random.split)(keys)  # [B, 2]
    object_ = functools.partial(_prepare, config=config, num_pixels=num_pixels)
    prepared = jax.vmap(object_)(images, mask, normals, draws[:, 0])
    zeros = config.context_sampling == "corner"
    sample = jax.vmap(functools.partial(ops.bilinear_sample, zeros=zeros))

    def run(bound: UniPS) -> Array:
        # Without `vmap`: the gradients of plain products are faster.
        contexts = bound.encoder(prepared.inputs, None, deterministic)
        sampled = sample(contexts, prepared.rows, prepared.columns)  # [B, N, P, C]
        observed = prepared.pixels
        if grid_loss:
            small = ops.resize_bilinear(prepared.images, (grid, grid))
            observed, sampled = (
                jnp.concatenate([x.reshape(*x.shape[:2], grid * grid, -1), y], axis=2)
                for x, y in ((small, observed), (contexts, sampled))
            )
        observed, sampled = (jnp.swapaxes(x, 1, 2) for x in (observed, sampled))
        return bound.decoder(observed, sampled, None, deterministic)  # [B, P, N, C]

    predicted: Any = network.apply(
        {"params": params}, method=run, rngs={"dropout": draws[0, 1]}
    )

    def score(
        predicted: Array, one: _Prepared, mask: Array, normals: Array
    ) -> tuple[Array, dict[str, Array]]:
        at_pixels = predicted[-one.true.shape[0] :]
        distance = squared_distance(at_pixels, one.true)
        loss = masked_mean(distance, one.drawn)
        if grid_loss:
            small_mask = ops.resize_mask_nearest(mask, (grid, grid)).reshape(-1)
            true = ops.normalize(ops.resize_bilinear(normals, (grid, grid)))
            at_grid = squared_distance(predicted[: grid * grid], true.reshape(-1, 3))
            loss = loss + masked_mean(at_grid, small_mask)
        cosine = jnp.clip(1 - jax.lax.stop_gradient(distance) / 2, -1, 1)
        error = jnp.rad2deg(jnp.arccos(cosine))
        return loss, {"mae_deg": masked_mean(error, one.drawn)}

    return jax.vmap(score)(predicted, prepared, mask, normals)


class _Prepared(NamedTuple):
    """What the network gets of one object, and the truth at the drawn pixels."""

    images: Array  # [N, H, W, 3], normalised
    inputs: Array  # [N, s, s, 4]
    pixels: Array  # [N, P, 3]
    rows: Array  # [P]
    columns: Array  # [P]
    true: Array  # [P, 3]
    drawn: Array  # [P]


def _prepare(
    images: Array,
    mask: Array,
    normals: Array,
    key: Array,
    *,
    config: ModelConfig,
    num_pixels: int,
) -> _Prepared:
    images = normalize_images(images, mask)
    frame = square_frame(mask, "image")
    inputs = canonical_images(images, mask, frame, config.canonical_size)
    index, drawn = draw_pixels(mask, num_pixels, key)
    n, _, width, _ = images.shape
    grid = config.canonical_size // 4
    offset = 0.5 if config.context_sampling == "center" else 0.0
    return _Prepared(
        images,
        inputs,
        pixels=jnp.take(images.reshape(n, -1, 3), index, axis=1),
        rows=(index // width - frame.top + offset) * grid / frame.side - 0.5,
        columns=(index % width - frame.left + offset) * grid / frame.side - 0.5,
        true=jnp.take(normals.reshape(-1, 3), index, axis=0),
        drawn=drawn,
    )
