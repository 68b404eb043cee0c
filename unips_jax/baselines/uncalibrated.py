"""Uncalibrated photometric stereo under distant lights: factorise, then integrate.

The images of a Lambertian surface without shadows have rank three; integrability
(Yuille and Snow, CVPR 1997) leaves the generalised bas-relief ambiguity, settled
here by the albedos' entropy or by diffuse maxima (`bas_relief`), and the silhouette
tells bumps from dents. Needs no lights; attached shadows and highlights are ignored,
as in the published methods, and cost accuracy. The N x N eigenproblem and the 6 x 6
one are float64 NumPy; one object takes well under a second apart from the entropy's
search, which is compiled.
"""

from typing import Literal, get_args

import numpy as np
from scipy import ndimage

from unips_jax.baselines import bas_relief
from unips_jax.baselines.method import Method, Observed, Unsupported
from unips_jax.baselines.pixels import normal_map, object_pixels
from unips_jax.baselines.silhouette import convex_sign, derivatives, smooth
from unips_jax.checks import require_choice

Resolve = Literal["entropy", "diffuse_maxima"]


def factorisation(
    *, resolve: Resolve = "diffuse_maxima", smoothing: float = 1.5
) -> Method:
    """Factorisation, integrability, and one way to settle the bas-relief ambiguity.

    Args:
        resolve: by the entropy of the albedos (few albedos) or by diffuse maxima.
        smoothing: Gaussian, in pixels, on the field whose integrability is judged.
    """
    require_choice("resolve", resolve, get_args(Resolve))

    def method(observed: Observed) -> np.ndarray:
        pixels, mask = object_pixels(observed, name="factorisation")
        grey = pixels.astype(np.float64).mean(axis=-1)
        field, found = integrable_field(grey, mask, smoothing=smoothing)
        if resolve == "entropy":
            relief = bas_relief.by_entropy(field[mask])
        else:
            maps = np.zeros((grey.shape[1], *mask.shape))
            maps[:, mask] = grey.T
            relief = bas_relief.by_diffuse_maxima(field, found, maps, mask)
        normals = normal_map(field[mask] @ bas_relief.transform(relief), mask)
        return convex_sign(normals, mask, name="factorisation")

    return method


def factorise(
    values: np.ndarray, *, rank: int, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """The best factors of a matrix, by the eigenvectors of its Gram matrix.

    Of values `[P, N]`: `[P, rank]`, columns of unit mean square, and `[rank, N]`;
    float64. Their product is the nearest matrix of that rank. `Unsupported` if the rank
    is lower.
    """
    values = np.asarray(values, np.float64)
    power, basis = np.linalg.eigh(values.T @ values)
    power, basis = power[::-1][:rank], basis[:, ::-1][:, :rank]
    if power[-1] < 1e-9 * power[0]:
        raise Unsupported(
            f"{name}: the images are too alike; needs at least {rank} different lights"
        )
    scale = np.sqrt(power / len(values))
    return values @ basis / scale, basis.T * scale[:, None]


def integrable_field(
    grey: np.ndarray, mask: np.ndarray, *, smoothing: float = 1.5
) -> tuple[np.ndarray, np.ndarray]:
    """Factorises grey images so that the field is a surface's.

    Of pixels `[P, N]` in row order: `[H, W, 3]`, albedo times normal, and `[N, 3]`,
    lights; both up to one bas-relief transformation and a common scale. The field's
    third component is as large as the others on average, and positive on average.
    `Unsupported` if the rank is below three, or the object too small to differentiate.
    """
    factors, lights = factorise(grey, rank=3, name="factorisation")
    field = np.zeros((*mask.shape, 3))
    field[mask] = factors
    matrix = _integrable_basis(field, mask, smoothing)  # b0 = matrix b
    field = field @ matrix.T
    lights = np.linalg.solve(matrix.T, lights).T  # [N, 3]
    inside = field[mask]
    scale = np.sqrt((inside[:, :2] ** 2).mean() / (inside[:, 2] ** 2).mean())
    scale *= np.sign(inside[:, 2].mean()) or 1.0
    size = np.sqrt((inside[:, :2] ** 2).mean())
    third = np.array([1, 1, scale])
    return field * third / size, lights / third * size


def _integrable_basis(
    field: np.ndarray, mask: np.ndarray, smoothing: float
) -> np.ndarray:
    """The matrix `[3, 3]` that makes a field `[H, W, 3]` integrable."""
    # The condition is linear in the field's direction alone, so the field is brought to
    # unit length first: edges of the albedo then leave no trace.
    length = np.linalg.norm(field, axis=-1, keepdims=True)
    profile = field / np.where(length > 0, length, 1)
    soft = smooth(profile, mask, smoothing)
    along_x, along_y = derivatives(soft)
    inside = ndimage.binary_erosion(mask, iterations=2)
    if inside.sum() < 12:
        raise Unsupported(
            f"factorisation: the object is too small, {mask.sum()} pixels"
        )
    soft, along_x, along_y = soft[inside], along_x[inside], along_y[inside]
    rows = np.concatenate(
        [np.cross(soft, along_y), -np.cross(soft, along_x)], axis=-1
    )  # [P, 6]
    _, vectors = np.linalg.eigh(rows.T @ rows)
    u, v = vectors[:3, 0], vectors[3:, 0]
    third = np.cross(u, v)
    length = np.linalg.norm(third)
    if length < 1e-9:
        raise Unsupported("factorisation: integrability leaves the shape open")
    third *= np.sqrt(np.linalg.norm(u) * np.linalg.norm(v)) / length
    return np.linalg.inv(np.stack([-v, u, third], axis=-1))
