"""Photometric stereo under known distant lights: least squares and robust variants.

All solve the Lambertian model `I = L b` per pixel, with `L` `[N, 3]` the unit light
directions (the images are divided by the lights' intensities first) and `b` albedo
times normal: Woodham's least squares (1980), least absolute residuals by
reweighting, sparse Bayesian regression (Ikehata et al., CVPR 2012), and least squares
after a low-rank plus sparse split (Wu et al., ACCV 2010). The split works on the
whole matrix in float64 NumPy, since shrinking singular values needs the digits;
everything per pixel is float32 JAX, compiled once per number of images.
"""

import functools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.baselines.method import Method, Observed, Unsupported
from unips_jax.baselines.pixels import LUMA, map_pixels, normal_map, object_pixels

Colour = Literal["luma", "mean", "strongest"]


def woodham(
    *,
    colour: Colour = "luma",
    clip: float | None = None,
    keep: tuple[float, float] = (0.0, 1.0),
    shadow: float | None = None,
) -> Method:
    """Least squares (Woodham, 1980); needs lights and at least three images.

    Args:
        colour: solve on BT.601 luma, on the channels' mean, or on each channel and
            take the pixel's longest vector.
        clip: cap on the values after division by the intensities; None for no cap.
        keep: range of ranks used at each pixel, as fractions from its darkest to its
            brightest image; (0.2, 0.8) drops shadows and highlights.
        shadow: ignore values below this fraction of the pixel's brightest; pixels
            left with fewer than three values use all of theirs.
    """
    if not 0 <= keep[0] < keep[1] <= 1:
        raise ValueError(f"keep: expected 0 <= low < high <= 1, got {keep}")

    def solve(values: np.ndarray, directions: np.ndarray) -> np.ndarray:
        if clip is not None:
            values = np.minimum(values, clip)
        if keep == (0.0, 1.0) and shadow is None:
            return _least_squares(values, directions)
        return map_pixels(_trimmed, values, directions, keep=keep, shadow=shadow)

    return _method("woodham", solve, colour)


def woodham_diligent() -> Method:
    """Least squares by the recipe that reproduces DiLiGenT's published table.

    Images in [0, 1] (16-bit values over 65535), divided by the light intensities per
    channel, BT.601 luma, clipped at 1, all images, no thresholds.
    """
    return woodham(colour="luma", clip=1.0)


def robust_l1(*, iterations: int = 50) -> Method:
    """Least absolute residuals by iteratively reweighted least squares."""
    # The weights are 1/|residual|, capped at 1e5 over the image maximum (float32 cannot
    # use more; the reference goes to 1e16).
    solve = functools.partial(map_pixels, _l1, iterations=iterations)
    return _method("robust_l1", solve, "luma")


def sparse_bayesian(*, iterations: int = 50) -> Method:
    """Sparse Bayesian regression (Ikehata et al., CVPR 2012).

    Every value's error has its own variance, estimated with the normal. Each pixel's
    values are divided by their maximum first, so the ridges (1e-6 on the fit, 1 on the
    covariance) mean the same at any exposure.
    """
    solve = functools.partial(map_pixels, _sparse_bayesian, iterations=iterations)
    return _method("sparse_bayesian", solve, "luma")


def low_rank(*, tolerance: float = 1e-6, growth: float = 1.2) -> Method:
    """Least squares on the low-rank part of the images (Wu et al., ACCV 2010).

    The split (`split_low_rank`) needs many images: with fewer than about 16 it takes
    some shading for errors even where there are none (0.05 degrees at 12 images, 3
    degrees at 8).
    """

    def solve(values: np.ndarray, directions: np.ndarray) -> np.ndarray:
        low, _ = split_low_rank(values, tolerance=tolerance, growth=growth)
        return _least_squares(low, directions)

    return _method("low_rank", solve, "luma")


def check_lights(
    name: str, observed: Observed, *, coplanar: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions `[N, 3]` and intensities `[N, 3]` of known lights, checked.

    `Unsupported` if they do not determine a normal; `coplanar`: they may lie in a
    plane.
    """
    lights, count = observed.lights, len(observed.images)
    if lights is None:
        raise Unsupported(f"{name}: needs known lights, and none are given")
    directions = np.asarray(lights.directions, np.float64)
    intensities = np.asarray(lights.intensities, np.float32)
    if directions.shape != (count, 3) or intensities.shape != (count, 3):
        raise ValueError(
            f"{name}: expected directions and intensities of shape ({count}, 3), got "
            f"{directions.shape} and {intensities.shape}"
        )
    length = np.linalg.norm(directions, axis=-1, keepdims=True)
    if not (length > 0).all() or not (intensities > 0).all():
        raise Unsupported(f"{name}: a light has zero direction or no intensity")
    directions = directions / length
    singular = np.linalg.svd(directions, compute_uv=False)
    if not coplanar and singular[-1] < 1e-3 * singular[0]:
        raise Unsupported(f"{name}: the light directions lie in one plane")
    return directions, intensities


def split_low_rank(
    values: np.ndarray, *, tolerance: float = 1e-6, growth: float = 1.2
) -> tuple[np.ndarray, np.ndarray]:
    """Splits a matrix `[P, N]` into low-rank and sparse parts (inexact ALM), float64.

    Minimises the nuclear norm of the first plus `1/sqrt(max(P, N))` times the sum of
    magnitudes of the second, until the relative Frobenius residual is below
    `tolerance`. `growth` multiplies the penalty at each iteration: the usual 1.5 is
    quicker, but stops short of the optimum on few images.
    """
    image = np.asarray(values, np.float64)
    weight = 1 / np.sqrt(max(image.shape))
    spectral = np.sqrt(np.linalg.eigvalsh(image.T @ image)[-1])
    scale = np.linalg.norm(image)
    dual = image / max(spectral, np.abs(image).max() / weight)
    penalty = 1.25 / spectral
    last = penalty * 1e7
    low, sparse = np.zeros_like(image), np.zeros_like(image)
    for _ in range(500):
        rest = image - low + dual / penalty
        sparse = np.sign(rest) * np.maximum(np.abs(rest) - weight / penalty, 0)
        target = image - sparse + dual / penalty
        power, basis = np.linalg.eigh(target.T @ target)
        singular = np.sqrt(np.maximum(power, 1e-300))
        gain = np.maximum(singular - 1 / penalty, 0) / singular
        low = target @ (basis * gain) @ basis.T
        residual = image - low - sparse
        dual += penalty * residual
        penalty = min(penalty * growth, last)
        if np.linalg.norm(residual) < tolerance * scale:
            break
    return low, sparse


def _method(
    name: str, solve: Callable[[np.ndarray, np.ndarray], np.ndarray], colour: Colour
) -> Method:
    """Wraps `solve(values [P, N], directions [N, 3]) -> [P, 3]` as a method."""

    def method(observed: Observed) -> np.ndarray:
        pixels, mask = object_pixels(observed, name=name)
        directions, intensities = check_lights(name, observed)
        pixels = pixels / intensities  # [P, N, 3]
        if colour == "strongest":
            each = np.stack([solve(pixels[..., c], directions) for c in range(3)])
            best = np.argmax(np.linalg.norm(each, axis=-1), axis=0)
            return normal_map(each[best, np.arange(len(best))], mask)
        weights = LUMA if colour == "luma" else (1 / 3, 1 / 3, 1 / 3)
        return normal_map(
            solve(pixels @ np.asarray(weights, np.float32), directions), mask
        )

    return method


def _least_squares(values: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return map_pixels(_project, values, np.linalg.pinv(directions).T)


def _project(values: Array, inverse: Array) -> Array:
    return values @ inverse


def _trimmed(
    values: Array, directions: Array, *, keep: tuple[float, float], shadow: float | None
) -> Array:
    """Least squares on the values within the rank range and above the shadows."""
    count = values.shape[0]
    rank = jnp.argsort(jnp.argsort(values))
    low = int(keep[0] * count)
    high = max(int(np.ceil(keep[1] * count)), low + min(3, count - low))
    used: Array = (rank >= low) & (rank < high)
    if shadow is not None:
        used &= values >= shadow * jnp.max(values)
    # Lights in a plane, or fewer than three, leave the normal open.
    a, b, c = _gram(directions, used.astype(values.dtype))
    flat = jnp.dot(a, jnp.cross(b, c)) <= 1e-6 * jnp.sum(used) ** 3
    used = jnp.where(flat, True, used)
    return _solve_weighted(values, directions, used.astype(values.dtype))


def _l1(values: Array, directions: Array, *, iterations: int) -> Array:
    values = values / jnp.maximum(jnp.max(jnp.abs(values)), 1e-30)

    def step(_: int, vector: Array) -> Array:
        residual = jnp.abs(values - directions @ vector)
        weights = 1e-5 / jnp.maximum(residual, 1e-5)
        return _solve_weighted(values, directions, weights)

    start = _solve_weighted(values, directions, jnp.ones_like(values))
    return jax.lax.fori_loop(0, iterations, step, start)


def _sparse_bayesian(values: Array, directions: Array, *, iterations: int) -> Array:
    values = values / jnp.maximum(jnp.max(jnp.abs(values)), 1e-30)

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        variance = state[0]
        vector = _solve_weighted(values, directions, 1 / variance, ridge=1e-6)
        gram = _gram(directions, 1 / variance)
        covariance = _inverse(gram + jnp.eye(3, dtype=gram.dtype))
        spread = _squares(directions) @ covariance.reshape(9)
        residual = values - directions @ vector
        return jnp.maximum(residual**2 + spread, 1e-8), vector

    state = (jnp.ones_like(values), jnp.zeros(3, values.dtype))
    return jax.lax.fori_loop(0, iterations, step, state)[1]


def _solve_weighted(
    values: Array, directions: Array, weights: Array, *, ridge: float = 0.0
) -> Array:
    """Weighted least squares of one pixel, `[N]`, `[N, 3]`, `[N]` -> `[3]`."""
    gram = _gram(directions, weights)
    inverse = _inverse(gram + ridge * jnp.eye(3, dtype=gram.dtype))
    return jnp.sum(inverse * ((weights * values) @ directions), axis=-1)


def _gram(directions: Array, weights: Array) -> Array:
    """`L^T W L`, `[3, 3]`; over many pixels this is one matrix product."""
    return (weights @ _squares(directions)).reshape(3, 3)


def _squares(directions: Array) -> Array:
    """Every direction times its transpose, `[N, 9]`."""
    return (directions[:, :, None] * directions[:, None, :]).reshape(-1, 9)


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric 3x3 matrix by cofactors; zero for a zero matrix."""
    a, b, c = matrix
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    determinant = jnp.dot(a, cofactors[0])
    safe = jnp.where(determinant == 0, 1.0, determinant)
    return jnp.where(determinant == 0, 0.0, cofactors.T / safe)
