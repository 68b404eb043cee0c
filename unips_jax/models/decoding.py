"""What the decoders of both networks are made of: a pixel's set becomes its normal.

Source: UniPS (Ikehata, CVPR 2022), Sec. 4.2 and supplement.
"""

from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from unips_jax.models import ops
from unips_jax.models.config import ModelConfig
from unips_jax.models.set_attention import PMA, SAB, AttentionKind, dense

# Components of a normal.
_XYZ = 3


class Aggregation(nn.Module):
    """One vector from the set of a pixel's observations, each with its context."""

    config: ModelConfig
    attention: AttentionKind = "pre_norm"
    pooling: Literal["pma", "max"] = "pma"

    @nn.compact
    def __call__(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """RGB `[..., N, 3]` and contexts `[..., N, C]` to `[..., hidden_dim]`."""
        config = self.config
        dtype = jnp.dtype(config.dtype)
        # One pixel's observations may go with the contexts of several views.
        pixels = jnp.broadcast_to(pixels, (*contexts.shape[:-1], pixels.shape[-1]))
        sets = jnp.concatenate([pixels.astype(dtype), contexts.astype(dtype)], axis=-1)
        block = nn.remat(SAB, static_argnums=(3,)) if config.remat else SAB
        for i in range(config.aggregation_layers):
            sets = block(
                features=config.hidden_dim,
                num_heads=config.aggregation_heads,
                mlp_dim=config.aggregation_mlp_dim,
                attention=self.attention,
                dropout_rate=config.dropout_rate,
                dtype=dtype,
                name=f"layer{i}",
            )(sets, valid, deterministic)  # [..., N, hidden_dim]
        if self.pooling == "max":
            if valid is not None:
                sets = jnp.where(ops.leading(valid[:, None], sets.ndim), sets, -jnp.inf)
            return ops.largest(sets, axis=-2)
        pooled = PMA(
            features=config.hidden_dim,
            num_heads=config.aggregation_heads,
            mlp_dim=config.pma_mlp_dim,
            attention=self.attention,
            dropout_rate=config.dropout_rate,
            dtype=dtype,
            name="pooling",
        )(sets, valid, deterministic)
        return pooled[..., 0, :]


class Prediction(nn.Module):
    """A vector along the normal, from a pixel's aggregated vector."""

    config: ModelConfig

    @nn.compact
    def __call__(self, features: Array) -> Array:
        """Maps `[..., hidden_dim]` to `[..., 3]`, of any length."""
        dtype = jnp.dtype(self.config.dtype)
        hidden = dense(self.config.predictor_dim, dtype, "fc1")(features)
        return dense(_XYZ, dtype, "fc2")(nn.relu(hidden))
