"""The variational method's model: camera, spherical harmonics, residuals, energy.

Arrays put the pixel axes last: images `[N, C, H, W]`, albedo `[C, H, W]`, lighting
`[N, C, 9]`, vectors `[3, H, W]`. The camera frame is x right, y down, z away from the
camera; the normal of depth z is N(z) / |N(z)| with N affine in z, pointing to the
camera.

Source: Haefner et al., "Variational uncalibrated photometric stereo under general
lighting" (ICCV 2019), Secs. 3 and 4.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.baselines.grid import central, forward, shift

HUBER = 0.1  # where the albedo's smoothness turns from quadratic to linear
CAUCHY = 1.0  # residual at which a measurement has half its weight
SMOOTHNESS = 0.045245  # per image, over CAUCHY
TIE = 5e-4  # weight that ties the lagged length to |N(depth)|

_W0, _W1, _G, _A = (math.sqrt(k / (4 * math.pi)) for k in (1, 3, 5, 15))


class Problem(NamedTuple):
    """What stays fixed while the method iterates."""

    images: Array  # `[N, C, H, W]`, in [0, 1], zero outside the mask
    mask: Array  # `[H, W]`, bool
    u: Array  # `[H, W]`, columns counted from the principal point
    v: Array  # `[H, W]`, rows counted from the principal point
    focal: Array  # scalar, focal length in pixels; 1 for the orthographic camera
    # scalar, 1.0 for the perspective and 0.0 for the orthographic one
    perspective: Array
    clamp: Array  # scalar bool, True to leave negative shading out

    @property
    def smoothness(self) -> float:
        """Weight of the albedo's total variation."""
        return SMOOTHNESS * self.images.shape[0] / CAUCHY


class State(NamedTuple):
    """What the iterations change."""

    depth: Array  # `[H, W]`
    length: Array  # `[H, W]`, the lagged length of N(depth)
    albedo: Array  # `[C, H, W]`
    lighting: Array  # `[N, C, 9]`, spherical-harmonic coefficients


class Energy(NamedTuple):
    """The energies of a state, scalars."""

    photometric: Array  # sum of Cauchy's function of the residuals
    weighted: Array  # half the sum of squared residuals under the current weights
    smoothness: Array  # weighted Huber total variation of the albedo
    tie: Array  # penalty on the lagged length


def linear_normals(depth: Array, problem: Problem) -> Array:
    """The part of N linear in depth, `[3, H, W]`, zero outside the mask."""
    right, down = forward(depth, problem.mask, closed=False)
    inside = jnp.where(problem.mask, depth, 0.0)
    along = -(inside + problem.u * right + problem.v * down)
    focal = problem.focal
    return jnp.stack([focal * right, focal * down, problem.perspective * along])


def raw_normals(depth: Array, problem: Problem) -> Array:
    """N(depth), `[3, H, W]`, not normalised; (0, 0, -1) outside the mask."""
    linear = linear_normals(depth, problem)
    constant = jnp.where(problem.mask, problem.perspective - 1, -1.0)
    return linear.at[2].add(constant)


def inner_normals(depth: Array, problem: Problem) -> Array:
    """N(depth) `[3, H, W]`, not normalised, with backward differences at the rim."""
    # `raw_normals` has depth 0 beyond the mask, which spoils its right and lower rim.
    mask, slopes = problem.mask, []
    steps = forward(depth, mask, closed=True)
    for step, (rows, columns) in zip(steps, ((0, 1), (1, 0)), strict=True):
        back = shift(step, -rows, -columns)
        slopes.append(jnp.where(mask & ~shift(mask, rows, columns), back, step))
    right, down = slopes
    inside = jnp.where(mask, depth, 0.0)
    along = -(inside + problem.u * right + problem.v * down)
    last = problem.perspective * along + problem.perspective - 1
    normals = jnp.stack([problem.focal * right, problem.focal * down, last])
    return jnp.where(mask, normals, jnp.array([0.0, 0.0, -1.0])[:, None, None])


def length_of(normals: Array) -> Array:
    """Length of vectors `[3, H, W]`, at least 1e-12."""
    return jnp.sqrt(jnp.maximum(jnp.sum(normals**2, axis=0), 1e-24))


def harmonics(m: Array) -> Array:
    """Harmonics of order 2, `[9, ...]`, of any vector: linear, constant, quadratic."""
    x, y, z = m
    linear = [_W1 * x, _W1 * y, _W1 * z, _W0 * jnp.ones_like(x)]
    products = [_A * x * y, _A * x * z, _A * y * z]
    squares = [_A / 2 * (x**2 - y**2), _G / 2 * (3 * z**2 - 1)]
    return jnp.stack(linear + products + squares)


def shade_slope(lighting: Array, m: Array) -> tuple[Array, Array, Array]:
    """Derivatives of one shading (lighting `[9]`) by the vector's three components."""
    x, y, z = m
    linear = _W1 * lighting[:3]
    xy, xz, yz, square = _A * lighting[4:8]
    height = _G * lighting[8]
    return (
        linear[0] + xy * y + xz * z + square * x,
        linear[1] + xy * x + yz * z - square * y,
        linear[2] + xz * x + yz * y + 3 * height * z,
    )


def shade(lighting: Array, normals: Array) -> Array:
    """Shading of every image, `[N, C, H, W]`, for normals `[3, H, W]`."""
    return jnp.einsum("ncj,jhw->nchw", lighting, harmonics(normals))


def residuals(
    depth: Array, length: Array, albedo: Array, lighting: Array, problem: Problem
) -> tuple[Array, Array]:
    """Rendered minus observed, 0 outside the mask; and the shading, `[N, C, H, W]`."""
    shading = shade(lighting, raw_normals(depth, problem) / length)
    shading = jnp.where(problem.clamp, jnp.maximum(shading, 0.0), shading)
    difference = albedo * shading - problem.images
    return jnp.where(problem.mask, difference, 0.0), shading


def cauchy_weights(residual: Array) -> Array:
    """Weights of iteratively reweighted least squares under Cauchy's function."""
    return 1 / (1 + (residual / CAUCHY) ** 2)


def huber(t: Array) -> Array:
    """Huber's function: quadratic up to `HUBER`, then linear with slope 1."""
    size = jnp.abs(t)
    return jnp.where(size <= HUBER, t**2 / (2 * HUBER), size - HUBER / 2)


@jax.jit
def energy(state: State, problem: Problem) -> Energy:
    """Measures a state; see `Energy`."""
    residual, _ = residuals(*state, problem)
    lengths = length_of(raw_normals(state.depth, problem))
    gap = jnp.where(problem.mask, state.length - lengths, 0.0)
    variation = huber(central(state.albedo, problem.mask))
    return Energy(
        photometric=CAUCHY**2 * jnp.sum(jnp.log1p((residual / CAUCHY) ** 2)),
        weighted=0.5 * jnp.sum(cauchy_weights(residual) * residual**2),
        smoothness=problem.smoothness * jnp.sum(variation),
        tie=0.5 * TIE * jnp.sum(gap**2),
    )
