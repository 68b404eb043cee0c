"""UPerNet: fuses the maps of all scales into one.

Source: Xiao et al., "Unified Perceptual Parsing for Scene Understanding", ECCV 2018,
as used in UniPS (Ikehata, CVPR 2022): every convolution with a bias and a ReLU, no
batch normalisation.
"""

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops


class UPerNet(nn.Module):
    """Pyramid pooling on the coarsest map, then a feature pyramid."""

    features: int
    pool_scales: tuple[int, ...]  # bins per side
    linear_pooling: bool = False  # no ReLU in the pooling, nor after it
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, maps: Sequence[Array]) -> Array:
        """Maps `[B, h_i, w_i, C_i]`, finest first, to `[B, h_0, w_0, features]`."""
        laterals = [
            self._conv(1, f"lateral{i}")(level) for i, level in enumerate(maps[:-1])
        ]
        laterals.append(self._pyramid_pooling(maps[-1]))
        for i in reversed(range(len(laterals) - 1)):
            coarser = ops.resize_bilinear(laterals[i + 1], laterals[i].shape[1:3])
            laterals[i] = laterals[i] + coarser
        levels = [
            self._conv(3, f"fpn{i}")(level) for i, level in enumerate(laterals[:-1])
        ]
        levels.append(laterals[-1])
        size = maps[0].shape[1:3]
        levels = [ops.resize_bilinear(level, size) for level in levels]
        return self._conv(3, "fpn_bottleneck")(jnp.concatenate(levels, axis=-1))

    def _pyramid_pooling(self, x: Array) -> Array:
        relu = not self.linear_pooling
        pooled = [x]
        for i, bins in enumerate(self.pool_scales):
            conv = self._conv(1, f"ppm{i}", relu=relu)
            level = conv(ops.adaptive_average_pool(x, bins))
            pooled.append(ops.resize_bilinear(level, x.shape[1:3]))
        bottleneck = self._conv(3, "ppm_bottleneck", relu=relu)
        return bottleneck(jnp.concatenate(pooled, axis=-1))

    def _conv(self, size: int, name: str, *, relu: bool = True):
        conv = nn.Conv(
            self.features,
            (size, size),
            padding=size // 2,
            dtype=self.dtype,
            kernel_init=nn.initializers.he_normal(),
            conv_general_dilated=ops.convolution,
            name=name,
        )
        return (lambda x: nn.relu(conv(x))) if relu else conv
