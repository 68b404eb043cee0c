"""What is known of the light that reaches an object: targets for a network's guesses.

Of scenes everything is known; of a PS-Wild folder what its `meta.json` holds.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.lighting.harmonics import BAND, harmonics
from unips_jax.scenes.backdrop import Backdrop, open_sky
from unips_jax.scenes.lamps import KeyLights
from unips_jax.scenes.surroundings import (
    Environment,
    sphere_points,
    surroundings,
)

_COUNT, _BLUR = 512, 0.1  # directions over the sphere; radians, below their distance


class IncidentLight(NamedTuple):
    """The light of N images at the object's centre, as if nothing were in its way.

    Tables and walls of scenes hide what is behind them; what they reflect themselves is
    left out. Vectors are in the frame of normals (x right, y up, z to the viewer).
    """

    # `[N, 9, 3]`, coefficients of radiance, lamp and surroundings, in the order of
    # `lighting.harmonics`. Exposure and white balance are included: a Lambertian
    # surface appears in the image as albedo / pi x irradiance, before the response
    # curve. 0 where unknown.
    harmonics: Array | np.ndarray
    # `[N, 3]`, unit, towards the lamp (the sun of some surroundings); 0 where there is
    # none or it is unknown
    lamp_direction: Array | np.ndarray
    # `[N]` in [0, 1], the lamp's share of the power of all light, the mean of the
    # colours; 1 where there is nothing else
    lamp_share: Array | np.ndarray
    # `[N]`, 1 / distance of the lamp, in radii of the object; 0 where distant
    lamp_nearness: Array | np.ndarray
    harmonics_known: Array | np.ndarray  # `[N]` bool
    lamp_known: Array | np.ndarray  # `[N]` bool, for all three of the lamp


def incident_light(
    keys: KeyLights, environment: Environment, gain: Array, backdrop: Backdrop | None
) -> IncidentLight:
    """That of N key lights and rotations; `gain [N, 3]`: exposure and white balance."""
    squared = jnp.sum(jnp.square(keys.vector), -1, keepdims=True)  # [N, 1]
    away = jnp.where(keys.near[:, None] > 0, squared, 1.0)
    lamp = keys.color / away  # irradiance [N, 3]
    direction = keys.vector / jnp.sqrt(squared)
    points = sphere_points(_COUNT)
    radiance = surroundings(environment, jnp.asarray(points), _BLUR)  # [N, 3, D]
    around = radiance * environment.scale[:, None, None] * (4 * math.pi / _COUNT)
    if backdrop is not None:
        around = around * open_sky(backdrop, jnp.asarray(points))
    sharpened = harmonics(points) * np.exp(0.5 * BAND * (BAND + 1) * _BLUR**2)
    spread = jnp.einsum("ncd,dk->nkc", around, sharpened.astype(np.float32))
    beam = harmonics(direction, jnp)[..., None] * lamp[:, None]  # [N, 9, 3]
    power = jnp.mean(lamp, -1)
    total = power + jnp.mean(jnp.sum(around, -1), -1)
    there = power > 0
    known = jnp.ones(len(power), bool)
    return IncidentLight(
        harmonics=(spread + beam) * gain[:, None],
        lamp_direction=jnp.where(there[:, None], direction, 0.0),
        lamp_share=power / jnp.maximum(total, 1e-9),
        lamp_nearness=jnp.where(there, keys.near / jnp.sqrt(squared[:, 0]), 0.0),
        harmonics_known=known,
        lamp_known=known,
    )


def folder_light(facts: Mapping[str, Any], count: int) -> IncidentLight:
    """That of a PS-Wild folder's `count` photographs, in NumPy.

    Known is everything where a lamp is all the light; of sets by Cycles also the lamp
    where there are surroundings; nothing of folders without `meta.json`.
    """
    directions, lights = facts.get("light_directions"), facts.get("lights")
    if lights:
        rows = [
            _photograph(drawn["lamps"], bool(drawn["environment"]), gain)
            for drawn, gain in zip(lights, facts["gains"], strict=True)
        ]
    elif directions:
        colors = facts.get("light_intensities") or [(1, 1, 1)] * len(directions)
        rows = [
            _photograph([{"direction": way, "irradiance": color}], False, math.pi)
            for way, color in zip(directions, colors, strict=True)
        ]
    else:
        nothing = np.zeros((9, 3)), np.zeros(3), 0.0, 0.0, False, False
        rows = [nothing] * count
    if len(rows) != count:
        raise ValueError(
            f"lights: expected {count}, one per photograph, got {len(rows)}"
        )
    *floats, harmonics_known, lamp_known = map(np.stack, zip(*rows, strict=True))
    coefficients, direction, share, nearness = (x.astype(np.float32) for x in floats)
    return IncidentLight(
        coefficients, direction, share, nearness, harmonics_known, lamp_known
    )


def _photograph(lamps: list[Any], around: bool, gain: float) -> tuple:
    """One photograph's `IncidentLight`, of light in the units of `cycles.lighting`."""
    direction, beam = np.zeros(3), np.zeros((9, 3))
    power = nearness = 0.0
    for lamp in lamps:  # one or none
        direction = np.array(lamp.get("direction", lamp.get("position")), float)
        distance = float(np.linalg.norm(direction))
        direction /= distance
        if "position" in lamp:
            nearness = 1 / distance
            color = np.array(lamp["power"]) / (math.pi * distance**2)
        else:
            color = np.array(lamp["irradiance"], float)
        power, beam = float(color.mean()), gain * harmonics(direction)[:, None] * color
    # Surroundings have a mean radiance of 1.
    share = power / (power + around * 4 * math.pi)
    known = 0 * beam if around else beam
    return known, direction, share, nearness, not around, True
