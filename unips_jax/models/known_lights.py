"""Lights that are known, from a rig or by hand, and what the network makes of them.

Our addition to the paper, which knows no light. An image's light is `[3]`, towards its
lamp (x right, y up, z to the viewer). Its length says how well it is known: 1 exactly,
else the cosine of the error that is to be expected; 0 not at all.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops
from unips_jax.models.set_attention import dense


class KnownLights(nn.Module):
    """What a known light changes of what an image says of it; zero at first."""

    features: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, lights: Array) -> Array:
        """`[B, N, 3]` to `[B, N, features]`; exactly zero where nothing is known."""
        towards = ops.normalize(lights)
        length = jnp.sum(towards * lights, axis=-1, keepdims=True)
        error = jnp.arccos(jnp.clip(length, 0, 1 - 1e-6))
        seen = jnp.concatenate([towards, error], axis=-1)
        x = ops.gelu(dense(self.features, self.dtype, "embed")(seen))
        change = nn.Dense(
            self.features,
            dtype=self.dtype,
            kernel_init=nn.initializers.zeros,
            name="change",
        )
        return jnp.where(length > 0, change(x), 0)
