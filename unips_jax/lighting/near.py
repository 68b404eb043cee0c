"""Lamps that are near: direction and strength differ from pixel to pixel.

A small lamp at P lights a surface at X by I (n . l) / d^2, with d = |P - X| and l the
direction to it; I is stated as irradiance on what faces the lamp at the image's middle.
Lengths are in widths of the image, from its middle: x right, y up, z to the viewer.

Source: Mecca et al., "LUCES: A dataset for near-field point light source photometric
stereo" (BMVC 2021), for lamps that shine equally to all sides.
"""

from typing import NamedTuple

import numpy as np


class NearField(NamedTuple):
    """Where lamps and surface are."""

    distance: float  # of all lamps from the image's middle
    places: np.ndarray  # `[H, W, 3]`, of the surface; where there is none, any


def places_of(depth: np.ndarray) -> np.ndarray:
    """A surface's places, by its depth `[H, W]` in pixels; the median is the middle."""
    height, width = depth.shape
    there = np.isfinite(depth)
    middle = np.median(depth[there]) if there.any() else 0.0
    y, x = np.mgrid[:height, :width]
    z = np.where(there, middle - depth, 0)
    places = np.stack([x - (width - 1) / 2, (height - 1) / 2 - y, z], -1)
    return (places / width).astype(np.float32)


def cosines(
    directions: np.ndarray,
    normals: np.ndarray,
    distance: float | None = None,
    places: np.ndarray | None = None,
) -> np.ndarray:
    """What lamps give to surfaces, 1 on what faces them at the middle: `[N, P]`, >= 0.

    Directions `[N, 3]` are from the middle; without a distance the lamps are far away,
    without `places [P, 3]` surfaces in the middle.
    """
    if distance is None or places is None:
        return np.maximum(directions @ normals.T, 0)
    to = distance * directions[:, None] - places  # [N, P, 3]
    falloff = distance**2 / np.sum(to * to, -1) ** 1.5
    return np.maximum(np.einsum("npk,pk->np", to, normals), 0) * falloff


def falloffs(directions: np.ndarray, distance: float, places: np.ndarray) -> np.ndarray:
    """How bright each lamp is at places `[..., 3]`, next to the middle: `[N, ...]`."""
    lamps = distance * directions.reshape(-1, *[1] * (places.ndim - 1), 3)
    return distance**2 / np.sum(np.square(lamps - places), -1)
