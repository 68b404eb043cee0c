"""What else can be said of a pixel: how far off its normal may be, and its material.

Our addition to the paper; SDM-UniPS (Ikehata, CVPR 2023) predicts the material's maps
from the same features too. The heads read what the normals are predicted from and never
change it: no gradient passes, so that a network has the same normals with and without.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops
from unips_jax.models.set_attention import dense, layer_norm

# Of an image whose mean is 1: values below are noise.
_DARK = 0.02
# What the error's head says at first, in degrees; it answers in powers of e times it.
_TYPICAL = 15.0


class Maps(NamedTuple):
    """What the heads say of pixels.

    Attributes:
        error: `[...]`, degrees: nine pixels in ten have normals less far off.
        base_color: `[..., 3]`, linear, in [0, 1]; of metals their reflectance. Its
            scale is a guess: photographs cannot tell bright lights from bright matter.
        roughness: `[...]`, in [0, 1], perceptual (the square root of GGX's alpha).
        metallic: `[...]`, in [0, 1].
    """

    error: Array
    base_color: Array
    roughness: Array
    metallic: Array


class Heads(nn.Module):
    """Maps of pixels from their aggregated vectors and their observations.

    Attributes:
        features: width of the hidden layers.
        dtype: compute type.
    """

    features: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, aggregated: Array, pixels: Array, valid: Array | None) -> Maps:
        """Predicts the maps.

        Args:
            aggregated: `[..., hidden_dim]`; taken as a constant.
            pixels: `[..., N, 3]`, normalised RGB.
            valid: `[N]`, bool, or None.
        """
        x = layer_norm(self.dtype, "norm")(jax.lax.stop_gradient(aggregated))
        seen = _statistics(pixels, valid).astype(self.dtype)
        x = dense(self.features, self.dtype, "aggregated")(x)
        x = ops.gelu(x + dense(self.features, self.dtype, "observed")(seen))
        x = ops.gelu(dense(self.features, self.dtype, "hidden")(x))
        out = dense(6, self.dtype, "maps")(x).astype(jnp.float32)
        return Maps(
            error=jnp.minimum(_TYPICAL * jnp.exp(jnp.minimum(out[..., 0], 4)), 180),
            base_color=jax.nn.sigmoid(out[..., 1:4]),
            roughness=jax.nn.sigmoid(out[..., 4]),
            metallic=jax.nn.sigmoid(out[..., 5]),
        )


def _statistics(pixels: Array, valid: Array | None) -> Array:
    """Of a pixel's N observations, `[..., N, 3]` to `[..., 15]`."""
    light = jnp.maximum(pixels.astype(jnp.float32), 0)
    where = None if valid is None else ops.leading(valid[:, None], light.ndim)
    logarithm = jnp.log(light + _DARK)
    counted = True if where is None else where
    mean = jnp.mean(light, axis=-2, where=where)
    return jnp.concatenate(
        [
            mean,
            jnp.log(mean + _DARK),
            jnp.mean(logarithm, axis=-2, where=where),
            jnp.max(logarithm, axis=-2, where=counted, initial=-10.0),
            jnp.min(logarithm, axis=-2, where=counted, initial=10.0),
        ],
        axis=-1,
    )
