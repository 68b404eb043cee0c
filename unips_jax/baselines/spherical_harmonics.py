"""Photometric stereo under unknown natural light, first-order harmonics.

Under smooth light a Lambertian image is nearly linear in `y = albedo (1, n)`
(Basri, Jacobs and Kemelmacher, IJCV 2007), so the images have rank four. `y` lies on
the light cone, `y^T J y = 0` with `J = diag(-1, 1, 1, 1)`; that quadric finds it up
to a scaled Lorentz transformation, exactly so on first-order data. The six parameters
left are our own addition: integrability and normals that face outwards along the
silhouette, by least squares from the best of many starts, each of which turns three
of the silhouette's normals outwards exactly. An object whose mask is not its
occluding contour is harder. Light of second order, typically 1-5 % of the signal, is
what limits the method.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy import ndimage, optimize
from scipy.spatial.transform import Rotation

from unips_jax.baselines.method import Method, Observed, Unsupported
from unips_jax.baselines.pixels import normal_map, object_pixels
from unips_jax.baselines.silhouette import derivatives, silhouette, smooth
from unips_jax.baselines.uncalibrated import factorise

_NAME = "first_order_harmonics"
_PAIRS = tuple(itertools.combinations_with_replacement(range(4), 2))
_METRIC = np.diag([-1.0, 1.0, 1.0, 1.0])
_STARTS, _REFINED = 64, 4
_FEW, _MANY = 600, 3000  # pixels judged while searching, and at the end


def first_order_harmonics(*, smoothing: float = 1.5, anchor: float = 0.05) -> Method:
    """First-order spherical harmonics photometric stereo; at least four images.

    Args:
        smoothing: Gaussian, in pixels, on the field whose integrability is judged.
        anchor: weight of the silhouette's normals lying in the image plane. It alone
            fixes the relief of round objects; more bends all others.
    """

    def method(observed: Observed) -> np.ndarray:
        pixels, mask = object_pixels(observed, name=_NAME, minimum=4)
        grey = pixels.astype(np.float64).mean(axis=-1)
        rays = cone_directions(cone_field(grey))
        matrix = resolve(rays, mask, smoothing=smoothing, anchor=anchor)
        return normal_map(rays @ matrix[1:].T, mask)

    return method


def cone_field(grey: np.ndarray) -> np.ndarray:
    """Albedo times (1, normal), up to a scaled Lorentz transformation.

    `[P, 4]`, float64, of grey `[P, N]`, the first component positive on average.
    `Unsupported` if the images have a rank below four, or no quadric of the light
    cone's signature fits them.
    """
    factors, _ = factorise(grey, rank=4, name=_NAME)
    length = np.linalg.norm(factors, axis=-1, keepdims=True)
    unit = factors / np.where(length > 0, length, 1)
    terms = np.stack(
        [(1 if i == j else 2) * unit[:, i] * unit[:, j] for i, j in _PAIRS], axis=-1
    )  # [P, 10]
    quadric = np.zeros((4, 4))
    least = np.linalg.eigh(terms.T @ terms)[1][:, 0]
    for (i, j), value in zip(_PAIRS, least, strict=True):
        quadric[i, j] = quadric[j, i] = value
    if (np.linalg.eigvalsh(quadric) < 0).sum() == 3:
        quadric = -quadric
    power, basis = np.linalg.eigh(quadric)  # ascending: the negative one first
    if (power < 0).sum() != 1:
        raise Unsupported(
            f"{_NAME}: the images do not fit a light cone (signature "
            f"{np.sign(power).astype(int).tolist()}); the light or the surface is "
            "too far from the model"
        )
    field = factors @ (basis * np.sqrt(np.abs(power)))
    return field if field[:, 0].mean() > 0 else -field


def cone_directions(field: np.ndarray) -> np.ndarray:
    """The field without its albedo: (1, unit vector), `[P, 4]`, on the cone."""
    vectors = field[:, 1:] * np.where(field[:, :1] < 0, -1, 1)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    vectors = np.where(length > 0, vectors / np.where(length > 0, length, 1), [0, 0, 1])
    return np.concatenate([np.ones_like(length), vectors], axis=-1)


def lorentz(parameters: np.ndarray) -> np.ndarray:
    """The Lorentz transformation of three boosts and three rotations, `[4, 4]`.

    `parameters` are rapidities along x, y, z, then a rotation vector; the rotation
    comes first, then the boost.
    """
    rapidity = np.linalg.norm(parameters[:3])
    axis = parameters[:3] / max(rapidity, 1e-300)
    boost = np.eye(4)
    boost[0, 0] = np.cosh(rapidity)
    boost[0, 1:] = boost[1:, 0] = np.sinh(rapidity) * axis
    boost[1:, 1:] += (np.cosh(rapidity) - 1) * np.outer(axis, axis)
    turn = np.eye(4)
    turn[1:, 1:] = Rotation.from_rotvec(parameters[3:]).as_matrix()
    return boost @ turn


def resolve(
    rays: np.ndarray, mask: np.ndarray, *, smoothing: float = 1.5, anchor: float = 0.05
) -> np.ndarray:
    """Settles the Lorentz transformation of rays `[P, 4]`, (1, unit vector).

    `smoothing` and `anchor` as in `first_order_harmonics`. Returns `[4, 4]`: normals
    are the last three components of `rays @ matrix.T`.
    """
    outline, outward = silhouette(mask, name=_NAME)
    field = np.zeros((*mask.shape, 4))
    field[mask] = rays
    soft = smooth(field, mask, smoothing)
    rim = _Rim(cone_directions(soft[outline]), outward)
    inside = ndimage.binary_erosion(mask, iterations=2)
    if inside.sum() < 24:
        raise Unsupported(f"{_NAME}: the object is too small, {mask.sum()} pixels")
    jet = np.stack([soft, *derivatives(soft)])[:, inside]  # [3, P, 4]
    few, many = (jet[:, :: -(-jet.shape[1] // count)] for count in (_FEW, _MANY))

    def residuals(
        parameters: np.ndarray, start: np.ndarray, jet: np.ndarray
    ) -> np.ndarray:
        return _residuals(lorentz(parameters) @ start, jet, rim, anchor)

    zero = np.zeros(6)
    starts = sorted(
        _starts(rim, rays.mean(axis=0)),
        key=lambda start: np.sum(residuals(zero, start, few) ** 2),
    )
    if not starts:
        raise Unsupported(f"{_NAME}: the silhouette does not fix a start")
    fits = [
        optimize.least_squares(residuals, zero, args=(start, few), max_nfev=30)
        for start in starts[:_REFINED]
    ]
    best = min(range(len(fits)), key=lambda i: fits[i].cost)
    args = (starts[best], many)
    fit = optimize.least_squares(residuals, fits[best].x, args=args, max_nfev=30)
    return lorentz(fit.x) @ starts[best]


class _Rim(NamedTuple):
    """Rays `[K, 4]` along the silhouette, and its outward directions `[K, 2]`."""

    rays: np.ndarray
    outward: np.ndarray


def _residuals(
    matrix: np.ndarray, jet: np.ndarray, rim: _Rim, anchor: float
) -> np.ndarray:
    """Curl, backward normals, and the rim's turn and tilt; parts of like size."""
    y, along_x, along_y = jet @ matrix[1:].T
    length = np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), 1e-9)
    normals, along_x, along_y = y / length, along_x / length, along_y / length
    # The curl is (n x dn/dx)_x + (n x dn/dy)_y, next to the size of both products.
    curl = normals[:, 1] * along_x[:, 2] - normals[:, 2] * along_x[:, 1]
    curl += normals[:, 2] * along_y[:, 0] - normals[:, 0] * along_y[:, 2]
    size = sum(
        np.sum(along**2) - np.sum(np.sum(normals * along, axis=-1) ** 2)
        for along in (along_x, along_y)
    )
    curl /= np.sqrt(max(size, 0) / (3 * len(curl))) + 1e-12
    behind = np.maximum(0, 0.05 - normals[:, 2])
    edge = rim.rays @ matrix[1:].T
    across = np.linalg.norm(edge[:, :2], axis=-1, keepdims=True)
    turn = edge[:, :2] / np.maximum(across, 1e-9) - rim.outward
    tilt = edge[:, 2] / np.maximum(np.linalg.norm(edge, axis=-1), 1e-9)
    parts = curl, behind, turn.ravel(), anchor * tilt
    return np.concatenate([part / np.sqrt(len(part)) for part in parts])


def _starts(rim: _Rim, mean: np.ndarray) -> list[np.ndarray]:
    """Transformations that turn three of the rim's rays outwards, exactly."""
    # Three rays and their images fix a Lorentz transformation up to a reflection in
    # their plane, settled by the mean ray, which faces the viewer.
    rng = np.random.default_rng(0)
    starts = []
    for _ in range(20 * _STARTS):
        three = rng.choice(len(rim.rays), 3, replace=False)
        outward = rim.outward[three]
        if np.sum(outward * np.roll(outward, 1, axis=0), axis=-1).max() > 0:
            continue  # not spread around the object
        target = np.zeros((4, 4))
        target[:3, 0], target[:3, 1:3] = 1, outward
        source = np.zeros((4, 4))
        source[:3] = rim.rays[three]
        a, b = (m[:3] @ _METRIC @ m[:3].T for m in (source, target))
        ratio = a / np.where(b == 0, np.inf, b)
        r01, r02, r12 = ratio[0, 1], ratio[0, 2], ratio[1, 2]
        if min(r01, r02, r12) < 1e-9:
            continue
        target[:3] *= np.sqrt([[r01 * r02 / r12], [r01 * r12 / r02], [r02 * r12 / r01]])
        across = np.linalg.svd(source[:3] @ _METRIC)[2][3]
        across /= np.sqrt(max(across @ _METRIC @ across, 1e-12))
        source[3] = across * np.sign(mean @ _METRIC @ across)
        target[3, 3] = 1
        starts.append(np.linalg.solve(source, target).T)
        if len(starts) == _STARTS:
            break
    return starts
