"""Which way the axes of a normal map point, as its slopes and its outline show.

A surface's slopes, p to the right and q upwards, obey dp/dy = dq/dx. The correlation of
the two is +0.44 to +0.79 on maps by others, the negative where one axis is the other
way, and near 0 on surfaces made of steps or leaves: then nothing is reported. Along an
outline normals point outwards, unless what they show is hollow.
"""

import cv2
import numpy as np
import scipy.ndimage

from unips_jax.io.normal_values import LEAST, OVERRULE
from unips_jax.io.normals import NormalMap

SURE = 0.2  # correlation that decides
_STEEP = 0.2  # z: slopes above 5 show little

# What a convention is where green, or red, is the other way.
_OTHERS: dict[NormalMap, tuple[NormalMap, ...]] = {
    "opengl": ("directx", "x-left"),
    "directx": ("opengl",),
    "opencv": ("opengl",),
    "x-left": ("opengl",),
}


def integrability(normals: np.ndarray) -> float:
    """The correlation of dp/dy and dq/dx, above 0 where normals are a surface's.

    0 where fewer than 200 squares of 2 x 2 pixels have normals that are not steep.
    """
    fine = normals[..., 2] > _STEEP
    z = np.where(fine, normals[..., 2], 1)
    p, q = -normals[..., 0] / z, -normals[..., 1] / z
    whole = fine[:-1, :-1] & fine[:-1, 1:] & fine[1:, :-1] & fine[1:, 1:]
    if np.count_nonzero(whole) < LEAST:
        return 0.0
    up, right = p[:-1] - p[1:], q[:, 1:] - q[:, :-1]  # row 0 is the top, y is up
    a = _bounded((up[:, :-1] + up[:, 1:])[whole])
    b = _bounded((right[:-1] + right[1:])[whole])
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 1e-9 else 0.0


def facing(normals: np.ndarray, mended: list[str]) -> tuple[int, int, int]:
    """Signs that turn normals, nearly all of which face away, to the viewer."""
    fits = integrability(normals * np.array([1, 1, -1], np.float32))
    x, y = _outwards(normals)
    if max(x, y) < -0.5 and fits > -SURE:
        mended.append(
            "normals point into the surface, away from the viewer: all three axes "
            f"are turned; {OVERRULE} takes them as they are"
        )
        return -1, -1, -1
    if fits > SURE or (fits > -SURE and y > 0.5):
        mended.append(
            f"z points away from the viewer: turned; {OVERRULE} takes it as it is"
        )
        return 1, 1, -1
    mended.append(
        "z points away from the viewer: read as --normal-map opencv, with y down; "
        f"{OVERRULE} takes it as it is"
    )
    return 1, -1, -1


def other_axes(normals: np.ndarray, found: float, convention: NormalMap) -> str:
    """A line on slopes that do not fit, with the conventions to try."""
    names = list(_OTHERS[convention])
    x, y = _outwards(normals)
    if x < -0.3 < 0.3 < y:  # red seems to be the other way
        names.reverse()
    advice = " or ".join(f"--normal-map {name}" for name in names)
    return (
        f"slopes do not fit together as a surface's do (correlation {found:+.2f}): "
        f"an axis seems to be the other way; try {advice}"
    )


def _outwards(normals: np.ndarray) -> tuple[float, float]:
    """How normals at the outline point outwards in x and in y, from -1 to 1 each."""
    there = (normals != 0).any(-1)
    row, column = np.gradient(cv2.GaussianBlur(there.astype(np.float32), (0, 0), 2))
    edge = there & ~scipy.ndimage.binary_erosion(there, iterations=2, border_value=1)
    edge &= np.abs(normals[..., 2]) < 0.9
    if np.count_nonzero(edge) < 40:
        return 0.0, 0.0

    def agreement(given: np.ndarray, outward: np.ndarray) -> float:
        size = np.linalg.norm(given) * np.linalg.norm(outward)
        return float(given @ outward / size) if size > 1e-6 else 0.0

    return (
        agreement(normals[..., 0][edge], -column[edge]),
        agreement(normals[..., 1][edge], row[edge]),
    )


def _bounded(values: np.ndarray) -> np.ndarray:
    """Values less their mean, jumps cut to the largest usual size."""
    most = np.quantile(np.abs(values), 0.98) or np.abs(values).max()
    values = np.clip(values, -most, most).astype(np.float64)
    return values - values.mean()
