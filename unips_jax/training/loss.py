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

from unips_jax.checks import require
from unips_jax.models import ops
from unips_jax.models.chunks import CHUNK_IMAGES, CHUNK_TOKENS, in_pieces
from unips_jax.models.config import ModelConfig, require_known_lights
from unips_jax.models.encoding import Guesses, whole
from unips_jax.models.network import (
    UniversalNetwork,
    decode_sets,
    encode,
    read_contexts,
)
from unips_jax.models.ops import wide_dtype
from unips_jax.models.views import (
    Frame,
    FrameKind,
    Views,
    canonical_images,
    context_cells,
    encoder_images,
    normalize_images,
    square_frame,
)
from unips_jax.scenes.incident import IncidentLight
from unips_jax.training.chunked_sum import chunked_sum
from unips_jax.training.light_loss import light_losses
from unips_jax.training.pixels import (
    BLOCK,
    draw_blocks,
    draw_pixels,
    neighbour_distances,
    steepness,
)


class Objects(NamedTuple):
    """B objects to train on.

    Attributes:
        images: `[B, N, H, W, 3]`, linear, of any scale.
        mask: `[B, H, W]`, bool.
        normals: `[B, H, W, 3]`, unit length inside the mask.
        lights: `[B, N, 3]`, see `scenes.Scene.light_means`; None: unknown.
        incident: arrays `[B, N, ...]`; None: unknown.
        known_lights: `[B, N, 3]`, what the network is given of them, see
            `models.known_lights`.
    """

    images: Array
    mask: Array
    normals: Array
    lights: Array | None = None
    incident: IncidentLight | None = None
    known_lights: Array | None = None


@dataclasses.dataclass(frozen=True)
class LossOptions:
    """What the loss compares, and how.

    Attributes:
        num_pixels: full-resolution pixels to draw of each object.
        frame: what the encoder's square surrounds, the "mask" or the whole "image".
        grid_loss: include the sampling at the contexts' grid.
        squared_loss: the distances of the normals are squared, as in the paper.
        distance_smoothing: else errors whose square is below it count by their square.
        coarse_guess_weight: of the guess of coarse normals; the normals have 1.
        lights_guess_weight: of the guess of the lights.
        kinds_guess_weight: of the guesses of the kinds of light.
        pixel_blocks: pixels are drawn in blocks of 2 x 2; not with `grid_loss`.
        steepness_weight: pixels count by the exponential of this times how much the
            true normals change within their block; 0: all the same.
        differences_weight: of the differences between the pixels of a block.
    """

    num_pixels: int
    frame: FrameKind = "image"
    grid_loss: bool = True
    squared_loss: bool = True
    distance_smoothing: float = 1e-3
    coarse_guess_weight: float = 0.5
    lights_guess_weight: float = 0.25
    kinds_guess_weight: float = 0.1
    pixel_blocks: bool = False
    steepness_weight: float = 0.0
    differences_weight: float = 0.0

    def __post_init__(self) -> None:
        require(
            not (self.pixel_blocks and self.grid_loss),
            "pixel_blocks: expected no grid_loss with them, got both",
        )
        require(
            self.pixel_blocks or not (self.steepness_weight or self.differences_weight),
            "steepness_weight, differences_weight: expected pixel_blocks, got none",
        )


def squared_distance(predicted: Array, true: Array) -> Array:
    """Squared distance of unit normals: `[..., 3]` to `[...]`, in [0, 4]."""
    return jnp.sum(jnp.square(predicted - true), axis=-1)


def plain_distance(squared: Array, smoothing: float = 1e-3) -> Array:
    """Distance of unit normals from its square, `[...]`, in [0, 2], smooth at zero."""
    return jnp.sqrt(squared + smoothing) - smoothing**0.5


def mean_weights(mask: Array) -> Array:
    """Weights `[P]` of masked pixels in their mean; all zero for an empty mask."""
    mask = jnp.asarray(mask, jnp.float32)
    return mask / jnp.maximum(jnp.sum(mask), 1)


def training_loss(
    network: UniversalNetwork,
    objects: Objects,
    keys: Array,
    options: LossOptions,
    *,
    deterministic: bool = False,
) -> tuple[Array, dict[str, Array]]:
    """The mean loss of B objects, differentiable by the network.

    The decoder's gradient is computed with its value, see `chunked_sum`. A network that
    guesses is also judged by its guesses of coarse normals and of the lights.

    Args:
        network: to train.
        objects: B of them.
        keys: `[B]`, for pixels and dropout.
        options: what is compared.
        deterministic: no dropout.

    Returns:
        The loss, and metrics: the mean angular error in degrees over the drawn pixels,
        and the mean distances of the guesses ("coarse", "lights", "harmonics", "lamps")
        where there are any.

    Raises:
        ValueError: for shapes that do not fit; if the network sees details and
            `grid_loss` is wanted: the grid has none; for `pixel_blocks` of images with
            an odd side; for known lights of a network that has no use for them.
    """
    _require_shapes(objects, keys)
    require(
        not (network.config.sees_details and options.grid_loss),
        "grid_loss: expected False with a network that has fine_dim, got True",
    )
    require(
        not (options.pixel_blocks and any(n % 2 for n in objects.mask.shape[1:])),
        f"pixel_blocks: expected images with even sides, got {objects.mask.shape[1:]}",
    )
    if objects.known_lights is not None:
        require_known_lights(network.config)
    # On CPU the decoder's chunks are small: nothing to recompute.
    on_cpu = jax.default_backend() == "cpu"
    remat = network.config.remat
    config = dataclasses.replace(network.config, remat=remat and not on_cpu)
    # Grids and coarse targets mix neighbours: what is outside must be nothing.
    mask = objects.mask.astype(bool)
    normals = jnp.where(mask[..., None], objects.normals, 0)
    objects = objects._replace(mask=mask, normals=normals)
    batch, num_images = objects.images.shape[:2]
    draws = jax.vmap(jax.random.split)(keys)  # [B, 2]
    prepare = functools.partial(_prepare, config=config, options=options)
    prepared = jax.vmap(prepare)(
        objects.images, objects.mask, objects.normals, draws[:, 0]
    )
    encoder_key, decoder_key = jax.random.split(draws[0, 1])
    # On CPU the compiler undoes rematerialisation everywhere but in loops.
    encoding = encode(
        UniversalNetwork(config, {"encoder": network.params["encoder"]}),
        prepared.views._replace(lights=objects.known_lights),
        by_image=in_pieces(CHUNK_IMAGES) if remat and on_cpu else whole,
        dropout=None if deterministic else encoder_key,
    )
    contexts = encoding.contexts
    read = jax.vmap(functools.partial(read_contexts, config=config))
    sampled = read(contexts, *prepared.cells)  # [B, P, N, C]
    if options.grid_loss:
        cells = contexts.reshape(batch, -1, *contexts.shape[3:])
        sampled = jnp.concatenate([cells, sampled], axis=1)

    def score(decoder: Any, sets: Any, truth: Any) -> tuple[Array, Array]:
        """Weighted distances of a chunk's blocks; cosines `[p, block, B]`."""
        sets, truth = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (sets, truth))
        observed, sampled = (jnp.moveaxis(x, 0, 1) for x in sets)  # [B, p, N, C]
        index, true, weights = truth
        key = jax.random.fold_in(decoder_key, index[0])
        predicted = decode_sets(
            UniversalNetwork(config, decoder),
            observed,
            sampled,
            dropout=None if deterministic else key,
        )
        predicted = jnp.moveaxis(predicted, 1, 0)
        squared = squared_distance(predicted, true)  # [p, B]
        loss = jnp.sum(weights * distance(squared))
        if options.differences_weight:
            change, pairs = neighbour_distances(predicted, true, weights)
            loss += options.differences_weight * jnp.sum(pairs * distance(change))
        return loss, (1 - squared / 2).reshape(-1, block, batch)

    def distance(squared: Array) -> Array:
        if options.squared_loss:
            return squared
        return plain_distance(squared, options.distance_smoothing)

    block = BLOCK if options.pixel_blocks else 1

    def in_blocks(x: Array) -> Array:
        return x.reshape(-1, block, *x.shape[1:])

    true, weights, counted = (
        jnp.swapaxes(x, 0, 1)
        for x in (prepared.true, prepared.weights, prepared.counted)
    )
    sets = (jnp.swapaxes(x, 0, 1) for x in (prepared.observed, sampled))
    truth = jnp.arange(len(true)), true, counted / batch
    loss, cosine = chunked_sum(
        score,
        {"decoder": network.params["decoder"]},
        tuple(map(in_blocks, sets)),
        tuple(map(in_blocks, truth)),
        max(1, CHUNK_TOKENS // (batch * num_images * block)) if on_cpu else None,
    )
    cosine = cosine.reshape(-1, batch)
    drawn = prepared.cells[0].shape[1]
    degrees = jnp.rad2deg(jnp.arccos(jnp.clip(cosine[-drawn:], -1, 1)))
    metrics = {"mae_deg": jnp.sum(weights[-drawn:] * degrees) / batch}
    if encoding.guesses is not None:
        losses = _guess_losses(encoding.guesses, objects, options.frame)
        guess_weights = {
            "coarse": options.coarse_guess_weight,
            "lights": options.lights_guess_weight,
            "harmonics": options.kinds_guess_weight,
            "lamps": options.kinds_guess_weight,
        }
        loss = loss + sum(guess_weights[name] * x for name, x in losses.items())
        metrics |= losses
    return loss, metrics


def _require_shapes(objects: Objects, keys: Array) -> None:
    """Raises `ValueError` unless images, mask, normals and keys are of B objects."""
    shape = objects.images.shape
    require(
        len(shape) == 5 and shape[-1] == 3,
        f"images: expected [B, N, H, W, 3], got {shape}; of one object, images[None]",
    )
    batch, size = shape[0], shape[2:4]
    for name, given, expected in (
        ("mask", objects.mask.shape, (batch, *size)),
        ("normals", objects.normals.shape, (batch, *size, 3)),
        ("keys", keys.shape[:1], (batch,)),
    ):
        hint = "; jax.random.split(key, B)" * (name == "keys")
        require(given == expected, f"{name}: expected {expected}, got {given}{hint}")


def _guess_losses(
    guesses: Guesses, objects: Objects, frame_kind: FrameKind
) -> dict[str, Array]:
    """Mean distances of guessed normals and lights from what is known of them."""
    grid = guesses.normals.shape[1]

    def score(guess: Array, mask: Array, normals: Array) -> Array:
        frame = square_frame(mask, frame_kind)
        small = canonical_images(normals[None], mask, frame, grid)[0]
        true, inside = ops.normalize(small[..., :3]), small[..., 3]
        # A cell counts by its corner: its centre, whose normal it has, may be outside.
        inside *= jnp.any(true != 0, axis=-1).astype(inside.dtype)
        distance = plain_distance(squared_distance(ops.normalize(guess), true))
        return jnp.sum(mean_weights(inside) * distance)

    scores = jax.vmap(score)(guesses.normals, objects.mask, objects.normals)
    losses = {"coarse": jnp.mean(scores)}
    if objects.lights is not None:
        squared = squared_distance(guesses.lights, objects.lights)
        losses["lights"] = jnp.mean(plain_distance(squared))
    if objects.incident is not None and guesses.kinds is not None:
        losses |= light_losses(guesses.kinds, objects.incident)
    return losses


class _Prepared(NamedTuple):
    """What the network gets of one object, and the truth.

    Pixels are P drawn ones, after the G cells of the contexts' grid if they count.
    """

    views: Views  # [N, s, s, 4]: one, the images
    observed: Array  # [G + P, N, 3]
    cells: tuple[Array, Array]  # rows and columns on the contexts' grid, [P] each
    true: Array  # [G + P, 3]
    weights: Array  # [G + P], of the pixels in a mean
    counted: Array  # [G + P], of the pixels in the loss


def _prepare(
    images: Array,
    mask: Array,
    normals: Array,
    key: Array,
    *,
    config: ModelConfig,
    options: LossOptions,
) -> _Prepared:
    images = normalize_images(images.astype(wide_dtype(images.dtype)), mask)
    frame: Frame = square_frame(mask, options.frame)
    seen = encoder_images(images, mask, frame, config)
    draw = draw_blocks if options.pixel_blocks else draw_pixels
    index, drawn = draw(mask, options.num_pixels, key)
    n, _, width, _ = images.shape
    observed = jnp.take(images.reshape(n, -1, 3), index, axis=1)
    true = jnp.take(normals.reshape(-1, 3), index, axis=0)
    weights = counted = mean_weights(drawn)
    if options.steepness_weight:
        steep = jnp.exp(options.steepness_weight * steepness(true, drawn))
        counted = mean_weights(drawn * steep)
    if options.grid_loss:
        grid = config.context_size
        small = canonical_images(images, mask, frame, grid)
        observed = jnp.concatenate([small[..., :3].reshape(n, -1, 3), observed], axis=1)
        small_true = canonical_images(normals[None], mask, frame, grid)[0, ..., :3]
        true = jnp.concatenate([ops.normalize(small_true).reshape(-1, 3), true])
        weights = jnp.concatenate([mean_weights(small[0, ..., 3].reshape(-1)), weights])
        counted = weights
    return _Prepared(
        Views(seen, frame, jnp.zeros((), bool), jnp.asarray(width, jnp.int32)),
        jnp.swapaxes(observed, 0, 1),
        cells=context_cells(index // width, index % width, frame, config),
        true=true,
        weights=weights,
        counted=counted,
    )
