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

from typing import Literal, NamedTuple

import numpy as np
from scipy import ndimage

from unips_jax.baselines.method import Estimated, Method, Observed, Unsupported
from unips_jax.baselines.mpm.frame import frame_by_integrability, frame_by_silhouette
from unips_jax.baselines.mpm.merge import merge_angles, merge_sync
from unips_jax.baselines.mpm.patches import (
    MIN_IMAGES,
    MIN_PIXELS,
    flatten_albedo,
    solve_patches,
)
from unips_jax.baselines.pixels import normal_map, object_pixels
from unips_jax.baselines.surface import convex_sign

_PATCH = 0.11  # half-width of a patch over the images' side
_SATURATED = 1e-3  # share of samples at the very maximum that means clipping


class Estimate(NamedTuple):
    """What the method found.

    Attributes:
        normals: `[H, W, 3]`, float32, unit length inside the mask, zero outside.
        reliability: share of patches that had to be dropped, in [0, 1]: 0 is good,
            0.3 means that the light was not what the method assumes.
        frame: how the frame was fixed, "silhouette" or "integrability".
    """

    normals: np.ndarray
    reliability: float
    frame: str


def estimate_mpm(
    observed: Observed,
    *,
    merge: Literal["sync", "angles"] = "sync",
    frame: Literal["silhouette", "integrability"] = "silhouette",
    albedo: Literal["profile", "none"] = "profile",
    radius: int | None = None,
) -> Estimate:
    """Runs the method.

    Args:
        observed: the mask and at least six images.
        merge: "sync" reconciles the patches' frames, "angles" follows shortest paths.
        frame: "silhouette" falls back to "integrability" where the mask touches the
            images' border.
        albedo: "profile" divides an estimate of piecewise constant albedo out.
        radius: half-width of a patch in pixels; None: 0.11 of the images' side.

    Raises:
        Unsupported: if there are fewer than six images, the mask is empty or too
            small, or no patch can be solved.
        ValueError: if an option is none of the above.
    """
    _check_options(merge, frame, albedo)
    pixels, mask = object_pixels(observed, name="mpm", minimum=MIN_IMAGES)
    grey, lit = _grey(pixels, mask)
    if lit.sum() < MIN_PIXELS:
        raise Unsupported(
            f"mpm: needs at least {MIN_PIXELS} lit, unsaturated pixels on the object, "
            f"got {lit.sum()}"
        )
    if albedo == "profile":
        grey = flatten_albedo(grey, lit)
    if radius is None:
        radius = max(round(_PATCH * max(mask.shape)), 2)
    patches, dropped = solve_patches(grey, lit, radius=radius)
    if not patches:
        raise Unsupported(
            f"mpm: none of the patches of {2 * radius + 1} pixels could be solved; the "
            "object is too small or its light too uniform"
        )
    merged = (merge_sync if merge == "sync" else merge_angles)(patches, lit.sum())
    field = _fill(merged, lit, mask)
    if frame == "silhouette" and _touches_border(mask):
        frame = "integrability"
    if frame == "silhouette":
        field = frame_by_silhouette(field, mask, name="mpm")
    else:
        field = frame_by_integrability(field, mask)
    field = _make_convex(field, mask)
    return Estimate(normal_map(field[mask], mask), dropped, frame)


def mpm(
    *,
    merge: Literal["sync", "angles"] = "sync",
    frame: Literal["silhouette", "integrability"] = "silhouette",
    albedo: Literal["profile", "none"] = "profile",
    radius: int | None = None,
) -> Method:
    """Makes the MPM-style method.

    Args:
        merge: as in `estimate_mpm`, which lists all options.
        frame: likewise.
        albedo: likewise.
        radius: likewise.

    Returns:
        The method; it ignores lights and focal length, and says how many patches it
        dropped.

    Raises:
        ValueError: if an option is unknown.
    """
    _check_options(merge, frame, albedo)

    def method(observed: Observed) -> Estimated:
        found = estimate_mpm(
            observed, merge=merge, frame=frame, albedo=albedo, radius=radius
        )
        return Estimated(
            found.normals, {"dropped patches (%)": 100 * found.reliability}
        )

    return method


def _check_options(merge: str, frame: str, albedo: str) -> None:
    for name, value, choices in (
        ("merge", merge, ("sync", "angles")),
        ("frame", frame, ("silhouette", "integrability")),
        ("albedo", albedo, ("profile", "none")),
    ):
        if value not in choices:
            raise ValueError(f"{name}: expected one of {choices}, got {value!r}")


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
