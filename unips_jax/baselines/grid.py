"""Differences on a masked pixel grid, and conjugate gradients.

Every function takes images whose last two axes are rows (downwards) and columns (to
the right); the mask is `[H, W]`, bool. Gradients are stacked on a new leading axis:
index 0 along the columns, index 1 along the rows. All are linear in the image, so
their transposes come from `jax.linear_transpose`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jax.scipy.sparse.linalg
from jax import Array, lax

Product = Callable[[Array], Array]


def shift(image: Array, rows: int, columns: int) -> Array:
    """Every pixel's neighbour, `out[y, x] = image[y + rows, x + columns]`, or zero."""
    height, width = image.shape[-2:]
    padded = jnp.pad(image, [(0, 0)] * (image.ndim - 2) + [(1, 1), (1, 1)])
    padded = lax.slice_in_dim(padded, 1 + rows, 1 + rows + height, axis=-2)
    return lax.slice_in_dim(padded, 1 + columns, 1 + columns + width, axis=-1)


def forward(image: Array, mask: Array, *, closed: bool) -> Array:
    """Forward differences `[2, ..., H, W]`: right minus here, below minus here.

    Zero outside the mask. `closed`: the difference across the mask's edge is zero
    (Neumann); else outside the mask the image counts as zero (Dirichlet).
    """
    inside = jnp.where(mask, image, 0.0)
    steps = []
    for rows, columns in ((0, 1), (1, 0)):
        difference = shift(inside, rows, columns) - inside
        valid = mask & shift(mask, rows, columns) if closed else mask
        steps.append(jnp.where(valid, difference, 0.0))
    return jnp.stack(steps)


def central(image: Array, mask: Array) -> Array:
    """Central differences `[2, ..., H, W]`, zero unless both neighbours are inside."""
    steps = []
    for rows, columns in ((0, 1), (1, 0)):
        difference = 0.5 * (shift(image, rows, columns) - shift(image, -rows, -columns))
        valid = mask & shift(mask, rows, columns) & shift(mask, -rows, -columns)
        steps.append(jnp.where(valid, difference, 0.0))
    return jnp.stack(steps)


def solve_cg(
    product: Product,
    right: Array,
    diagonal: Array,
    *,
    start: Array | None = None,
    rtol: float = 1e-4,
    limit: int = 1000,
) -> Array:
    """Conjugate gradients with Jacobi's preconditioner.

    `product` is the symmetric positive semi-definite matrix, as a function; entries of
    its diagonal <= 0 mark no unknown, where `right` is zero. Stops once the residual's
    norm is below `rtol` times the norm of `right`, or after `limit` iterations.
    """
    inverse = jnp.where(diagonal > 0, 1 / jnp.where(diagonal > 0, diagonal, 1.0), 0.0)
    return jax.scipy.sparse.linalg.cg(
        product, right, start, tol=rtol, maxiter=limit, M=lambda r: inverse * r
    )[0]


def stencil(center: Array, right: Array, below: Array, aslant: Array) -> Product:
    """A symmetric matrix that links pixels to their neighbours, as a function.

    Written out, because it is what the depth update spends its time on. Of each pixel,
    `[H, W]`: `center` is the diagonal, the others link it to the one to its right,
    below, and below to the left; entries for neighbours beyond the border must be zero.
    The function takes flat images `[H * W]`.
    """
    size, width = center.size, center.shape[1]
    terms = [(center.ravel(), 0)]
    for image, rows, columns in ((right, 0, 1), (below, 1, 0), (aslant, 1, -1)):
        offset = rows * width + columns
        terms.append((image.ravel(), offset))
        terms.append((shift(image, -rows, -columns).ravel(), -offset))

    def product(flat: Array) -> Array:
        padded = jnp.pad(flat, width + 1)
        total = jnp.zeros_like(flat)
        for coefficient, offset in terms:
            begin = width + 1 + offset
            total += coefficient * lax.slice(padded, (begin,), (begin + size,))
        return total

    return product


def integrate(slopes: Array, mask: Array) -> Array:
    """Integrates slopes `[2, H, W]` by least squares: `[H, W]`, mean 0 on the mask."""
    links = jnp.stack(
        [mask & shift(mask, 0, 1), mask & shift(mask, 1, 0)], dtype=slopes.dtype
    )
    flow_x, flow_y = links * slopes
    divergence = shift(flow_x, 0, -1) - flow_x + shift(flow_y, -1, 0) - flow_y
    degree = links[0] + links[1] + shift(links[0], 0, -1) + shift(links[1], -1, 0)
    product = stencil(degree, -links[0], -links[1], jnp.zeros_like(degree))
    limit = 10 * max(mask.shape)
    flat = solve_cg(product, divergence.ravel(), degree.ravel(), rtol=1e-5, limit=limit)
    solution = flat.reshape(mask.shape)
    mean = jnp.sum(solution) / jnp.maximum(jnp.sum(mask), 1)
    return jnp.where(mask, solution - mean, 0.0)
