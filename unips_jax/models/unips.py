"""The paper's network: encoder and decoder.

Source: "Universal Photometric Stereo Network using Global Lighting Contexts" (Ikehata,
CVPR 2022), Sec. 4 and supplement, with its ablations and, in the same modules, the
arithmetic of the authors' released weights (`UniPSConfig`). An object's images are one
set of N; batches of objects are leading axes. `valid [N]` marks the images that count,
so that sets can be padded; padding with finite values never changes a result.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from unips_jax.models import ops
from unips_jax.models.config import UniPSConfig
from unips_jax.models.decoding import Aggregation, Prediction
from unips_jax.models.encoding import (
    Encoded,
    Pieces,
    communicate,
    communications,
    whole,
)
from unips_jax.models.set_attention import layer_norm
from unips_jax.models.swin import PatchEmbed, SwinStage
from unips_jax.models.upernet import UPerNet


class Encoder(nn.Module):
    """Global lighting contexts from images of canonical size (Sec. 4.1)."""

    config: UniPSConfig

    def setup(self) -> None:
        config = self.config
        dtype = jnp.dtype(config.dtype)
        stages = range(len(config.depths))
        self.patch_embed = PatchEmbed(config.patch_channels, config.embed_dim, dtype)
        self.stages = [SwinStage(config, stage, dtype) for stage in stages]
        self.norms = [layer_norm(dtype) for _ in stages]
        dims = config.communication_dims
        self.communications = communications(config, dims, config.attention)
        self.fusion = UPerNet(config.context_dim, config.pool_scales, dtype=dtype)

    def __call__(
        self,
        images: Array,
        valid: Array | None = None,
        deterministic: bool = True,
        *,
        by_image: Pieces = whole,
        by_place: Pieces = whole,
    ) -> Encoded:
        """Contexts of `[..., N, s, s, 4]`, normalised RGB and mask; see `encode`."""
        *sets, height, width, channels = images.shape
        when = self.config.communication

        def exchange(i: int, level: Array) -> Array:
            block = self.communications[i]
            return communicate(block, level, sets[-1], valid, deterministic, by_place)

        x = images.reshape(-1, height, width, channels).astype(self.config.dtype)
        x = by_image(self.patch_embed, x)  # [M, s/4, s/4, embed_dim]
        maps = []
        for i, (stage, norm) in enumerate(zip(self.stages, self.norms, strict=True)):
            x = by_image(stage, x, deterministic)  # [M, s/4/2**i, ..., C_i]
            x = exchange(i, x) if when == "during" else x
            maps.append(norm(x))
        if when == "pre":
            maps = [exchange(i, level) for i, level in enumerate(maps)]
        contexts = by_image(self.fusion, maps)
        contexts = exchange(0, contexts) if when == "post" else contexts
        return Encoded(contexts.reshape(*sets, *contexts.shape[1:]))


class Decoder(nn.Module):
    """The normal of a pixel from its set of N observations and contexts (Sec. 4.2)."""

    config: UniPSConfig

    def setup(self) -> None:
        config = self.config
        self.aggregation = Aggregation(config, config.attention, config.aggregation)
        self.prediction = Prediction(config)

    def __call__(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Unit normals `[..., 3]` of sets `[..., N, 3]`, contexts `[..., N, C]`."""
        features = self.aggregation(pixels, contexts, valid, deterministic)
        return ops.normalize(self.prediction(features))
