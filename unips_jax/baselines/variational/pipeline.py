"""Variational uncalibrated photometric stereo under general lighting.

Depth, albedo and second-order spherical-harmonic lighting of every image and channel,
found from a balloon over the mask by alternating descent.

A re-implementation, validated against the authors' results on synthetic data. Where it
departs from them: Huber's function is symmetric, the starting balloon has a size by
default or automatically, and there is an orthographic camera. The method assumes an
object of Lambertian material without cast shadows; its result depends strongly on the
starting volume.

Source: Haefner, Ye, Gao, Wu, Quéau, Cremers, "Variational uncalibrated photometric
stereo under general lighting" (ICCV 2019).
"""

import warnings
from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.baselines.balloon import balloon, perspective_depth, to_product_frame
from unips_jax.baselines.method import Method, Observed, Unsupported
from unips_jax.baselines.pixels import object_pixels
from unips_jax.baselines.variational.descent import FIRST_ORDER_ITERATIONS, solve
from unips_jax.baselines.variational.model import Energy, Problem, inner_normals
from unips_jax.checks import require_choice

Schedule = Literal["authors", "second"]
Camera = Literal["perspective", "orthographic"]
Border = Literal["authors", "inside"]

MIN_IMAGES = 3


def variational(
    *,
    sh_schedule: Schedule = "authors",
    camera: Camera = "perspective",
    volume: float | Literal["auto"] | None = None,
    iterations: int = 20,
    clamp: bool = False,
    border: Border = "authors",
) -> Method:
    """Makes the variational method; it needs at least three images.

    An infinite focal length means the orthographic camera; without any the perspective
    camera takes the images' longer side, with a warning.

    Args:
        sh_schedule: "authors" starts with eight rounds of first-order lighting,
            "second" has second-order lighting from the start, which is more accurate.
        camera: "orthographic" ignores the focal length.
        volume: the starting balloon's mean height in pixels; None: a fifth of the
            radius of the disc with the mask's area; "auto": tries 0.1, 0.2 and 0.3
            radii and keeps the lowest final energy, for three times the work.
        iterations: rounds at most.
        clamp: leave pixels with negative shading out.
        border: "authors" has depth 0 beyond the mask, which turns the normals of its
            right and lower rim away; "inside" reads these from the depth inside.
    """
    require_choice("sh_schedule", sh_schedule, get_args(Schedule))
    require_choice("camera", camera, get_args(Camera))
    require_choice("border", border, get_args(Border))
    if not (volume in (None, "auto") or (not isinstance(volume, str) and volume > 0)):
        raise ValueError(f"volume: expected 'auto' or pixels > 0, got {volume!r}")
    first_order = FIRST_ORDER_ITERATIONS if sh_schedule == "authors" else 0

    def method(observed: Observed) -> np.ndarray:
        _, mask = object_pixels(observed, name="variational", minimum=MIN_IMAGES)
        focal = observed.focal
        if camera == "orthographic":
            focal = np.inf
        elif focal is None:
            focal = float(max(mask.shape))
            warnings.warn(
                f"variational: focal length unknown, {focal:g} px assumed (the "
                "images' side); pass focal or use the orthographic camera",
                stacklevel=2,
            )
        problem = make_problem(observed.images, mask, focal=focal, clamp=clamp)
        results = [
            solve(
                problem,
                initial_depth(problem, size),
                iterations=iterations,
                first_order=first_order,
            )
            for size in _volumes(volume, mask)
        ]
        best = min(results, key=lambda result: _cost(result.trace[-1]))
        if not np.isfinite(_cost(best.trace[-1])):
            raise Unsupported("variational: the descent diverged on these images")
        normals = best.normals
        if border == "inside":
            normals = inner_normals(best.state.depth, problem)
        return to_product_frame(normals, mask)

    return method


def _volumes(volume: float | str | None, mask: np.ndarray) -> list[float]:
    radius = float(np.sqrt(mask.sum() / np.pi))
    if volume == "auto":
        return [share * radius for share in (0.1, 0.2, 0.3)]
    return [0.2 * radius if volume is None else float(volume)]


def _cost(last: Energy) -> float:
    cost = float(last.photometric + last.smoothness)
    return cost if np.isfinite(cost) else np.inf


def make_problem(
    images: np.ndarray, mask: np.ndarray, *, focal: float = np.inf, clamp: bool = False
) -> Problem:
    """Prepares images `[N, H, W, C]`, linear, of any scale, and the camera.

    `focal` is in pixels, infinite for the orthographic camera; the principal point is
    at the images' centre. `clamp` leaves pixels with negative shading out.
    """
    height, width = mask.shape
    inside = np.where(mask[..., None], np.asarray(images, np.float32), 0)
    stack = np.moveaxis(inside / inside.max(), -1, 1)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    return Problem(
        images=jnp.asarray(stack),
        mask=jnp.asarray(mask, bool),
        u=jnp.asarray(u - (width - 1) / 2),
        v=jnp.asarray(v - (height - 1) / 2),
        focal=jnp.float32(focal if np.isfinite(focal) else 1),
        perspective=jnp.float32(np.isfinite(focal)),
        clamp=jnp.asarray(clamp),
    )


def initial_depth(problem: Problem, volume: float) -> Array:
    """Depth `[H, W]` of a balloon of a mean height in pixels, seen by the camera."""
    height = balloon(problem.mask, volume)
    if not problem.perspective:
        return -height
    return perspective_depth(height, problem.mask, problem.u, problem.v, problem.focal)
