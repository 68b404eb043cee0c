"""UniPS: encoder, decoder and the whole network for one object.

Source: "Universal Photometric Stereo Network using Global Lighting Contexts" (Ikehata,
CVPR 2022), Sec. 4 and supplement. An object's images are one set of N; batches of
objects are leading axes. `valid` `[N]` marks the images that count, so that sets
can be padded; padding with finite values never changes a result.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.config import ModelConfig
from unips_jax.models import ops
from unips_jax.models.consensus import Consensus, Guesses
from unips_jax.models.set_attention import PMA, SAB, dense, layer_norm
from unips_jax.models.swin import PatchEmbed, PatchMerging, SwinStage
from unips_jax.models.upernet import UPerNet

# Components of a normal.
_XYZ = 3

# Of an image whose mean is 1: about the noise, below which ratios mean little.
_DARK = 0.02


def append_ratios(images: Array, valid: Array | None = None) -> Array:
    """Appends how each image of a set compares with their mean.

    What an albedo does to a pixel, it does to all images of the set alike: their ratio
    to the mean is shading alone. Our addition to the paper.

    Args:
        images: `[..., N, s, s, 4]`, normalised RGB and mask.
        valid: `[N]`, bool: which images count; None: all.

    Returns:
        `[..., N, s, s, 7]`: appended are the ratio of the brightness to its mean over
        the set, that ratio's logarithm, and the mean's; zero outside the mask.
    """
    inside = images[..., 3:]
    light = jnp.maximum(jnp.mean(images[..., :3], axis=-1, keepdims=True), 0)
    where = None if valid is None else valid[:, None, None, None]
    mean = jnp.mean(light, axis=-4, keepdims=True, where=where)
    mean = jnp.broadcast_to(mean, light.shape)
    logarithm = jnp.log(mean + _DARK)
    ratios = [light / (mean + _DARK), jnp.log(light + _DARK) - logarithm, logarithm]
    return jnp.concatenate([images, *(inside * x for x in ratios)], axis=-1)


class Encoder(nn.Module):
    """Global lighting contexts from images of canonical size.

    `relate` comes first, and `agree` last; they see everything. `embed`, `stage` and
    `fuse` treat every image alone, and so does `extract` unless images communicate
    during it; `communicate` treats every pixel alone. So a caller may run each in
    pieces.

    Attributes:
        config: the network's configuration.
    """

    config: ModelConfig

    def setup(self) -> None:
        """Names the submodules."""
        config = self.config
        dtype = jnp.dtype(config.dtype)
        stages = range(len(config.depths))
        self.patch_embed = PatchEmbed(config.patch_channels, config.embed_dim, dtype)
        if config.ratio_dim:
            self.ratio_embed = PatchEmbed(
                (config.ratio_dim, 2 * config.ratio_dim),
                config.embed_dim,
                dtype,
                nn.initializers.zeros,
            )
        self.stages = [SwinStage(config, stage, dtype) for stage in stages]
        self.norms = [layer_norm(dtype) for _ in stages]
        self.mergings = [PatchMerging(dtype) for _ in stages[1:]]
        self.fusion = UPerNet(
            config.context_dim, config.pool_scales, config.linear_pooling, dtype
        )
        if config.communication in ("pre", "during"):
            dims = [config.stage_dim(stage) for stage in stages]
        else:
            dims = [config.context_dim] if config.communication == "post" else []
        block = nn.remat(SAB, static_argnums=(3,)) if config.remat else SAB
        self.communications = [
            block(
                features=dim,
                num_heads=config.communication_heads,
                mlp_dim=int(dim * config.communication_mlp_ratio),
                attention=config.attention,
                use_layer_norm=False,
                dropout_rate=config.dropout_rate,
                dtype=dtype,
            )
            for dim in dims
        ]
        if config.consensus_blocks:
            self.consensus = Consensus(
                config.consensus_blocks, config.consensus_dim, dtype
            )

    def __call__(
        self, images: Array, valid: Array | None = None, deterministic: bool = True
    ) -> Array:
        """Computes the contexts.

        Args:
            images: `[..., N, s, s, 4]`, normalised RGB and mask.
            valid: `[N]`, bool, or None where all images count.
            deterministic: no dropout.

        Returns:
            `[..., N, s/4, s/4, context_dim]`.
        """
        images = self.relate(images, valid)
        *sets, height, width, channels = images.shape
        flat = images.reshape(-1, height, width, channels)
        rest = (valid, deterministic, sets[-1])
        contexts = self.combine(self.extract(self.embed(flat), *rest), *rest)
        contexts, _ = self.agree(contexts.reshape(*sets, *contexts.shape[1:]), valid)
        return contexts

    def combine(
        self,
        maps: Sequence[Array],
        valid: Array | None = None,
        deterministic: bool = True,
        num_images: int | None = None,
    ) -> Array:
        """Turns the maps of `extract` into contexts, `[M, s/4, s/4, context_dim]`."""
        rest = (valid, deterministic, num_images)
        if self.config.communication == "pre":
            maps = [self.communicate(level, i, *rest) for i, level in enumerate(maps)]
        contexts = self.fuse(maps)
        if self.config.communication == "post":
            contexts = self.communicate(contexts, 0, *rest)
        return contexts

    def agree(
        self, contexts: Array, valid: Array | None = None
    ) -> tuple[Array, Guesses | None]:
        """Changes contexts by what their set's images agree on.

        Args:
            contexts: `[..., N, h, w, context_dim]`, from `combine`.
            valid: `[N]`, bool, or None.

        Returns:
            As `contexts`, and guesses of the normals and lights; without a consensus
            the contexts themselves, and None.
        """
        if not self.config.consensus_blocks:
            return contexts, None
        sets = contexts.reshape(-1, *contexts.shape[-4:])
        changed, guesses = self.consensus(sets, valid)
        return changed.reshape(contexts.shape), guesses

    def relate(self, images: Array, valid: Array | None = None) -> Array:
        """What `embed` is to see: `[..., N, s, s, 4]`, with ratios `[..., 7]`."""
        return append_ratios(images, valid) if self.config.ratio_dim else images

    def embed(self, images: Array) -> Array:
        """Embeds patches: `[M, s, s, C]` to tokens `[M, s/4, s/4, embed_dim]`.

        Args:
            images: from `relate`, the sets as one leading axis.
        """
        images = images.astype(self.config.dtype)
        tokens = self.patch_embed(images[..., :4])
        if self.config.ratio_dim:
            tokens = tokens + self.ratio_embed(images[..., 3:])
        return tokens

    def extract(
        self,
        tokens: Array,
        valid: Array | None = None,
        deterministic: bool = True,
        num_images: int | None = None,
    ) -> list[Array]:
        """Runs the backbone: tokens of `embed` to maps `[M, s/4/2**i, ..., C_i]`.

        `valid` and `num_images` (see `communicate`) matter for communication "during"
        only.
        """
        x, maps = tokens, []
        for i, norm in enumerate(self.norms):
            x = self.stage(x, i, deterministic)
            if self.config.communication == "during":
                x = self.communicate(x, i, valid, deterministic, num_images)
            maps.append(norm(x))
        return maps

    def stage(self, x: Array, index: int, deterministic: bool = True) -> Array:
        """Runs one stage on the map of the one before, the first on tokens."""
        if index:
            x = self.mergings[index - 1](x)
        return self.stages[index](x, deterministic)

    def communicate(
        self,
        level: Array,
        index: int,
        valid: Array | None,
        deterministic: bool = True,
        num_images: int | None = None,
    ) -> Array:
        """Lets the images of a set exchange features at every pixel.

        Args:
            level: `[M, ..., C]`.
            index: which map it is.
            valid: `[N]`, bool, or None.
            deterministic: no dropout.
            num_images: N; every N images in a row are a set. None: all are one set.

        Returns:
            As `level`.
        """
        sets = level.reshape(-1, num_images or len(level), *level.shape[1:])
        sets = jnp.moveaxis(sets, 1, -2)  # [..., N, C]
        sets = self.communications[index](sets, valid, deterministic)
        return jnp.moveaxis(sets, -2, 1).reshape(level.shape)

    def fuse(self, maps: Sequence[Array]) -> Array:
        """Fuses the maps of each image: `[N, s/4, s/4, context_dim]`."""
        return self.fusion(maps)


class Observation(nn.Module):
    """Lets a pixel's observations scale and shift its contexts.

    Beside each value stands its ratio to the set's mean, which no albedo changes. Our
    addition to the paper; begins as the identity.

    Attributes:
        features: width of the embedding.
        dtype: compute type.
    """

    features: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, pixels: Array, contexts: Array, valid: Array | None) -> Array:
        """Changes the contexts.

        Args:
            pixels: `[..., N, 3]`, normalised RGB.
            contexts: `[..., N, C]`.
            valid: `[N]`, bool, or None.

        Returns:
            As `contexts`.
        """
        light = jnp.maximum(pixels.astype(jnp.float32), 0)
        where = None if valid is None else valid[:, None]
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
    """The normal of a pixel from its set of N observations and contexts.

    Attributes:
        config: the network's configuration.
    """

    config: ModelConfig

    def setup(self) -> None:
        """Names the submodules."""
        config = self.config
        dtype = jnp.dtype(config.dtype)
        block = nn.remat(SAB, static_argnums=(3,)) if config.remat else SAB
        self.layers = [
            block(
                features=config.hidden_dim,
                num_heads=config.aggregation_heads,
                mlp_dim=config.aggregation_mlp_dim,
                attention=config.attention,
                dropout_rate=config.dropout_rate,
                dtype=dtype,
            )
            for _ in range(config.aggregation_layers)
        ]
        if config.aggregation == "pma":
            self.pooling = PMA(
                features=config.hidden_dim,
                num_heads=config.aggregation_heads,
                mlp_dim=config.pma_mlp_dim,
                attention=config.attention,
                dropout_rate=config.dropout_rate,
                dtype=dtype,
            )
        if config.observation_dim:
            self.observation = Observation(config.observation_dim, dtype)
        self.fc1 = dense(config.predictor_dim, dtype)
        self.fc2 = dense(_XYZ, dtype)

    def __call__(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Predicts normals.

        Args:
            pixels: `[..., N, 3]`, normalised RGB.
            contexts: `[..., N, context_dim]`, read at the pixels' places.
            valid: `[N]`, bool, or None.
            deterministic: no dropout.

        Returns:
            Unit normals, `[..., 3]`, float32.
        """
        features = self.aggregate(pixels, contexts, valid, deterministic)
        return ops.normalize(self.predict(features))

    def aggregate(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Turns each set into one vector: `[..., hidden_dim]`."""
        dtype = self.config.dtype
        if self.config.observation_dim:
            contexts = self.observation(pixels, contexts, valid)
        sets = jnp.concatenate([pixels.astype(dtype), contexts.astype(dtype)], axis=-1)
        for layer in self.layers:
            sets = layer(sets, valid, deterministic)  # [..., N, hidden_dim]
        if self.config.aggregation == "pma":
            return self.pooling(sets, valid, deterministic)[..., 0, :]
        if valid is not None:
            sets = jnp.where(valid[:, None], sets, -jnp.inf)
        return ops.largest(sets, axis=-2)

    def predict(self, features: Array) -> Array:
        """Vectors along the normals, `[..., 3]`, from `[..., hidden_dim]`."""
        return self.fc2(nn.relu(self.fc1(features)))


class UniPS(nn.Module):
    """The whole network for one object.

    Attributes:
        config: sizes and variants.
    """

    config: ModelConfig

    def setup(self) -> None:
        """Names the two halves."""
        self.encoder = Encoder(self.config)
        self.decoder = Decoder(self.config)

    def __call__(
        self,
        images: Array,
        pixels: Array,
        rows: Array,
        columns: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Predicts the normals of some pixels.

        Args:
            images: `[N, s, s, 4]`, of canonical size: normalised RGB and mask.
            pixels: `[P, N, 3]`, normalised RGB at the pixels.
            rows: `[P]`, the pixels' rows in cells of the contexts' grid.
            columns: `[P]`, likewise.
            valid: `[N]`, bool, or None.
            deterministic: no dropout.

        Returns:
            Unit normals, `[P, 3]`.
        """
        contexts = self.encoder(images, valid, deterministic)
        sampled = self.sample(contexts, rows, columns)
        return self.decoder(pixels, sampled, valid, deterministic)

    def sample(self, contexts: Array, rows: Array, columns: Array) -> Array:
        """Reads contexts at the pixels' places: `[P, N, context_dim]`."""
        zeros = self.config.context_sampling == "corner"
        sampled = ops.bilinear_sample(contexts, rows, columns, zeros=zeros)
        return jnp.moveaxis(sampled, 0, 1)
