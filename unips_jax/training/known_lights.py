"""Lights as somebody might know them, to train with (see `models.known_lights`)."""

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.models import ops
from unips_jax.scenes.incident import IncidentLight

# A lamp whose share of the light is smaller is none that somebody would name.
_LEAST_SHARE = 0.3
_LARGEST_ERROR = 0.61  # radians: 35 degrees, as by "upper left"


def draw_known_lights(incident: IncidentLight, key: Array, share: float) -> Array:
    """What is known of a set's lights, `[N, 3]`, as `models.known_lights` has them."""
    # Of a share of the sets lights are known: of four in ten exactly, of the others
    # with an error of up to 35 degrees. In half of those sets some photographs lack
    # theirs.
    directions = jnp.asarray(incident.lamp_direction)
    known = jnp.asarray(incident.lamp_known) & (incident.lamp_share > _LEAST_SHARE)
    keys = jax.random.split(key, 4)
    some, exact, gaps = jax.random.bernoulli(
        keys[0], jnp.array([share, 0.4, 0.5], jnp.float32), (3,)
    )
    uneven = jax.random.uniform(keys[1], (), jnp.float32, maxval=_LARGEST_ERROR)
    error = jnp.where(exact, 0, uneven)
    given = known & some
    lacking = jax.random.bernoulli(keys[2], jnp.float32(0.3), known.shape)
    given &= ~(gaps & lacking)
    # A normal error across the direction: two axes share its square.
    noise = jax.random.normal(keys[3], directions.shape, jnp.float32) * error / 2**0.5
    across = noise - directions * jnp.sum(noise * directions, axis=-1, keepdims=True)
    seen = ops.normalize(directions + across) * jnp.cos(error)
    return jnp.where(given[:, None], seen, 0)
