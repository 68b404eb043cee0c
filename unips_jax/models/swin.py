"""Swin Transformer with a convolutional patch embedding.

Source: Liu et al., "Swin Transformer", ICCV 2021; the embedding replaces Swin's linear
one as in UniPS (Ikehata, CVPR 2022), supplement. Maps are `[B, h, w, C]`.
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops
from unips_jax.models.config import ModelConfig
from unips_jax.models.set_attention import (
    dense,
    dot_product_attention,
    layer_norm,
    truncated_normal,
)


class PatchEmbed(nn.Module):
    """Five convolutions without bias that reduce each side by four."""

    channels: tuple[int, int]  # of the first two, and of the next two
    embed_dim: int
    dtype: DTypeLike = jnp.float32
    last_init: nn.initializers.Initializer = nn.initializers.he_normal()

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Embeds `[B, H, W, C]` into `[B, H/4, W/4, embed_dim]`."""
        first, second = self.channels
        layers = (
            (first, 3, 2),
            (first, 3, 1),
            (second, 3, 2),
            (second, 3, 1),
            (self.embed_dim, 1, 1),
        )
        for i, (features, kernel, stride) in enumerate(layers):
            last = i + 1 == len(layers)
            x = nn.Conv(
                features,
                (kernel, kernel),
                strides=stride,
                padding=kernel // 2,
                use_bias=False,
                dtype=self.dtype,
                kernel_init=self.last_init if last else nn.initializers.he_normal(),
                conv_general_dilated=ops.convolution,
                name=f"conv{i}",
            )(x)
            if not last:
                x = nn.relu(x)
        return x


class WindowAttention(nn.Module):
    """Multi-head self-attention within windows, with relative position bias."""

    num_heads: int
    window_size: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Array, mask: np.ndarray | None) -> Array:
        """Attends in `[B * windows, T, C]`; `mask [windows, T, T]` adds to logits."""
        b, t, c = x.shape
        table = self.param(
            "relative_position_bias_table",
            truncated_normal(),
            ((2 * self.window_size - 1) ** 2, self.num_heads),
            jnp.float32,
        )
        qkv = dense(3 * c, self.dtype, "qkv")(x)
        q, k, v = jnp.split(qkv, 3, axis=-1)  # [B * windows, T, C]
        index = ops.relative_position_index(self.window_size)
        bias = table[index].transpose(2, 0, 1)[None]  # [1, heads, T, T]
        if mask is not None:
            bias = bias + mask[:, None]  # [windows, heads, T, T]
        windows = bias.shape[0]
        attended = dot_product_attention(
            *(z.reshape(-1, windows, t, c) for z in (q, k, v)),
            num_heads=self.num_heads,
            scale=(c // self.num_heads) ** -0.5,
            bias=bias,
        )
        x = attended.reshape(b, t, c)
        return dense(c, self.dtype, "proj")(x)


class SwinBlock(nn.Module):
    """Window attention and an MLP, each with LayerNorm before and a residual."""

    num_heads: int
    window_size: int
    shift_size: int  # 0 for even blocks
    mlp_ratio: float
    drop_path_rate: float  # per map
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Array, deterministic: bool) -> Array:
        drop_path = nn.Dropout(self.drop_path_rate, broadcast_dims=(1, 2, 3))
        x = x + drop_path(self._attend(x), deterministic)
        hidden = layer_norm(self.dtype, "norm2")(x)
        hidden = dense(int(x.shape[-1] * self.mlp_ratio), self.dtype, "fc1")(hidden)
        hidden = ops.gelu(hidden)
        hidden = dense(x.shape[-1], self.dtype, "fc2")(hidden)
        return x + drop_path(hidden, deterministic)

    def _attend(self, x: Array) -> Array:
        _, h, w, _ = x.shape
        x = layer_norm(self.dtype, "norm1")(x)
        # Padding takes part in attention, as zeros after the norm.
        bottom, right = -h % self.window_size, -w % self.window_size
        x = jnp.pad(x, ((0, 0), (0, bottom), (0, right), (0, 0)))
        padded = (h + bottom, w + right)
        shift, mask = self.shift_size, None
        if shift:
            x = jnp.roll(x, (-shift, -shift), axis=(1, 2))
            mask = ops.shift_mask(*padded, self.window_size, shift)
        windows = ops.window_partition(x, self.window_size)
        windows = WindowAttention(
            self.num_heads, self.window_size, self.dtype, name="attn"
        )(windows, mask)
        x = ops.window_reverse(windows, *padded)
        if shift:
            x = jnp.roll(x, (shift, shift), axis=(1, 2))
        return x[:, :h, :w]


class PatchMerging(nn.Module):
    """Halves each side and doubles the channels."""

    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Maps `[B, h, w, C]` to `[B, ceil(h/2), ceil(w/2), 2C]`."""
        _, h, w, c = x.shape
        x = jnp.pad(x, ((0, 0), (0, h % 2), (0, w % 2), (0, 0)))
        corners = [x[:, i::2, j::2] for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))]
        x = layer_norm(self.dtype, "norm")(jnp.concatenate(corners, axis=-1))
        return dense(2 * c, self.dtype, "reduction", use_bias=False)(x)


class SwinStage(nn.Module):
    """The merging of patches, but in the first stage, and the blocks of one stage."""

    config: ModelConfig
    stage: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Array, deterministic: bool) -> Array:
        """`[B, h, w, C]` to `[B, h/2, w/2, 2C]`; the first stage keeps the shape."""
        if self.stage:
            x = PatchMerging(self.dtype, name="merging")(x)
        config, before = self.config, sum(self.config.depths[: self.stage])
        block = nn.remat(SwinBlock, static_argnums=(2,)) if config.remat else SwinBlock
        last = max(sum(config.depths) - 1, 1)
        for i in range(config.depths[self.stage]):
            x = block(
                num_heads=config.num_heads[self.stage],
                window_size=config.window_size,
                shift_size=config.window_size // 2 if i % 2 else 0,
                mlp_ratio=config.mlp_ratio,
                drop_path_rate=config.drop_path_rate * (before + i) / last,
                dtype=self.dtype,
                name=f"block{i}",
            )(x, deterministic)
        return x
