"""Draws the light of every photograph, and its exposure."""

import math
from typing import Any

import numpy as np

LIGHTINGS = ("directional", "environment", "mixed", "near")
_LOWEST = math.cos(math.radians(75))  # no lamp further than this from the viewer
_BRIGHT, _PERCENTILE = 0.9, 99.5


def _direction(rng: np.random.Generator) -> np.ndarray:
    """Uniform over the cap of directions around the viewer."""
    z = rng.uniform(_LOWEST, 1)
    angle = rng.uniform(0, 2 * math.pi)
    ring = math.sqrt(1 - z * z)
    return np.array([ring * math.cos(angle), ring * math.sin(angle), z])


def _around(rng: np.random.Generator, file: str, mean: float) -> dict[str, Any]:
    """A rotation of an environment, of mean radiance 1."""
    tilt = rng.uniform(-0.3, 0.3, 2)
    turn = rng.uniform(0, 2 * math.pi)
    rotation = [math.pi / 2 + tilt[0], tilt[1], turn]
    return {"file": file, "rotation": rotation, "strength": 1 / max(mean, 1e-6)}


def draw_light(
    rng: np.random.Generator, lighting: str, file: str = "", mean: float = 1.0
) -> dict[str, Any]:
    """Draws the light of one photograph, as Blender's `Studio.image` takes it.

    A directional light is white with irradiance pi; an environment, a `file` of mean
    radiance `mean`, gets mean radiance 1 (irradiance about pi) and is turned about the
    vertical; mixed is both, the lamp 0.5 to 4 times as strong; near is a square lamp at
    1.3 to 3 times the object's half width.
    """
    lamps: list[dict[str, Any]] = []
    environment = None
    if lighting in ("environment", "mixed"):
        environment = _around(rng, file, mean)
    if lighting in ("directional", "mixed"):
        power = math.pi
        if lighting == "mixed":
            power *= math.exp(rng.uniform(math.log(0.5), math.log(4)))
        lamps = [
            {
                "kind": "sun",
                "direction": _direction(rng).tolist(),
                "irradiance": [power] * 3,
            }
        ]
    if lighting == "near":
        distance = rng.uniform(1.3, 3.0)
        position = distance * _direction(rng)
        tint = 1 - rng.uniform(0, 0.3, 3)
        # A flat lamp facing the origin there gives power / (pi distance^2).
        lamps = [
            {
                "kind": "area",
                "position": position.tolist(),
                "power": (math.pi**2 * distance**2 * tint).tolist(),
                "side": rng.uniform(0.1, 0.6),
            }
        ]
    return {"lamps": lamps, "environment": environment}


def automatic_gain(radiance: np.ndarray, mask: np.ndarray) -> float:
    """The factor that puts the 99.5th percentile of the object's brightest at 0.9."""
    values = radiance.max(-1)[mask]
    bright = float(np.percentile(values, _PERCENTILE)) if values.size else 0.0
    return _BRIGHT / bright if bright > 1e-9 else 1.0
