"""MPM-style patch method: uncalibrated photometric stereo under natural light.

Patches of little curvature see an environment as one directional light each; they are
solved one by one up to an orthogonal frame, merged, and the common frame is placed in
the world. Our reconstruction from the published idea; the authors' code was never
public, and identity with it cannot be claimed.

What of it is faithful to the publication: `merge="angles"`, `frame="integrability"`,
`albedo="none"`. The defaults are our sturdier choices. The publication settled the sign
by hand; here the rim points outwards (the evaluation's `sign=oracle` takes the best
signs by the truth and marks the row). Orthographic camera; convex objects of uniform
or piecewise constant albedo.

Source: Mo, Shi, Lu, Yeung, Matsushita, "Uncalibrated photometric stereo under natural
illumination" (CVPR 2018), as compared with in UniPS (Ikehata, CVPR 2022).
"""

from typing import Literal, get_args

import numpy as np
from scipy import ndimage

from unips_jax.baselines.method import Estimated, Method, Observed, Unsupported
from unips_jax.baselines.mpm.frame import frame_by_integrability, frame_by_silhouette
from unips_jax.baselines.mpm.merge import merge_angles, merge_sync
from unips_jax.baselines.mpm.patches import (
    MIN_IMAGES,
    MIN_PIXELS,
    Patch,
    flatten_albedo,
    solve_patches,
)
from unips_jax.baselines.pixels import normal_map, object_pixels
from unips_jax.baselines.silhouette import convex_sign
from unips_jax.checks import require_choice

Merge = Literal["sync", "angles"]
Frame = Literal["silhouette", "integrability"]
Albedo = Literal["profile", "none"]

_PATCH = 0.11  # half-width of a patch over the images' side
_SATURATED = 1e-3  # share of samples at the very maximum that means clipping


def mpm(
    *,
    merge: Merge = "sync",
    frame: Frame = "silhouette",
    albedo: Albedo = "profile",
    radius: int | None = None,
) -> Method:
    """Makes the MPM-style method; it needs at least six images.

    It reports what share of its patches it dropped: 0 is good, 30 % means that the
    light was not what it assumes.

    Args:
        merge: "sync" reconciles the patches' frames, "angles" follows shortest paths.
        frame: "silhouette" falls back to "integrability" where the mask touches the
            images' border, or has no outline away from it.
        albedo: "profile" divides an estimate of piecewise constant albedo out.
        radius: half-width of a patch in pixels; None: 0.11 of the images' side.
    """
    require_choice("merge", merge, get_args(Merge))
    require_choice("frame", frame, get_args(Frame))
    require_choice("albedo", albedo, get_args(Albedo))
    merge_patches = merge_sync if merge == "sync" else merge_angles

    def method(observed: Observed) -> Estimated:
        pixels, mask = object_pixels(observed, name="mpm", minimum=MIN_IMAGES)
        grey, lit = _grey(pixels, mask)
        if albedo == "profile":
            grey = flatten_albedo(grey, lit)
        patches, dropped = _patches(grey, lit, radius)
        field = _fill(merge_patches(patches, lit.sum()), lit, mask)
        silhouette = frame == "silhouette" and not _touches_border(mask)
        field = (_by_outline if silhouette else frame_by_integrability)(field, mask)
        field = _make_convex(field, mask)
        normals = normal_map(field[mask], mask)
        return Estimated(normals, {"dropped patches (%)": 100 * dropped})

    return method


def _by_outline(field: np.ndarray, mask: np.ndarray) -> np.ndarray:
    try:
        return frame_by_silhouette(field, mask, name="mpm")
    except Unsupported:  # no outline but next to the images' border
        return frame_by_integrability(field, mask)


def _patches(
    grey: np.ndarray, lit: np.ndarray, radius: int | None
) -> tuple[list[Patch], float]:
    """The patches that could be solved, and the share that could not, in [0, 1]."""
    if radius is None:
        radius = max(round(_PATCH * max(lit.shape)), 2)
    patches, dropped = solve_patches(grey, lit, radius=radius)
    if not patches:
        raise Unsupported(
            f"mpm: none of the patches of {2 * radius + 1} pixels could be solved; the "
            "object is too small or its light too uniform"
        )
    return patches, dropped


def _grey(pixels: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey images `[N, H, W]`, NaN where saturated, and the usable pixels' mask."""
    count = pixels.shape[1]
    peak = pixels.max()
    clipped = (pixels >= peak * (1 - 1e-6)).any(-1)  # [P, N]
    clipped &= clipped.mean() > _SATURATED
    grey = np.zeros((count, *mask.shape))
    values = np.where(clipped, np.nan, pixels.mean(-1, dtype=np.float64)).T
    grey[:, mask] = values / peak
    lit = mask.copy()
    clear = np.isfinite(values).sum(0) >= min(MIN_IMAGES, count)
    lit[mask] = clear & (np.nanmax(np.where(clear, values, 0), axis=0) > 0)
    if lit.sum() < MIN_PIXELS:
        raise Unsupported(
            f"mpm: needs at least {MIN_PIXELS} lit, unsaturated pixels on the object, "
            f"got {lit.sum()}"
        )
    return grey, lit


def _fill(merged: np.ndarray, lit: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Puts the pixels' normals back `[H, W, 3]`; holes copy their nearest pixel."""
    field = np.full((*mask.shape, 3), np.nan)
    field[lit] = merged
    unknown = ~np.isfinite(field[..., 0])
    nearest = ndimage.distance_transform_edt(
        unknown, return_distances=False, return_indices=True
    )
    return np.where(mask[..., None], field[tuple(nearest)], 0.0)


def _make_convex(field: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Points the rim outwards, or without a rim the whole object from its middle."""
    try:
        return convex_sign(field, mask, name="mpm")
    except Unsupported:
        rows, columns = np.nonzero(mask)
        x, y = columns - columns.mean(), rows.mean() - rows
        outwards = np.sum(x * field[mask][:, 0] + y * field[mask][:, 1])
        return field if outwards >= 0 else field * np.array([-1.0, -1.0, 1.0])


def _touches_border(mask: np.ndarray) -> bool:
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())
