"""Whether what was found in the dark is an object, or only what shines on one.

Of a mirror, or of polished black, nothing is seen on black but its highlights, and
these in one photograph or two each. Matte surfaces are lit in half of the photographs
or more, bronze and gloss in a third.
"""

import numpy as np

from unips_jax.io.color import Transfer, as_linear

_FEW = 4  # photographs: of fewer it is uncertain
_SAMPLES = 4000  # pixels
_DARK = 0.1  # of the brightest: a backdrop on which something may be hidden
_MEAN, _MEDIAN = 0.27, 0.05  # over the photographs, of the brightest


def is_only_shine(images: np.ndarray, mask: np.ndarray, transfer: Transfer) -> bool:
    """Whether a mask's pixels shine in few photographs, before a dark backdrop."""
    if len(images) < _FEW or mask.all():
        return False
    step = max(1, int((mask.size / 16 / _SAMPLES) ** 0.5))
    few = images[:, ::step, ::step]
    inside = mask[::step, ::step]
    if not inside.any() or inside.all():
        return False
    seen = as_linear(few[:, inside], transfer).max(axis=-1)
    behind = as_linear(few[:, ~inside].max(axis=0), transfer).max(axis=-1)
    brightest = np.maximum(seen.max(axis=0), 1e-12)
    if np.median(behind) > _DARK * np.percentile(brightest, 99):
        return False
    mean, median = (f(seen, axis=0) / brightest for f in (np.mean, np.median))
    return bool(np.median(mean) < _MEAN and np.median(median) < _MEDIAN)
