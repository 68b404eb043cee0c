"""Contexts on a finer grid, changed by what is seen there.

Our addition to the paper, whose contexts have a cell for 4 x 4 pixels of the encoder's
images: nothing between a pixel and a cell reaches the decoder. The Haar bands of images
twice as large go in as further channels (LINO-UniPS, ICLR 2026, has wavelets too), and
the contexts end on a grid with nodes at the coarse cells' centres, their borders and
halfway: reading between nodes then begins as reading between cells.
"""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops
from unips_jax.models.set_attention import Dense, layer_norm


def node_matrix(cells: int) -> np.ndarray:
    """Weights of an axis' cells at nodes half a cell apart: `[2 cells + 1, cells]`."""
    # What lies beyond the outer cells' centres has their values, as in
    # `bilinear_sample`.
    places = np.clip((np.arange(2 * cells + 1) - 1) / 2, 0, cells - 1)
    return np.maximum(1 - np.abs(places[:, None] - np.arange(cells)), 0)


def at_nodes(contexts: Array) -> Array:
    """Contexts of cells, `[M, h, w, C]`, at the nodes: `[M, 2h + 1, 2w + 1, C]`."""
    rows, columns = (
        node_matrix(size).astype(contexts.dtype) for size in contexts.shape[1:3]
    )
    return jnp.einsum("ih,jw,mhwc->mijc", rows, columns, contexts)


class Fine(nn.Module):
    """Contexts at the nodes, changed by convolutions; unchanged at first."""

    features: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, contexts_and_images: tuple[Array, Array]) -> Array:
        """`[M, h, w, C]` and `[M, 4h, 4w, K]` to `[M, 2h + 1, 2w + 1, C]`."""
        contexts, images = contexts_and_images
        contexts = at_nodes(contexts)
        seen = self._conv(self.features, (4, 2, 2), "seen")(images.astype(self.dtype))
        normed = layer_norm(self.dtype, "norm")(contexts)
        x = jnp.concatenate([ops.gelu(seen), normed], axis=-1)
        x = ops.gelu(self._conv(self.features, (3, 1, 1), "join")(x))
        zeros = nn.initializers.zeros
        width = contexts.shape[-1]
        change = Dense(width, dtype=self.dtype, kernel_init=zeros, name="change")
        return contexts + change(x)

    def _conv(self, features: int, shape: tuple[int, int, int], name: str) -> nn.Conv:
        """A convolution; `shape` is its side, stride and padding."""
        side, stride, padding = shape
        return nn.Conv(
            features,
            (side, side),
            strides=stride,
            padding=padding,
            dtype=self.dtype,
            kernel_init=nn.initializers.he_normal(),
            conv_general_dilated=ops.convolution,
            name=name,
        )
