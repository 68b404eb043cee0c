"""What kind of light each image has: a token for each kind, and what it guesses.

LINO-UniPS (ICLR 2026) gains most of what its supervised lights gain by telling kinds of
light apart; it also has register tokens, which stand for nothing. Here each image has
tokens for its surroundings, a lamp near by and one far away, and four registers. They
read the image's cells, then those of all images read from each other.
"""

from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models.set_attention import PMA, SAB, dense, layer_norm

_KINDS, _REGISTERS = 3, 4  # surroundings, near lamp, distant lamp
TOKENS = _KINDS + _REGISTERS  # of an image
_QUERY_CHUNK = 512  # tokens of a large set that attend to all of them at a time


class LightGuess(NamedTuple):
    """What the tokens guess of the light of B sets of N images."""

    # [B, N, 9, 3], coefficients of all its radiance, divided by the mean colour of the
    # first (see `scenes.IncidentLight`)
    harmonics: Array
    near: Array  # [B, N, 3], towards a near lamp, any length
    nearness: Array  # [B, N], 1 / its distance in radii of the object
    near_share: Array  # [B, N], the logit of its share of all light
    distant: Array  # [B, N, 3], towards a distant lamp, any length
    distant_share: Array  # [B, N], as `near_share`


class LightTokens(nn.Module):
    """Changes what is known of each image's light by its kind; identity at first."""

    features: int  # a multiple of 32
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(
        self, cells: Array, light: Array, valid: Array | None
    ) -> tuple[Array, LightGuess]:
        """The light `[B, N, F]`, changed by cells `[B, N, T, F]`, and the guesses."""
        batch, images = light.shape[:2]
        options: dict[str, Any] = dict(
            features=self.features,
            num_heads=self.features // 32,
            mlp_dim=2 * self.features,
            attention="pre_norm",
            dtype=self.dtype,
        )
        tokens = PMA(num_seeds=TOKENS, name="read", **options)(cells, None, True)
        tokens = tokens + dense(self.features, self.dtype, "light")(light)[:, :, None]
        tokens = tokens.reshape(batch, images * TOKENS, self.features)
        members = None if valid is None else jnp.repeat(valid, TOKENS)
        share = SAB(name="share", query_chunk=_QUERY_CHUNK, **options)
        tokens = share(tokens, members, True)
        tokens = layer_norm(self.dtype, "norm")(tokens)
        tokens = tokens.reshape(batch, images, TOKENS, self.features)

        around, near, distant = (tokens[:, :, i] for i in range(_KINDS))
        harmonics = dense(27, self.dtype, "around")(around)
        near = dense(5, self.dtype, "near")(near)
        distant = dense(4, self.dtype, "distant")(distant)
        guess = LightGuess(
            harmonics.reshape(batch, images, 9, 3),
            near[..., :3],
            nn.softplus(near[..., 4] - 2),
            near[..., 3],
            distant[..., :3],
            distant[..., 3],
        )
        zeros = nn.initializers.zeros
        change = nn.Dense(
            self.features, dtype=self.dtype, kernel_init=zeros, name="change"
        )
        return light + change(tokens.reshape(batch, images, -1)), guess
