"""What the images of a set agree on: the object's shape, and each image's light.

Our addition to the paper, whose encoder sees an image at a time, and at most features
at the same place in the others. Here one map stands for the whole set, so that
attention over the whole square costs as much as for one image. Coarse normals and the
lights are guessed on the way, and training compares them with the true ones: where the
lights are is most of what uncalibrated photometric stereo has to find out (SDPS-Net,
Chen et al., CVPR 2019, has a network of its own for it).
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops
from unips_jax.models.encoding import Guesses
from unips_jax.models.known_lights import KnownLights, moved_to_known
from unips_jax.models.light_tokens import LightTokens
from unips_jax.models.set_attention import SAB, Dense, dense, layer_norm

# Width of an attention head, and of the MLP over the block's.
_HEAD = 32
_MLP_RATIO = 3


class Consensus(nn.Module):
    """Changes contexts by what the images of their set agree on; identity at first.

    A map of the set comes from the contexts' mean and maximum over the images; each
    image's light from how its contexts go with that map; a better map from both.
    """

    blocks: int  # of attention over the map, half of them before the lights
    features: int  # a multiple of 32
    light_tokens: bool = False
    known_lights: bool = False
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self, contexts: Array, valid: Array | None = None, lights: Array | None = None
    ) -> tuple[Array, Guesses]:
        """Contexts `[B, N, h, w, C]`, changed; `valid [N]`, `lights [B, N, 3]`."""
        batch, images, height, width, channels = contexts.shape
        cells = contexts.reshape(batch, images, -1, channels)  # [B, N, T, C]
        normed = layer_norm(self.dtype, "norm_contexts")(cells)
        each = dense(self.features, self.dtype, "each")(normed)

        place = ops.sinusoids(height, width).astype(self.dtype)
        place = place.reshape(height * width, -1)
        shape = dense(self.features, self.dtype, "pooled")(_pool(normed, valid))
        shape = shape + dense(self.features, self.dtype, "place")(
            place[None]
        )  # [B, T, F]
        for i in range(self.blocks // 2):
            shape = self._block(f"block{i}")(shape, None, True)

        # How an image's contexts go with the shape they show says where its light is.
        known = dense(2 * self.features, self.dtype, "known")(
            layer_norm(self.dtype, "norm_known")(shape)
        )
        shift, gain = jnp.split(known[:, None], 2, axis=-1)
        related = ops.gelu(each + shift)  # [B, N, T, F]
        light = jnp.mean(related * gain, axis=2)  # [B, N, F]
        whole = jnp.concatenate(
            [jnp.mean(normed, axis=2), ops.largest(normed, axis=2)], axis=-1
        )
        light = light + dense(self.features, self.dtype, "whole")(whole)
        light = self._block("block_lights")(light, valid, True)
        light = layer_norm(self.dtype, "norm_lights")(light)
        if self.known_lights and (lights is not None or self.is_initializing()):
            given = jnp.zeros((batch, images, 3)) if lights is None else lights
            light = light + KnownLights(self.features, self.dtype, name="given")(given)
        kinds = None
        if self.light_tokens:
            tokens = LightTokens(self.features, self.dtype, name="tokens")
            light, kinds = tokens(related, light, valid)
        guess = dense(3, self.dtype, "lights")
        if lights is not None:
            # The smallest change of the features that moves the guess as it should.
            change = moved_to_known(guess(light), lights)
            kernel = guess.variables["params"]["kernel"].astype(jnp.float32)
            light = light + change @ jnp.linalg.pinv(kernel)

        from_light = dense(self.features, self.dtype, "from_light")(light)
        from_shape = dense(self.features, self.dtype, "from_shape")(shape)
        lit = ops.gelu(each + from_light[:, :, None] + from_shape[:, None])
        shape = shape + dense(self.features, self.dtype, "pooled_lit")(
            _pool(lit, valid)
        )
        for i in range(self.blocks // 2, self.blocks):
            shape = self._block(f"block{i}")(shape, None, True)
        shape = layer_norm(self.dtype, "norm_shape")(shape)

        normals = dense(3, self.dtype, "normals")(shape)
        guesses = Guesses(
            normals.reshape(batch, height, width, 3),
            guess(light),
            kinds,
        )
        cells = cells + self._change("change_shape", channels)(shape)[:, None]
        cells = cells + self._change("change_light", channels)(light)[:, :, None]
        return cells.reshape(contexts.shape), guesses

    def _block(self, name: str) -> SAB:
        return SAB(
            features=self.features,
            num_heads=self.features // _HEAD,
            mlp_dim=_MLP_RATIO * self.features,
            attention="pre_norm",
            dtype=self.dtype,
            name=name,
        )

    def _change(self, name: str, channels: int) -> Dense:
        zeros = nn.initializers.zeros
        return Dense(channels, dtype=self.dtype, kernel_init=zeros, name=name)


def _pool(x: Array, valid: Array | None) -> Array:
    """Mean and maximum over the images: `[B, N, T, C]` to `[B, T, 2 C]`."""
    where = None if valid is None else valid[None, :, None, None]
    mean = jnp.mean(x, axis=1, where=where)
    counted = x if where is None else jnp.where(where, x, -jnp.inf)
    return jnp.concatenate([mean, ops.largest(counted, axis=1)], axis=-1)
