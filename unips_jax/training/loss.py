"""The training loss.

Source: UniPS (Ikehata, CVPR 2022), Sec. 4.3 and supplement: squared distance between
true and predicted unit normals, averaged over pixels, at two samplings, summed. The
distance itself may be taken instead, which follows the mean angular error.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.estimation.chunks import (
    CHUNK_IMAGES,
    CHUNK_TOKENS,
    in_pieces,
)
from unips_jax.estimation.frame import (
    FrameKind,
    canonical_images,
    context_cells,
    normalize_images,
    square_frame,
)
from unips_jax.models import ops
from unips_jax.models.config import ModelConfig
from unips_jax.models.encoding import Guesses, whole
from unips_jax.models.heads import Maps
from unips_jax.models.network import Network, read_contexts
from unips_jax.training.chunked_sum import chunked_sum

# Of the error's head: what share of the pixels stays below, and the degrees below
# which errors are all alike.
_QUANTILE, _ERROR_FLOOR = 0.9, 0.5
# Values of a material: base colour, roughness, metallic.
_MATERIAL = 5


def squared_distance(predicted: Array, true: Array) -> Array:
    """Squared distance of unit normals: `[..., 3]` to `[...]`, in [0, 4]."""
    return jnp.sum(jnp.square(predicted - true), axis=-1)


def plain_distance(squared: Array) -> Array:
    """Distance of unit normals from its square, `[...]`, in [0, 2], smooth at zero."""
    return jnp.sqrt(squared + 1e-3) - 1e-3**0.5


def mean_weights(mask: Array) -> Array:
    """Weights `[P]` of masked pixels in their mean; all zero for an empty mask."""
    return mask / jnp.maximum(jnp.sum(mask), 1)


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


def training_loss(
    params: Any,
    images: Array,
    mask: Array,
    normals: Array,
    keys: Array,
    *,
    config: ModelConfig,
    num_pixels: int,
    lights: Array | None = None,
    material: Array | None = None,
    frame: FrameKind = "image",
    grid_loss: bool = True,
    squared_loss: bool = True,
    coarse_guess_weight: float = 0.5,
    lights_guess_weight: float = 0.25,
    heads_only: bool = False,
    deterministic: bool = False,
) -> tuple[Array, dict[str, Array]]:
    """The mean loss of B objects, differentiable by the parameters.

    The decoder's gradient is computed with its value, see `chunked_sum`. A network that
    guesses is also judged by its guesses of coarse normals and of the lights, and one
    with heads by what they say, which leaves its normals alone.

    Args:
        params: the network's parameters.
        images: `[B, N, H, W, 3]`, linear, of any scale.
        mask: `[B, H, W]`, bool.
        normals: `[B, H, W, 3]`, unit length inside the mask.
        keys: `[B]`, for pixels and dropout.
        config: the network's configuration.
        num_pixels: full-resolution pixels to draw.
        lights: `[B, N, 3]`, see `scenes.Scene.light_means`; None: unknown.
        material: `[B, H, W, 5]`, base colour, roughness and metallic; None: unknown.
        frame: what the encoder's square surrounds, the "mask" or the whole "image".
        grid_loss: include the sampling at the contexts' grid.
        squared_loss: the distances of the normals are squared, as in the paper.
        coarse_guess_weight: what the guess of coarse normals weighs beside the normals.
        lights_guess_weight: what the guess of the lights weighs there.
        heads_only: the loss is that of the heads, and has a gradient only there.
        deterministic: no dropout.

    Returns:
        The loss, and metrics: the mean angular error in degrees over the drawn pixels,
        and the mean distances of the guesses ("coarse", "lights") and losses of the
        heads ("error", "material") where there are any.
    """
    # On CPU the decoder's chunks are small: nothing to recompute.
    on_cpu = jax.default_backend() == "cpu"
    network = Network(dataclasses.replace(config, remat=config.remat and not on_cpu))
    batch, num_images = images.shape[:2]
    draws = jax.vmap(jax.random.split)(keys)  # [B, 2]
    prepare = functools.partial(
        _prepare,
        config=config,
        num_pixels=num_pixels,
        frame_kind=frame,
        grid_loss=grid_loss,
    )
    prepared = jax.vmap(prepare)(images, mask, normals, material, draws[:, 0])
    encoder_key, decoder_key = jax.random.split(draws[0, 1])
    # On CPU the compiler undoes rematerialisation everywhere but in loops.
    encoded: Any = network.apply(
        {"params": {"encoder": params["encoder"]}},
        prepared.inputs,
        None,
        deterministic,
        by_image=in_pieces(CHUNK_IMAGES) if config.remat and on_cpu else whole,
        rngs={"dropout": encoder_key},
        method="encode",
    )
    contexts, guesses = encoded
    read = jax.vmap(functools.partial(read_contexts, config=config))
    sampled = read(contexts, *prepared.cells)  # [B, N, P, C]
    if grid_loss:
        cells = contexts.reshape(batch, num_images, -1, contexts.shape[-1])
        sampled = jnp.concatenate([cells, sampled], axis=2)

    def score(decoder: Any, sets: Any, truth: Any) -> tuple[Array, dict[str, Array]]:
        """Weighted distances of a chunk's pixels; cosines and other losses `[p, B]`."""
        observed, sampled = (jnp.moveaxis(x, 0, 1) for x in sets)  # [B, p, N, C]
        index, true, weights, matter = truth
        if heads_only:
            decoder = {**jax.lax.stop_gradient(decoder), "heads": decoder["heads"]}
        decoded: Any = network.apply(
            {"params": decoder},
            observed,
            sampled,
            None,
            deterministic,
            rngs={"dropout": jax.random.fold_in(decoder_key, index[0])},
            method="decode_maps" if config.has_maps else "decode",
        )
        predicted, *maps = decoded if config.has_maps else (decoded,)
        squared = squared_distance(jnp.moveaxis(predicted, 1, 0), true)  # [p, B]
        loss = squared if squared_loss else plain_distance(squared)
        arrays = {"cosine": 1 - squared / 2}
        if maps:
            said = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), maps[0])
            losses = head_losses(said, _degrees(1 - squared / 2), matter)
            loss = sum(losses.values(), jnp.zeros(()) if heads_only else loss)
            arrays |= losses
        return jnp.sum(weights * loss), arrays

    pixels = prepared.true, prepared.weights, prepared.material
    true, weights, matter = (jnp.swapaxes(x, 0, 1) for x in pixels)
    loss, arrays = chunked_sum(
        score,
        {name: params[name] for name in ("decoder", "heads") if name in params},
        tuple(x.transpose(2, 0, 1, 3) for x in (prepared.observed, sampled)),
        (jnp.arange(len(true)), true, weights / batch, matter),
        max(1, CHUNK_TOKENS // (batch * num_images)) if on_cpu else None,
    )
    drawn = prepared.cells[0].shape[1]

    def mean(values: Array) -> Array:
        return jnp.sum(weights[-drawn:] * values[-drawn:]) / batch

    metrics = {"mae_deg": mean(_degrees(arrays.pop("cosine")))}
    metrics |= {name: mean(values) for name, values in arrays.items()}
    if heads_only:
        return loss, metrics
    if guesses is not None:
        losses = _guess_losses(guesses, mask, normals, lights, frame)
        guess_weights = {"coarse": coarse_guess_weight, "lights": lights_guess_weight}
        loss = loss + sum(guess_weights[name] * x for name, x in losses.items())
        metrics |= losses
    return loss, metrics


def head_losses(maps: Maps, degrees: Array, material: Array) -> dict[str, Array]:
    """How far the heads are off.

    Args:
        maps: `[...]`, see there.
        degrees: `[...]`, the normals' errors; taken as constants.
        material: `[..., 5]`, base colour, roughness and metallic; negative: unknown.

    Returns:
        `[...]` each. Of "error", the pinball loss of the logarithm: least where nine
        errors in ten stay below. Of "material", absolute differences; of base colours
        those of their square roots, which look alike from dark to bright.
    """
    degrees = jax.lax.stop_gradient(degrees)
    above = jnp.log(degrees + _ERROR_FLOOR) - jnp.log(maps.error + _ERROR_FLOOR)
    root = jnp.sqrt(jnp.maximum(material[..., :3], 0)) - jnp.sqrt(maps.base_color)
    matter = jnp.mean(jnp.abs(root), axis=-1)
    matter += jnp.abs(material[..., 3] - maps.roughness)
    matter += jnp.abs(material[..., 4] - maps.metallic) / 2
    return {
        "error": jnp.maximum(_QUANTILE * above, (_QUANTILE - 1) * above),
        "material": jnp.where(material[..., 0] < 0, 0.0, matter),
    }


def _degrees(cosine: Array) -> Array:
    return jnp.rad2deg(jnp.arccos(jnp.clip(cosine, -1, 1)))


def _guess_losses(
    guesses: Guesses,
    mask: Array,
    normals: Array,
    lights: Array | None,
    frame_kind: FrameKind,
) -> dict[str, Array]:
    """Mean distances of the guessed normals and lights from the true ones.

    `mask [B, H, H]`, `normals [B, H, H, 3]` and `lights [B, N, 3]` are the true ones;
    unknown lights are left out of the result.
    """
    grid = guesses.normals.shape[1]

    def score(guess: Array, mask: Array, normals: Array) -> Array:
        frame = square_frame(mask, frame_kind)
        small = canonical_images(normals[None], mask, frame, grid)[0]
        true, inside = ops.normalize(small[..., :3]), small[..., 3]
        # A cell counts by its corner: its centre, whose normal it has, may be outside.
        inside *= jnp.any(true != 0, axis=-1)
        distance = plain_distance(squared_distance(ops.normalize(guess), true))
        return jnp.sum(mean_weights(inside) * distance)

    losses = {"coarse": jnp.mean(jax.vmap(score)(guesses.normals, mask, normals))}
    if lights is not None:
        squared = squared_distance(guesses.lights, lights)
        losses["lights"] = jnp.mean(plain_distance(squared))
    return losses


class _Prepared(NamedTuple):
    """What the network gets of one object, and the truth.

    Pixels are P drawn ones, after the G cells of the contexts' grid if they count.
    """

    inputs: Array  # [N, s, s, 4]
    observed: Array  # [N, G + P, 3]
    cells: tuple[Array, Array]  # rows and columns on the contexts' grid, [P] each
    true: Array  # [G + P, 3]
    weights: Array  # [G + P], of the pixels in the loss
    material: Array  # [G + P, 5], negative where unknown


def _prepare(
    images: Array,
    mask: Array,
    normals: Array,
    material: Array | None,
    key: Array,
    *,
    config: ModelConfig,
    num_pixels: int,
    frame_kind: FrameKind,
    grid_loss: bool,
) -> _Prepared:
    images = normalize_images(images, mask)
    frame = square_frame(mask, frame_kind)
    inputs = canonical_images(
        images, mask, frame, config.canonical_size, config.antialias
    )
    index, drawn = draw_pixels(mask, num_pixels, key)
    n, _, width, _ = images.shape
    grid = config.context_size
    observed = jnp.take(images.reshape(n, -1, 3), index, axis=1)
    true = jnp.take(normals.reshape(-1, 3), index, axis=0)
    weights = mean_weights(drawn)
    matter = jnp.full((index.size, _MATERIAL), -1.0)
    if material is not None:
        matter = jnp.take(material.reshape(-1, _MATERIAL), index, axis=0)
    if grid_loss:
        small = canonical_images(images, mask, frame, grid)
        observed = jnp.concatenate([small[..., :3].reshape(n, -1, 3), observed], axis=1)
        small_true = canonical_images(normals[None], mask, frame, grid)[0, ..., :3]
        true = jnp.concatenate([ops.normalize(small_true).reshape(-1, 3), true])
        weights = jnp.concatenate([mean_weights(small[0, ..., 3].reshape(-1)), weights])
        matter = jnp.concatenate([jnp.full((grid * grid, _MATERIAL), -1.0), matter])
    return _Prepared(
        inputs,
        observed,
        cells=context_cells(index // width, index % width, frame, config),
        true=true,
        weights=weights,
        material=matter,
    )
