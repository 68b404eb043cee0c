"""Lights as classes: how GCNet and LCNet write a direction and an intensity.

36 classes of azimuth and 36 of elevation, 5 degrees each, over the front hemisphere;
20 classes of intensity over [0.2, 2]. GCNet reads a class as its expectation, LCNet
as the likeliest (Chen et al., ECCV 2020 and CVPR 2019).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.baselines.method import Lights

NUM_ANGLES = 36
NUM_INTENSITIES = 20
_LEAST, _MOST = 0.2, 2.0


class Logits(NamedTuple):
    """A lighting network's answer, per image."""

    azimuth: Array  # `[B, N, 36]`
    elevation: Array  # `[B, N, 36]`
    intensity: Array  # `[B, N, 20]`
    features: Array  # `[B, N, h, w, C]`, each image's own, before the fusion


def soft_lights(logits: Logits) -> tuple[Array, Array]:
    """Unit directions and intensities, in [0.2, 2], at the expected class (GCNet)."""

    def expected(x: Array) -> Array:
        classes = jnp.arange(x.shape[-1], dtype=jnp.float32)
        return jnp.sum(jax.nn.softmax(x, axis=-1) * classes, axis=-1)

    return decode(*(expected(x) for x in logits[:3]))


def hard_lights(logits: Logits) -> tuple[Array, Array]:
    """Directions and intensities at the likeliest class (LCNet)."""
    return decode(*(jnp.argmax(x, axis=-1) for x in logits[:3]))


def decode(azimuth: Array, elevation: Array, intensity: Array) -> tuple[Array, Array]:
    """Directions `[..., 3]` and intensities `[..., 1]` at (real-valued) classes.

    Azimuth, atan(x / z), and elevation, atan(y / hypot(x, z)), are in steps of 5
    degrees from -90; intensity is in steps of 0.09 from 0.2.
    """
    theta, phi = (
        jnp.deg2rad((c + 0.5) / NUM_ANGLES * 180 - 90) for c in (azimuth, elevation)
    )
    directions = jnp.stack(
        [jnp.cos(phi) * jnp.sin(theta), jnp.sin(phi), jnp.cos(phi) * jnp.cos(theta)],
        axis=-1,
    )
    directions /= jnp.linalg.norm(directions, axis=-1, keepdims=True)
    value = (intensity + 0.5) / NUM_INTENSITIES * (_MOST - _LEAST) + _LEAST
    return directions, jnp.clip(value, _LEAST, _MOST)[..., None]


def light_errors(found: Lights, true: Lights) -> dict[str, float]:
    """How far lights are from the true ones, as in SDPS-Net (CVPR 2019).

    The mean angle between directions in degrees; and the mean relative error of
    intensities (averaged over channels) after the factor that fits them best.
    """
    cosine = np.sum(found.directions * true.directions, axis=-1)
    angle = np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).mean()
    guess, known = (lights.intensities.mean(axis=-1) for lights in (found, true))
    factor = np.sum(guess * known) / np.maximum(np.sum(guess**2), 1e-12)
    relative = np.abs(factor * guess - known) / np.maximum(known, 1e-12)
    return {
        "light direction error (degrees)": float(angle),
        "light intensity error (relative)": float(relative.mean()),
    }


def encode(directions: Array, intensities: Array) -> tuple[Array, Array, Array]:
    """Classes, int32, of lights `[..., 3]` with z >= 0, to train networks with."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    angles = (
        jnp.arctan(x / (z + 1e-8)),
        jnp.arctan(y / (jnp.sqrt(x**2 + z**2) + 1e-8)),
    )
    azimuth, elevation = (
        _bin((jnp.rad2deg(angle) + 90) / 180, NUM_ANGLES) for angle in angles
    )
    share = (intensities - _LEAST) / (_MOST - _LEAST)
    return azimuth, elevation, _bin(share, NUM_INTENSITIES)


def _bin(share: Array, count: int) -> Array:
    return jnp.clip(jnp.floor(share * count), 0, count - 1).astype(jnp.int32)
