"""Lights that are known, from a rig or by hand, and what the network makes of them.

Our addition to the paper, which knows no light. An image's light is `[3]`, towards its
lamp (x right, y up, z to the viewer). Its length says how well it is known: 1 exactly,
else the cosine of the error that is to be expected; 0 not at all.

A known light acts in two ways. The network's own guess is moved to it, at once and
without training (`moved_to_known`). And the network learns to use it (`KnownLights`).
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from unips_jax.models import ops

# Lengths of a guess (see `scenes.Scene.light_means`): of one lamp alone it is longer.
_MIXED, _LAMP = 0.5, 0.9


class KnownLights(nn.Module):
    """What a known light changes of what an image says of it; zero at first."""

    features: int
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, lights: Array) -> Array:
        """`[B, N, 3]` to `[B, N, features]`; exactly zero where nothing is known."""
        towards, error = _known(lights)
        x, y, z = jnp.split(towards, 3, axis=-1)
        products = [x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]
        seen = jnp.concatenate([towards, *products, error], axis=-1)
        hidden = ops.gelu(nn.Dense(self.features, dtype=self.dtype, name="embed")(seen))
        change = nn.Dense(
            self.features,
            dtype=self.dtype,
            kernel_init=nn.initializers.zeros,
            name="change",
        )
        there = jnp.any(lights != 0, axis=-1, keepdims=True)
        return jnp.where(there, change(hidden), 0)


def moved_to_known(guess: Array, lights: Array) -> Array:
    """By how much guessed lights `[B, N, 3]` are to change for known ones, `[B, N, 3]`.

    A guess turns as far as the error of the known light does not explain. A short one,
    of a lamp in surroundings, stays: it is the mean of all light, not the lamp.
    """
    towards, error = _known(lights)
    length = _length(guess)
    away = towards - guess / length
    share = jnp.maximum(1 - 2 * jnp.sin(error / 2) / _length(away), 0)
    share *= jnp.clip((length - _MIXED) / (_LAMP - _MIXED), 0, 1)
    there = jnp.any(lights != 0, axis=-1, keepdims=True)
    return jnp.where(there, share * length * away, 0)


def _length(vectors: Array) -> Array:
    """`[..., 3]` to `[..., 1]`, above 0, with finite gradients."""
    return jnp.sqrt(jnp.sum(jnp.square(vectors), axis=-1, keepdims=True) + 1e-9)


def _known(lights: Array) -> tuple[Array, Array]:
    """Unit directions `[B, N, 3]`, and errors to expect in radians `[B, N, 1]`."""
    towards = ops.normalize(lights)
    length = jnp.sum(towards * lights, axis=-1, keepdims=True)
    return towards, jnp.arccos(jnp.clip(length, 0, 1 - 1e-6))
