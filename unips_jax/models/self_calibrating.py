"""Our network: the paper's blocks, and each image's light found on the way.

Uncalibrated photometric stereo has two unknowns, the shape and the lights, and networks
that find both are called self-calibrating (SDPS-Net, Chen et al., CVPR 2019). The
paper's network (`models.unips`) has no place for the lights. This one differs from it:

- the encoder also sees each image's ratio to the mean of its set, and so does the
  decoder for its pixel: what an albedo does, it does to all images of a set alike;
- the images communicate after every stage of the backbone, which sees coarser stages
  in their light;
- no ReLUs in and after the pyramid pooling: where they are all off, the coarsest stage
  is cut off for good;
- the images agree on one shape, and on each one's light (`models.consensus`);
- if so configured, contexts end on a finer grid (`models.fine`), and the consensus
  knows kinds of light (`models.light_tokens`), and lights that are given
  (`models.known_lights`);
- images are resized with antialiasing, and normals are the mean over the images and
  the mirrored images (`estimation`).

Shapes and `valid` as in `models.unips`; set attention is the paper's.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops
from unips_jax.models.config import SelfCalibratingConfig
from unips_jax.models.consensus import Consensus
from unips_jax.models.decoding import Aggregation, Prediction
from unips_jax.models.encoding import (
    Encoded,
    Pieces,
    communicate,
    communications,
    whole,
)
from unips_jax.models.fine import Fine
from unips_jax.models.set_attention import layer_norm
from unips_jax.models.swin import PatchEmbed, SwinStage
from unips_jax.models.upernet import UPerNet

# Of an image whose mean is 1: about the noise, below which ratios mean little.
_DARK = 0.02


def image_ratios(images: Array, valid: Array | None = None) -> Array:
    """How images `[..., N, s, s, 4]` compare with their set: shading without albedo.

    Three channels: the ratio of the brightness to its mean over the set, that ratio's
    logarithm, and the mean's; zero outside the mask.
    """
    inside, light = images[..., 3:], _brightness(images)
    mean = jnp.broadcast_to(set_mean(images, valid), light.shape)
    logarithm = jnp.log(mean + _DARK)
    ratios = [light / (mean + _DARK), jnp.log(light + _DARK) - logarithm, logarithm]
    return jnp.concatenate([inside * x for x in ratios], axis=-1)


def set_mean(images: Array, valid: Array | None = None) -> Array:
    """The brightness of each place in the mean over the set: `[..., 1, s, s, 1]`."""
    light, where = _brightness(images), None
    if valid is not None:
        where = ops.leading(valid[:, None, None, None], light.ndim)
    return jnp.mean(light, axis=-4, keepdims=True, where=where)


def _brightness(images: Array) -> Array:
    return jnp.maximum(jnp.mean(images[..., :3], axis=-1, keepdims=True), 0)


class Encoder(nn.Module):
    """Global lighting contexts, and guesses of the normals and the lights."""

    config: SelfCalibratingConfig

    def setup(self) -> None:
        config = self.config
        dtype = jnp.dtype(config.dtype)
        stages = range(len(config.depths))
        ratio_channels = (config.ratio_dim, 2 * config.ratio_dim)
        self.patch_embed = PatchEmbed(config.patch_channels, config.embed_dim, dtype)
        self.ratio_embed = PatchEmbed(
            ratio_channels, config.embed_dim, dtype, nn.initializers.zeros
        )
        self.stages = [SwinStage(config, stage, dtype) for stage in stages]
        self.norms = [layer_norm(dtype) for _ in stages]
        self.communications = communications(config, config.stage_dims, "pre_norm")
        self.fusion = UPerNet(
            config.context_dim, config.pool_scales, linear_pooling=True, dtype=dtype
        )
        self.consensus = Consensus(
            config.consensus_blocks,
            config.consensus_dim,
            config.light_tokens,
            config.known_lights,
            dtype,
        )
        if config.sees_details:
            self.fine = Fine(config.fine_dim, dtype)

    def __call__(
        self,
        images: Array,
        valid: Array | None = None,
        deterministic: bool = True,
        *,
        lights: Array | None = None,
        by_image: Pieces = whole,
        by_place: Pieces = whole,
    ) -> Encoded:
        """Arguments as in `models.unips`; `lights [..., N, 3]` are known ones."""
        images, details = images[..., :4], images[..., 4:]
        *sets, height, width, channels = images.shape
        ratios = image_ratios(images, valid)
        # The ratios' embedding sees the mask too.
        related = jnp.concatenate([images[..., 3:], ratios], axis=-1)
        flat = (
            x.reshape(-1, height, width, channels).astype(self.config.dtype)
            for x in (images, related)
        )
        embeds = (self.patch_embed, self.ratio_embed)
        x, change = (by_image(*embed) for embed in zip(embeds, flat, strict=True))
        x, maps = x + change, []  # [M, s/4, s/4, embed_dim]
        parts = zip(self.stages, self.communications, self.norms, strict=True)
        for stage, block, norm in parts:
            x = by_image(stage, x, deterministic)
            x = communicate(block, x, sets[-1], valid, deterministic, by_place)
            maps.append(norm(x))
        contexts = by_image(self.fusion, maps)  # [M, s/4, s/4, context_dim]
        changed, guesses = self.consensus(
            contexts.reshape(-1, sets[-1], *contexts.shape[1:]),
            valid,
            None if lights is None else lights.reshape(-1, sets[-1], 3),
        )
        contexts = changed.reshape(-1, *contexts.shape[1:])
        if self.config.sees_details:
            relative = details / (set_mean(images, valid) + _DARK)
            seen = jnp.concatenate([related, details, relative], axis=-1)
            seen = seen.reshape(-1, height, width, seen.shape[-1])
            contexts = by_image(self.fine, (contexts, seen))
        return Encoded(contexts.reshape(*sets, *contexts.shape[1:]), guesses)


class Observation(nn.Module):
    """Lets a pixel's observations scale and shift its contexts; identity at first.

    Next to each value stands its ratio to the set's mean, which no albedo changes.
    """

    features: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, pixels: Array, contexts: Array, valid: Array | None) -> Array:
        """Contexts `[..., N, C]` changed by normalised RGB `[..., N, 3]`."""
        light = jnp.maximum(pixels.astype(jnp.float32), 0)
        where = None if valid is None else ops.leading(valid[:, None], light.ndim)
        mean = jnp.mean(light, axis=-2, keepdims=True, where=where)
        values = [light, light / (mean + _DARK), jnp.log(light + _DARK)]
        x = jnp.concatenate(values, axis=-1).astype(self.dtype)
        x = ops.gelu(nn.Dense(self.features, dtype=self.dtype, name="embed")(x))
        change = nn.Dense(
            2 * contexts.shape[-1],
            dtype=self.dtype,
            kernel_init=nn.initializers.zeros,
            name="change",
        )(x)
        scale, shift = jnp.split(change, 2, axis=-1)
        return contexts * (1 + scale) + shift


class Decoder(nn.Module):
    """The normal of a pixel from its set of N observations and contexts."""

    config: SelfCalibratingConfig

    def setup(self) -> None:
        config = self.config
        self.observation = Observation(config.observation_dim, jnp.dtype(config.dtype))
        self.aggregation = Aggregation(config)
        self.prediction = Prediction(config)

    def __call__(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Predicts unit normals `[..., 3]`; arguments as in `models.unips`."""
        contexts = self.observation(pixels, contexts, valid)
        features = self.aggregation(pixels, contexts, valid, deterministic)
        return ops.normalize(self.prediction(features))
