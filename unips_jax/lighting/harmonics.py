"""Real spherical harmonics up to order two.

Nine functions, orthonormal over the sphere, in the order (0, 0), (1, -1), (1, 0),
(1, 1), (2, -2) ... (2, 2), without the Condon-Shortley sign: those of order one grow
with y, z and x. The first one, four or nine are those of order zero, one or two.

Source: Ramamoorthi and Hanrahan, "An efficient representation for irradiance
environment maps" (SIGGRAPH 2001), equations 3 and 8.
"""

import math
from types import ModuleType
from typing import Any

import numpy as np

BAND = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2])
"""The order of each function."""

COSINE_LOBE = np.array([math.pi, 2 * math.pi / 3, math.pi / 4])
"""By order: from coefficients of radiance to those of irradiance."""


def harmonics(directions: Any, xp: ModuleType = np) -> Any:
    """The nine functions `[..., 9]` at unit directions, in numpy or jax.numpy."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return xp.stack(
        [
            xp.full_like(x, 0.28209479177387814),
            0.4886025119029199 * y,
            0.4886025119029199 * z,
            0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ],
        -1,
    )
