"""The variational method's descent: albedo, lighting and depth in turn.

Depth, albedo and second-order spherical-harmonic lighting of every image and channel,
by lagged block coordinate descent from a balloon. Because N(z) is linear in depth and
local, the whole stack enters the depth update as one 3x3 matrix and one 3-vector per
pixel; the update then runs matrix-free, at a cost that depends neither on the number
of images nor on the channels.

Source: Haefner, Ye, Gao, Wu, Quéau, Cremers, "Variational uncalibrated photometric
stereo under general lighting" (ICCV 2019).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from unips_jax.baselines.grid import central, shift, solve_cg, stencil
from unips_jax.baselines.variational import model
from unips_jax.baselines.variational.model import Energy, Problem, State

FIRST_ORDER_ITERATIONS = 8
_DEPTH_STEPS = 3
_TOLERANCE = 1e-6  # least change of the energy, as a share of it, to go on


class Result(NamedTuple):
    """What the method found."""

    state: State
    normals: Array  # `[3, H, W]`, unit length, camera frame
    trace: list[Energy]  # the energies before the first and after every iteration


def initial_state(depth: Array, problem: Problem) -> State:
    """Starts from a depth map, positive in the mask: median albedo, frontal light."""
    images = problem.images
    n, channels = images.shape[:2]
    albedo = jnp.sort(images, axis=0)[(n - 1) // 2]
    frontal = jnp.zeros(9, jnp.float32).at[2].set(-1.0).at[3].set(0.2)
    return State(
        depth=depth,
        length=model.length_of(model.raw_normals(depth, problem)),
        albedo=albedo,
        lighting=jnp.broadcast_to(frontal, (n, channels, 9)),
    )


def update_albedo(state: State, problem: Problem) -> Array:
    """Solves for the albedo, `[C, H, W]`: weighted least squares plus Huber TV."""
    residual, shading = model.residuals(*state, problem)
    weights = 2 * model.cauchy_weights(residual) * problem.mask
    data = jnp.sum(weights * shading**2, axis=0)
    right = jnp.sum(weights * shading * problem.images, axis=0)
    slopes = jnp.abs(central(state.albedo, problem.mask))
    smooth = problem.smoothness / jnp.maximum(slopes, model.HUBER)

    def gradient(albedo: Array) -> Array:
        return central(albedo, problem.mask)

    def product(albedo: Array) -> Array:
        flux = smooth * gradient(albedo)
        return data * albedo + jax.linear_transpose(gradient, albedo)(flux)[0]

    diagonal = data
    for axis, (rows, columns) in enumerate(((0, 1), (1, 0))):
        inside = problem.mask & shift(problem.mask, rows, columns)
        inside = inside & shift(problem.mask, -rows, -columns)
        part = 0.25 * jnp.where(inside, smooth[axis], 0.0)
        diagonal += shift(part, rows, columns) + shift(part, -rows, -columns)
    return solve_cg(product, right, diagonal, start=state.albedo)


def update_lighting(state: State, problem: Problem, active: Array) -> Array:
    """The lighting `[N, C, 9]` by weighted least squares, in active harmonics."""
    residual, shading = model.residuals(*state, problem)
    weights = model.cauchy_weights(residual) * problem.mask
    weights = jnp.where(problem.clamp & (shading <= 0), 0.0, weights)
    normals = model.raw_normals(state.depth, problem) / state.length
    basis = active[:, None, None] * model.harmonics(normals)
    pairs = basis[:, None] * basis[None]
    matrix = jnp.einsum("nchw,jkhw->ncjk", weights * state.albedo**2, pairs)
    right = jnp.einsum("nchw,jhw->ncj", weights * state.albedo * problem.images, basis)
    inverse = jnp.linalg.pinv(matrix, rtol=1e-6, hermitian=True)
    return jnp.einsum("ncjk,nck->ncj", inverse, right)


_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _reduce(
    depth: Array, weights: Array, state: State, problem: Problem
) -> tuple[Array, Array]:
    """The depth update's 3x3 matrices `[3, 3, H, W]` and vectors `[3, H, W]`."""
    raw = model.raw_normals(depth, problem)
    length = model.length_of(raw)
    residual, shading = model.residuals(
        depth, state.length, state.albedo, state.lighting, problem
    )
    weights = jnp.where(problem.clamp & (shading <= 0), 0.0, weights)
    lagged, gain = raw / state.length, state.albedo / state.length
    zero = jnp.zeros_like(depth)

    # Image by image and written out: the stack of jacobians overflows the caches.
    def add(sums: tuple, image: tuple) -> tuple:
        matrix, vector = sums
        for weight, error, lighting, factor in zip(*image, gain, strict=True):
            slope = [factor * part for part in model.shade_slope(lighting, lagged)]
            heavy = [weight * part for part in slope]
            matrix = [
                total + heavy[i] * slope[j]
                for total, (i, j) in zip(matrix, _PAIRS, strict=True)
            ]
            vector = [v + error * part for v, part in zip(vector, heavy, strict=True)]
        return (matrix, vector), None

    stack = (weights, residual, state.lighting)
    (sums, vector), _ = lax.scan(add, ([zero] * 6, [zero] * 3), stack)
    unit = raw / length
    gap = jnp.where(problem.mask, state.length - length, 0.0)
    tie = model.TIE / 2
    entries = dict(zip(_PAIRS, sums, strict=True))
    matrix = jnp.stack(
        [jnp.stack([entries[min(i, j), max(i, j)] for j in range(3)]) for i in range(3)]
    )
    matrix += tie * unit[:, None] * unit
    return matrix, jnp.stack(vector) - tie * gap * unit


def _newton_step(matrix: Array, vector: Array, problem: Problem) -> Array:
    """Solves (A^T H A) step = -A^T h for the depth, a stencil of seven points."""
    mask, u, v, k = problem.mask, problem.u, problem.v, problem.perspective
    zero, focal = jnp.zeros_like(u), problem.focal
    rows = {
        "here": (-focal, -focal, -k * (1 - u - v)),
        "right": (focal, zero, -k * u),
        "below": (zero, focal, -k * v),
    }
    seen = {"here": mask, "right": shift(mask, 0, 1), "below": shift(mask, 1, 0)}

    def entry(first: str, second: str) -> Array:
        pairs = ((i, j) for i in range(3) for j in range(3))
        value = sum(rows[first][i] * matrix[i, j] * rows[second][j] for i, j in pairs)
        return jnp.where(mask & seen[first] & seen[second], value, 0.0)

    center = entry("here", "here")
    center += shift(entry("right", "right"), 0, -1)
    center += shift(entry("below", "below"), -1, 0)
    product = stencil(
        center,
        entry("here", "right"),
        entry("here", "below"),
        shift(entry("right", "below"), 0, -1),
    )
    transpose = jax.linear_transpose(lambda z: model.linear_normals(z, problem), u)
    right = -transpose(vector)[0]
    return solve_cg(product, right.ravel(), center.ravel()).reshape(u.shape)


def update_depth(state: State, problem: Problem) -> Array:
    """Three damped Gauss-Newton steps on the depth, under frozen weights."""
    residual, _ = model.residuals(*state, problem)
    weights = model.cauchy_weights(residual)

    def objective(depth: Array) -> Array:
        residual, _ = model.residuals(
            depth, state.length, state.albedo, state.lighting, problem
        )
        gap = state.length - model.length_of(model.raw_normals(depth, problem))
        gap = jnp.where(problem.mask, gap, 0.0)
        return 0.5 * (jnp.sum(weights * residual**2) + model.TIE * jnp.sum(gap**2))

    reference = objective(state.depth)

    def advance(_: int, depth: Array) -> Array:
        matrix, vector = _reduce(depth, weights, state, problem)
        step = _newton_step(matrix, vector, problem)

        def tried(t: Array) -> Array:
            return depth + 2 / (2 + 1 / t) * step

        def too_long(carry: tuple) -> Array:
            t, count = carry
            return ~(objective(tried(t)) <= reference) & (count < 30)

        start = (jnp.float32(10), jnp.asarray(0))
        t, count = lax.while_loop(too_long, lambda c: (c[0] / 2, c[1] + 1), start)
        return jnp.where(count < 30, tried(t), depth)

    return lax.fori_loop(0, _DEPTH_STEPS, advance, state.depth)


@jax.jit
def iterate(state: State, problem: Problem, active: Array) -> State:
    """One round of all blocks: albedo, lighting (`active`), depth, lagged length."""
    state = state._replace(albedo=update_albedo(state, problem))
    state = state._replace(lighting=update_lighting(state, problem, active))
    state = state._replace(depth=update_depth(state, problem))
    length = model.length_of(model.raw_normals(state.depth, problem))
    return state._replace(length=length)


def solve(
    problem: Problem,
    depth: Array,
    *,
    iterations: int = 20,
    first_order: int = FIRST_ORDER_ITERATIONS,
) -> Result:
    """Runs the descent from a depth map, positive inside a perspective camera's mask.

    Rounds are `iterations` at most, fewer where the weighted energy settles; the first
    have first-order lighting.
    """
    state = initial_state(depth, problem)
    trace = [model.energy(state, problem)]
    for index in range(iterations):
        active = jnp.arange(9) < (4 if index < first_order else 9)
        state = iterate(state, problem, active.astype(jnp.float32))
        trace.append(model.energy(state, problem))
        before, now = (float(e.weighted + e.smoothness) for e in trace[-2:])
        if abs(before - now) < _TOLERANCE * abs(before) and index + 1 > first_order:
            break
    raw = model.raw_normals(state.depth, problem)
    return Result(state, raw / model.length_of(raw), trace)
