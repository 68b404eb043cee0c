"""Conjugate gradients with a multigrid preconditioner, for Laplacians on pixel grids.

The matrix is `A x = balance(stiffness * differences(x)) + pull * x`: springs between
neighbours and, optionally, to fixed points. It is never formed: coarser grids have
cells of 2 x 2, whose springs are half the sum of those that cross between them, which
keeps the five-point stencil on all levels (half, as the cells' centres are twice as far
apart; constant interpolation would make the coarse surface too stiff otherwise). One
V-cycle with Chebyshev smoothing is a symmetric positive preconditioner. Memory is a
fixed number of images.

Sources: W. L. Briggs, V. E. Henson, S. F. McCormick, "A Multigrid Tutorial" (2000);
D. Braess, "Towards algebraic multigrid for elliptic problems of second order" (1995),
for the factor of the coarse matrix; M. Adams et al., "Parallel multigrid smoothing:
polynomial versus Gauss-Seidel" (2003), for the smoother.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from unips_jax.surface.equations import Edges, balance, differences, to_bottom, to_right

# The eigenvalues of D^-1 A that Chebyshev smoothing damps; 2 bounds all of them.
_LOW, _HIGH = 0.35, 2.0
_SWEEPS = 2
_COARSEST = 4  # pixels on a side


class Springs(NamedTuple):
    """The matrix A, symmetric and positive semidefinite."""

    stiffness: Edges  # of each edge, 0 or more, 0 where there is none
    pull: jax.Array  # `[H, W]`, 0 or more, added to the diagonal


def multiply(springs: Springs, x: jax.Array) -> jax.Array:
    """A x, `[H, W]`."""
    step = differences(x)
    flow = Edges(
        springs.stiffness.right * step.right, springs.stiffness.down * step.down
    )
    return balance(flow) + springs.pull * x


def solve(
    springs: Springs, b: jax.Array, *, tolerance: float, max_steps: int
) -> jax.Array:
    """Solves A x = b; differentiable in the matrix and in b, by the implicit function.

    The matrix may be singular, if b sums to 0 over each connected part without pull.
    `tolerance` is of the residual, relative to b in the Euclidean norm; `max_steps`
    bounds the conjugate gradients.
    """
    fixed = jax.lax.stop_gradient(springs)

    def conjugate(_, right_side):
        return conjugate_gradients(
            fixed, right_side, tolerance=tolerance, max_steps=max_steps
        )[0]

    return jax.lax.custom_linear_solve(
        lambda x: multiply(springs, x), b, conjugate, symmetric=True
    )


def conjugate_gradients(
    springs: Springs, b: jax.Array, *, tolerance: float, max_steps: int
) -> tuple[jax.Array, jax.Array]:
    """As `solve`, without derivatives: x, and the number of steps taken."""
    levels = _levels(springs)
    goal = (tolerance**2) * jnp.vdot(b, b)

    def unfinished(state):
        _, residual, _, _, step = state
        return (step < max_steps) & (jnp.vdot(residual, residual) > goal)

    def advance(state):
        x, residual, direction, descent, step = state
        image = multiply(springs, direction)
        length = _ratio(descent, jnp.vdot(direction, image))
        x = x + length * direction
        new = residual - length * image
        conditioned = _v_cycle(levels, new)
        # Polak-Ribiere: forgives rounding.
        turn = _ratio(jnp.vdot(conditioned, new - residual), descent)
        direction = conditioned + turn * direction
        return x, new, direction, jnp.vdot(conditioned, new), step + 1

    first = _v_cycle(levels, b)
    start = (jnp.zeros_like(b), b, first, jnp.vdot(first, b), jnp.int32(0))
    x, _, _, _, step = jax.lax.while_loop(unfinished, advance, start)
    return x, step


def _ratio(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.where(b > 0, a / jnp.where(b > 0, b, 1), 0)


def _levels(springs: Springs) -> list[tuple[Springs, jax.Array]]:
    """The matrices from fine to coarse, each with the inverse of its diagonal."""
    levels = []
    while True:
        right, down = springs.stiffness
        diagonal = right + to_right(right) + down + to_bottom(down) + springs.pull
        some = diagonal > 0
        levels.append((springs, jnp.where(some, 1 / jnp.where(some, diagonal, 1), 0)))
        if max(springs.pull.shape) <= _COARSEST:
            return levels
        springs = _coarser(springs)


def _coarser(springs: Springs) -> Springs:
    right, down = springs.stiffness
    pull = _cells(springs.pull)
    height, width = pull.shape
    # The edges that leave a cell of 2 x 2 to the right start in its odd column.
    right = _pairs(right[:, 1::2], 0) / 2
    down = _pairs(down[1::2], 1) / 2
    right = jnp.pad(right, ((0, 0), (0, width - right.shape[1])))
    down = jnp.pad(down, ((0, height - down.shape[0]), (0, 0)))
    return Springs(Edges(right, down), pull)


def _pairs(values: jax.Array, axis: int) -> jax.Array:
    """Sums pairs of rows (axis 0) or columns (1); an odd one is alone."""
    padding = [(0, 0), (0, 0)]
    padding[axis] = (0, values.shape[axis] % 2)
    values = jnp.pad(values, padding)
    shape = list(values.shape)
    shape[axis : axis + 1] = [shape[axis] // 2, 2]
    return values.reshape(shape).sum(axis + 1)


def _cells(values: jax.Array) -> jax.Array:
    return _pairs(_pairs(values, 0), 1)


def _spread(values: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The transpose of `_cells`."""
    values = jnp.repeat(jnp.repeat(values, 2, 0), 2, 1)
    return values[: shape[0], : shape[1]]


def _v_cycle(
    levels: list[tuple[Springs, jax.Array]], b: jax.Array, level: int = 0
) -> jax.Array:
    springs, inverse = levels[level]
    x = jnp.zeros_like(b)
    if level == len(levels) - 1:
        return _smooth(springs, inverse, b, x, 8 * _SWEEPS)
    x = _smooth(springs, inverse, b, x, _SWEEPS)
    coarse = _v_cycle(levels, _cells(b - multiply(springs, x)), level + 1)
    return _smooth(springs, inverse, b, x + _spread(coarse, b.shape), _SWEEPS)


def _smooth(
    springs: Springs, inverse: jax.Array, b: jax.Array, x: jax.Array, sweeps: int
) -> jax.Array:
    """Chebyshev iteration on D^-1 A."""
    # A loop, although it is short: unrolled, the compiler fuses the shifts of one sweep
    # into the next and takes minutes.
    centre, radius = (_HIGH + _LOW) / 2, (_HIGH - _LOW) / 2
    ratio = centre / radius

    def sweep(index, state):
        x, change, rho = state
        residual = inverse * (b - multiply(springs, x))
        new = jnp.where(index == 0, 1 / ratio, 1 / (2 * ratio - rho))
        change = jnp.where(
            index == 0,
            residual / centre,
            new * rho * change + 2 * new / radius * residual,
        )
        return x + change, change, new

    start = (x, jnp.zeros_like(x), jnp.zeros((), x.dtype))
    return jax.lax.fori_loop(0, sweeps, sweep, start)[0]
