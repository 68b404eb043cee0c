"""The floor of every table: one normal, towards the viewer, everywhere.

The other floor, a shape blown up from the mask alone, is `baselines.balloon`.
"""

import numpy as np

from unips_jax.baselines.method import Method, Observed
from unips_jax.baselines.pixels import normal_map, object_pixels


def constant() -> Method:
    """The normal (0, 0, 1) everywhere; a method near its score has seen nothing."""
    return _constant


def _constant(observed: Observed) -> np.ndarray:
    pixels, mask = object_pixels(observed, name="constant", minimum=1)
    return normal_map(np.zeros((len(pixels), 3)), mask)
