"""The floor of every table: one normal, towards the viewer, everywhere.

The other floor, a shape blown up from the mask alone, is in
`unips_jax.baselines.balloon`.
"""

import numpy as np

from unips_jax.baselines.method import Lights, Method
from unips_jax.baselines.pixels import normal_map, object_pixels


def constant() -> Method:
    """The normal (0, 0, 1) everywhere; a method near its score has seen nothing."""
    return _constant


def _constant(
    images: np.ndarray,
    mask: np.ndarray,
    *,
    lights: Lights | None = None,
    focal: float | None = None,
) -> np.ndarray:
    del lights, focal
    pixels, mask = object_pixels(images, mask, name="constant", minimum=1)
    return normal_map(np.zeros((len(pixels), 3)), mask)
