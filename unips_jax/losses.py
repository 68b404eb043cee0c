"""The training loss of one object.

Source: UniPS (Ikehata, CVPR 2022), Sec. 4.3 and supplement: squared distance between
true and predicted unit normals, averaged over pixels, at two samplings, summed.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax import ops
from unips_jax.config import ModelConfig
from unips_jax.estimation import canonical_images, normalize_images, square_frame
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


def object_loss(
    params: Any,
    images: Array,
    mask: Array,
    normals: Array,
    key: Array,
    *,
    config: ModelConfig,
    num_pixels: int,
    grid_loss: bool = True,
    deterministic: bool = False,
) -> tuple[Array, dict[str, Array]]:
    """The loss of one object; a batch is a `jax.vmap` away.

    Args:
        params: the network's parameters.
        images: `[N, H, W, 3]`, linear, of any scale.
        mask: `[H, W]`, bool.
        normals: `[H, W, 3]`, unit length inside the mask.
        key: for pixels and dropout.
        config: the network's configuration.
        num_pixels: full-resolution pixels to draw.
        grid_loss: include the sampling at the contexts' grid.
        deterministic: no dropout.

    Returns:
        The loss, and metrics: the mean angular error in degrees over the drawn pixels.
    """
    network = UniPS(config)
    pixel_key, dropout_key = jax.random.split(key)
    images = normalize_images(images, mask)
    frame = square_frame(mask, "image")
    inputs = canonical_images(images, mask, frame, config.canonical_size)
    index, drawn = draw_pixels(mask, num_pixels, pixel_key)

    n, height, width, _ = images.shape
    grid = config.canonical_size // 4
    pixels = jnp.take(images.reshape(n, -1, 3), index, axis=1)  # [N, P, 3]
    true = jnp.take(normals.reshape(-1, 3), index, axis=0)
    offset = 0.5 if config.context_sampling == "center" else 0.0
    rows = (index // width - frame.top + offset) * grid / frame.side - 0.5
    columns = (index % width - frame.left + offset) * grid / frame.side - 0.5

    def run(bound: UniPS) -> Array:
        contexts = bound.encoder(inputs, None, deterministic)
        sampled = bound.sample(contexts, rows, columns)  # [P, N, C]
        observed = jnp.moveaxis(pixels, 0, 1)
        if grid_loss:
            small = ops.resize_bilinear(images, (grid, grid)).reshape(n, -1, 3)
            cells = contexts.reshape(n, grid * grid, -1)
            observed = jnp.concatenate([jnp.moveaxis(small, 0, 1), observed])
            sampled = jnp.concatenate([jnp.moveaxis(cells, 0, 1), sampled])
        return bound.decoder(observed, sampled, None, deterministic)

    predicted: Any = network.apply(
        {"params": params}, method=run, rngs={"dropout": dropout_key}
    )
    at_pixels = predicted[-index.size :]
    loss = masked_mean(squared_distance(at_pixels, true), drawn)
    if grid_loss:
        small_mask = ops.resize_mask_nearest(mask, (grid, grid)).reshape(-1)
        small_true = ops.normalize(ops.resize_bilinear(normals, (grid, grid)))
        distance = squared_distance(predicted[: grid * grid], small_true.reshape(-1, 3))
        loss = loss + masked_mean(distance, small_mask)
    cosine = jnp.clip(1 - squared_distance(at_pixels, true) / 2, -1, 1)
    error = jnp.rad2deg(jnp.arccos(jax.lax.stop_gradient(cosine)))
    return loss, {"mae_deg": masked_mean(error, drawn)}
