"""Depth of a whole image of normals: NumPy arrays in and out, large sizes, progress.

Equations, solver and conventions are those of `integrate_normals`; here the rounds end
when the depth has settled, arrays are cropped to the mask, and labels come from SciPy.
Memory: about 40 float32 images of the mask's bounding box (4096 x 4096 pixels: 3 GB).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from unips_jax.surface.equations import Statements, statements
from unips_jax.surface.integrate import (
    PRIOR_WEIGHT,
    SHARPNESS,
    Prior,
    Solve,
    check_arrays,
    finish,
    read_prior,
    reweight,
)

_SOLVE = Solve(tolerance=1e-2, max_steps=50)  # the next round mends what is left
_SETTLED = 0.01  # pixels
_MULTIPLE = 64  # sizes are padded to it, so that fewer of them are compiled


class Integration(NamedTuple):
    """A surface, and how it was found.

    Attributes:
        depth: `[H, W]`, float32, as of `integrate_normals`, but NaN where there is
            none.
        islands: number of separate parts, each with its own offset or scale.
        rounds: of reweighting.
        last_change_px: mean absolute change of depth in the last round, in pixels.
    """

    depth: np.ndarray
    islands: int
    rounds: int
    last_change_px: float


def integrate_image(
    normals: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    focal: float | None = None,
    principal_point: tuple[float, float] | None = None,
    prior: np.ndarray | None = None,
    prior_weight: float = PRIOR_WEIGHT,
    sharpness: float = SHARPNESS,
    max_rounds: int = 50,
    progress: Callable[[float], None] | None = None,
) -> Integration:
    """Integrates an image of normals, as `integrate_normals` does.

    Args:
        normals: `[H, W, 3]`, floats.
        mask: `[H, W]`, above 0 where there is a surface; None: where normals are
            neither 0 nor NaN.
        focal: see there.
        principal_point: see there, in pixels of this image.
        prior: see there.
        prior_weight: a number.
        sharpness: see there.
        max_rounds: bound on the rounds of reweighting, which end when depth changes by
            less than 0.01 pixels (mean of absolute values); 0 for plain least squares.
        progress: called with the fraction done.

    Returns:
        The depth `[H, W]`, and how it was found; see `Integration`.

    Raises:
        ValueError: if shapes, types or values are not as described.
    """
    normals = np.asarray(normals)
    if normals.ndim != 3:
        raise ValueError(f"normals: expected [H, W, 3], got {normals.shape}")
    mask = np.ones(normals.shape[:2], bool) if mask is None else np.asarray(mask) > 0
    prior = None if prior is None else np.asarray(prior)
    check_arrays(normals, mask, prior)
    _check_values(focal, prior_weight, sharpness, max_rounds)
    inside = mask & np.isfinite(normals).all(-1) & (normals != 0).any(-1)
    depth = np.full(mask.shape, np.nan, np.float32)
    if not inside.any():
        return Integration(depth, 0, 0, 0.0)
    from unips_jax.io.masks import mask_box  # with OpenCV, which arrays do not need

    box = mask_box(inside)
    height, width = mask.shape
    middle = ((width - 1) / 2, (height - 1) / 2)
    column, row = middle if principal_point is None else principal_point
    camera = (focal, (column - box[1].start, row - box[0].start))
    there = np.where(inside[box][..., None], normals[box], 0).astype(np.float32)
    padded = _padded(inside[box])
    labels, islands = scipy.ndimage.label(padded)
    labels = labels.astype(np.int32)
    stated, known, shift = _start(
        jnp.asarray(_padded(there)),
        jnp.asarray(padded),
        jnp.asarray(labels),
        None if prior is None else jnp.asarray(_padded(prior[box].astype(np.float32))),
        prior_weight,
        *camera,
    )
    depth_px, _ = _round(stated, known, jnp.zeros_like(stated.m), 0.0)
    rounds, change = 0, 0.0
    for rounds in range(1, max_rounds + 1):
        depth_px, moved = _round(stated, known, depth_px, sharpness)
        change = float(moved)
        if progress is not None:
            progress(rounds / max_rounds)
        if change < _SETTLED:
            break
    found = _finish(depth_px, stated.inside, known, shift, labels, focal)
    crop = np.asarray(found)[: inside[box].shape[0], : inside[box].shape[1]]
    depth[box] = np.where(inside[box], crop, np.nan)
    if progress is not None:
        progress(1.0)
    return Integration(depth, islands, rounds, change)


def _check_values(
    focal: float | None, prior_weight: float, sharpness: float, max_rounds: int
) -> None:
    if focal is not None and not (np.isfinite(focal) and focal > 0):
        raise ValueError(f"focal: expected pixels above 0, got {focal}")
    for name, value in (
        ("prior_weight", prior_weight),
        ("sharpness", sharpness),
        ("max_rounds", max_rounds),
    ):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name}: expected 0 or more, got {value}")


def _padded(values: np.ndarray) -> np.ndarray:
    """Adds 0 at the bottom and at the right, up to multiples of 64."""
    padding = [(0, -size % _MULTIPLE) for size in values.shape[:2]]
    return np.pad(values, padding + [(0, 0)] * (values.ndim - 2))


@jax.jit
def _start(
    normals: jax.Array,
    inside: jax.Array,
    labels: jax.Array,
    prior: jax.Array | None,
    prior_weight: float,
    focal: float | None,
    principal_point: tuple[float, float],
) -> tuple[Statements, Prior, jax.Array]:
    stated = statements(normals, inside, focal, principal_point)
    known, shift = read_prior(prior, prior_weight, stated.inside, labels, focal)
    return stated, known, shift


@jax.jit
def _round(
    stated: Statements, known: Prior, depth: jax.Array, sharpness: float
) -> tuple[jax.Array, jax.Array]:
    new = reweight(stated, known, depth, sharpness, _SOLVE)
    # The mean: normals of noisy silhouettes never settle, and would rule the square.
    moved = jnp.where(stated.inside, jnp.abs(new - depth), 0)
    return new, moved.sum() / stated.inside.sum().astype(moved.dtype)


_finish = jax.jit(finish)
