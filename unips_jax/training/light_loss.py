"""How far guesses of the kinds of light are off (see `models.light_tokens`)."""

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from unips_jax.models import ops
from unips_jax.models.light_tokens import LightGuess
from unips_jax.scenes.incident import IncidentLight


def light_losses(guess: LightGuess, true: IncidentLight) -> dict[str, Array]:
    """Mean losses over the images whose light is known, each about 1 for bad guesses.

    Of arrays `[B, N, ...]`. Directions and distance count by the lamp's share.
    "harmonics" is the distance of the coefficients, relative to the first one's mean
    colour; "lamps" that of shares, directions and nearness, of both kinds of lamp.
    """
    power = jnp.mean(true.harmonics[..., 0, :], axis=-1)[..., None, None]
    relative = true.harmonics / jnp.maximum(power, 1e-6)
    squared = jnp.mean(jnp.square(guess.harmonics - relative), axis=(-2, -1))
    known = true.harmonics_known & (power[..., 0, 0] > 1e-6)
    lamps, share = jnp.zeros(squared.shape), jnp.asarray(true.lamp_share)
    near = true.lamp_nearness > 0
    for is_kind, direction, logit in (
        (near, guess.near, guess.near_share),
        (~near, guess.distant, guess.distant_share),
    ):
        mine = jnp.where(is_kind, share, 0.0)
        lamps += jnp.abs(jax.nn.sigmoid(logit) - mine)
        away = jnp.square(ops.normalize(direction) - true.lamp_direction)
        lamps += mine * _distance(jnp.sum(away, axis=-1))
    away = jnp.square(guess.nearness - true.lamp_nearness)
    lamps += jnp.where(near, share, 0.0) * _distance(away)
    return {
        "harmonics": _mean(_distance(squared), known),
        "lamps": _mean(lamps, true.lamp_known),
    }


def _distance(squared: Array) -> Array:
    return jnp.sqrt(squared + 1e-3) - 1e-3**0.5


def _mean(values: Array, known: ArrayLike) -> Array:
    known = jnp.asarray(known)
    return jnp.sum(jnp.where(known, values, 0)) / jnp.maximum(jnp.sum(known), 1)
