"""Depth from normals, by bilateral normal integration.

Conventions, equations and source are those of `unips_jax.surface.equations`. They are
solved by iteratively reweighted least squares, first with equal weights. Each round
solves for the change of depth, with faint springs added to every edge, and to pixels of
islands without a prior: what the weights cut off entirely stays where it is, and the
fixed point is the same.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from unips_jax.surface.equations import (
    Edges,
    Statements,
    balance,
    differences,
    links,
    statements,
    system,
)
from unips_jax.surface.islands import island_means, label_islands
from unips_jax.surface.multigrid import Springs, solve


class Solve(NamedTuple):
    """When a linear solve ends: the residual's tolerance, relative, and most steps."""

    tolerance: float
    max_steps: int


SHARPNESS = 2.0  # k of the paper
PRIOR_WEIGHT = 1e-4
_SOLVE = Solve(tolerance=1e-5, max_steps=100)
_FAINT = 1e-5  # stiffness added to every edge of the matrix, not of the equations
_HELD = 1e-8  # the same of pixels that no prior holds: rounding would carry them away


class Prior(NamedTuple):
    """A known depth, in the equations' unknown; all `[H, W]`, 0 where unknown."""

    depth: jax.Array
    weight: jax.Array
    held: jax.Array  # pull of pixels to where they are


def integrate_normals(
    normals: ArrayLike,
    mask: ArrayLike,
    *,
    focal: ArrayLike | None = None,
    principal_point: tuple[ArrayLike, ArrayLike] | None = None,
    prior: ArrayLike | None = None,
    prior_weight: ArrayLike = PRIOR_WEIGHT,
    sharpness: ArrayLike = SHARPNESS,
    rounds: int = 20,
) -> jax.Array:
    """Depth whose surface has these normals; breaks where they do not fit together.

    Pure and jitted, for `jit`, `vmap` and `grad`: derivatives go through every round's
    linear solve by the implicit function theorem, so that memory is one image a round.
    Each part of the mask that is connected by pixels' edges has its own offset (with
    perspective: scale), which normals leave open.

    Args:
        normals: `[H, W, 3]`, x right, y up, z towards the viewer, row 0 at the top.
            Pixels with NaN or 0 are holes.
        mask: `[H, W]`, bool or above 0 where there is a surface.
        focal: focal length in pixels; None for an orthographic camera.
        principal_point: column and row in pixels, (0, 0) the centre of the first
            pixel; None for the middle of the image. Perspective only.
        prior: `[H, W]`, depth in the result's convention and the user's unit (an
            orthographic one in pixels), NaN where unknown.
        prior_weight: a number or `[H, W]`: of the squared difference to the prior,
            next to the normals' squared error of slope. The prior decides over
            distances above about `prior_weight ** -0.5` pixels, the normals below.
        sharpness: of the choice between a pixel's two sides; 0 gives plain least
            squares, which bridges jumps.
        rounds: of reweighting, after the first solve with equal weights; static: under
            a `jit` of your own name it in `static_argnames`.

    Returns:
        `[H, W]`, float32, growing away from the viewer. Orthographic: in pixels, mean
        0 over each island. Perspective: distance along the optical axis, geometric
        mean 1 over each island. With a prior: in its unit and place; islands without
        it have its mean. 0 outside the mask and in holes.

    Raises:
        ValueError: if shapes do not fit, `rounds` is negative, or normals are integers,
            as of a normal map that `read_normals` decodes.
    """
    normals, mask = jnp.asarray(normals), jnp.asarray(mask)
    if prior is not None:
        prior = jnp.asarray(prior, jnp.float32)
    check_arrays(normals, mask, prior)
    if rounds < 0:
        raise ValueError(f"rounds: expected 0 or more, got {rounds}")
    options: Any = {
        "focal": focal,
        "principal_point": principal_point,
        "prior_weight": prior_weight,
        "sharpness": sharpness,
    }
    # Of one type, however they are given: one compilation serves all.
    options = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), options)
    inside = mask > jnp.zeros_like(mask)  # of its type, for strict promotion
    return _integrate(normals, inside, prior=prior, rounds=rounds, **options)


@functools.partial(jax.jit, static_argnames="rounds")
def _integrate(
    normals: jax.Array,
    mask: jax.Array,
    *,
    focal: jax.Array | None,
    principal_point: tuple[jax.Array, jax.Array] | None,
    prior: jax.Array | None,
    prior_weight: jax.Array,
    sharpness: jax.Array,
    rounds: int,
) -> jax.Array:
    stated = statements(normals, mask, focal, principal_point)
    labels = label_islands(stated.inside)
    known, shift = read_prior(prior, prior_weight, stated.inside, labels, focal)

    def advance(depth, sharpness):
        new = reweight(stated, known, depth, sharpness, _SOLVE)
        return new, None

    sharpnesses = jnp.full(rounds + 1, sharpness, jnp.float32).at[0].set(0)
    depth, _ = jax.lax.scan(advance, jnp.zeros_like(stated.m), sharpnesses)
    return finish(depth, stated.inside, known, shift, labels, focal)


def check_arrays(normals: Any, mask: Any, prior: Any = None) -> None:
    """Raises ValueError for shapes that do not fit, and for integers as normals."""
    if len(mask.shape) != 2 or 0 in mask.shape:
        raise ValueError(f"mask: expected [H, W], at least one pixel, got {mask.shape}")
    if normals.shape != (*mask.shape, 3):
        raise ValueError(
            f"normals: expected {(*mask.shape, 3)} as of the mask, got {normals.shape}"
        )
    if not jnp.issubdtype(normals.dtype, jnp.floating):
        raise ValueError(
            f"normals: expected floats of unit length, got {normals.dtype}; "
            "read_normals decodes a normal map"
        )
    if prior is not None and prior.shape != mask.shape:
        raise ValueError(
            f"prior: expected {mask.shape} as of the mask, got {prior.shape}"
        )


def read_prior(
    prior: jax.Array | None,
    weight: jax.Array | float,
    inside: jax.Array,
    labels: jax.Array,
    focal: jax.Array | float | None,
) -> tuple[Prior, jax.Array]:
    """A prior, NaN where unknown, as the equations' unknown of mean 0; and its mean."""
    if prior is None:
        nothing = jnp.zeros(inside.shape, jnp.float32)
        held = jnp.full(inside.shape, _HELD, jnp.float32)
        return Prior(nothing, nothing, held), jnp.zeros((), jnp.float32)
    prior, weight = (jnp.asarray(x, jnp.float32) for x in (prior, weight))
    known = inside & jnp.isfinite(prior)
    if focal is None:
        depth = jnp.where(known, prior, 0)
    else:
        known &= prior > 0
        depth = focal * jnp.log(jnp.where(known, prior, 1))
    shift = depth.sum() / jnp.maximum(known.sum(), 1).astype(depth.dtype)
    weight = jnp.where(known, weight, 0)
    _, pulled = island_means(weight, weight, labels)
    held = jnp.where(pulled > 0, 0, _HELD)
    return Prior(jnp.where(known, depth - shift, 0), weight, held), shift


def reweight(
    stated: Statements,
    prior: Prior,
    depth: jax.Array,
    sharpness: jax.Array | float,
    until: Solve,
) -> jax.Array:
    """One round: weights from the depth (the unknown), then the depth best for them."""
    stiffness, asked = system(stated, depth, sharpness)
    faint = Edges(
        *(
            jnp.where(linked, each + _FAINT, 0)
            for linked, each in zip(links(stated.inside), stiffness, strict=True)
        )
    )
    step = differences(depth)
    missing = Edges(
        stiffness.right * (asked.right - step.right),
        stiffness.down * (asked.down - step.down),
    )
    force = balance(missing) + prior.weight * (prior.depth - depth)
    springs = Springs(faint, prior.weight + prior.held)
    change = solve(springs, force, **until._asdict())
    return depth + change


def finish(
    depth: jax.Array,
    inside: jax.Array,
    prior: Prior,
    shift: jax.Array,
    labels: jax.Array,
    focal: jax.Array | float | None,
) -> jax.Array:
    """Sets each island's offset and turns the unknown into depth, 0 outside."""
    mean, _ = island_means(depth, inside.astype(depth.dtype), labels)
    _, held = island_means(depth, prior.weight, labels)
    depth = depth - jnp.where(held > 0, 0, mean) + shift
    if focal is not None:
        depth = jnp.exp(jnp.where(inside, depth, 0) / focal)
    return jnp.where(inside, depth, 0)
