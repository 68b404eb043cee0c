"""From normals to a folder's files of depth and mesh, and what the record holds."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, as_float, as_linear, in_srgb, srgb_encode
from unips_jax.io.record import print_line
from unips_jax.surface.depth_files import write_depth
from unips_jax.surface.mesh import CUT, mesh_of_depth, write_mesh

MeshFormat = Literal["ply", "obj", "glb"]

_WIDEST = 0.25  # focal length by the longer side: 127 degrees


def focal_of(
    asked: str | None,
    exif: float | None,
    file: Path | None,
    size: tuple[int, ...] = (),
) -> float | None:
    """The focal length in pixels by `--focal`, a number or "exif"; None without it.

    `size` is that of the picture, of which a number must not be a small part.
    """
    if asked is None:
        return None
    if asked == "exif":
        if file is None:
            raise InputError(
                "--focal exif: expected a photograph, got none; add --photograph FILE"
            )
        if exif is None:
            raise InputError(
                f"{file}: expected EXIF data with the focal length for a 35 mm film, "
                "got none; give --focal in pixels"
            )
        return exif
    try:
        focal = float(asked)
    except ValueError:
        focal = -1.0
    if not (math.isfinite(focal) and focal > 0):
        raise InputError(f"--focal: expected pixels above 0, or exif, got {asked}")
    if size and focal < _WIDEST * max(size):
        angle = 2 * math.degrees(math.atan(max(size) / (2 * focal)))
        raise InputError(
            f"--focal {asked}: expected pixels, got a lens that sees {angle:.0f} "
            f"degrees on {max(size)} pixels; of millimetres, as for a 35 mm film, "
            f"pixels are mm / 36 * {max(size)}; or give exif"
        )
    return focal


def photograph_colors(
    pixels: np.ndarray, transfer: Transfer, to_srgb: np.ndarray | None = None
) -> np.ndarray:
    """A photograph as colours of a mesh: `[H, W, 3]`, uint8, sRGB."""
    linear = as_linear(pixels, transfer)
    if linear.shape[2] == 3:
        linear = in_srgb(linear, to_srgb)
    # Linear ones are scaled so that their brightest half a percent is white.
    if transfer == "linear":
        linear = linear / max(float(np.quantile(linear, 0.995)), 1e-12)
    encoded = np.round(255 * srgb_encode(linear)).astype(np.uint8)
    return np.broadcast_to(encoded, (*pixels.shape[:2], 3))


def mean_colors(
    images: np.ndarray, transfer: Transfer, to_srgb: np.ndarray | None = None
) -> np.ndarray:
    """`photograph_colors` of the photographs' mean."""
    mean = np.zeros(images.shape[1:], np.float32)
    for image in images:
        mean += as_float(image) / len(images)
    return photograph_colors(mean, transfer, to_srgb)


def print_surface(facts: dict[str, Any]) -> None:
    """Prints what `write_surface` returned."""
    reach = facts["far"] - facts["near"]
    print_line(
        "depth",
        f"{facts['camera']}, {facts['islands']} connected parts, from nearest to "
        f"farthest {reach:.4g} {facts['unit']}",
    )


@dataclasses.dataclass(frozen=True)
class SurfaceOptions:
    """How normals become a surface, and which files it becomes."""

    focal: float | None = None  # in pixels; None for an orthographic camera
    prior_weight: float = 1e-4  # see `integrate_image`
    sharpness: float = 2.0  # see `integrate_image`
    # what one unit of `integrate_image`'s depth is in the files' unit: of a pixel's
    # side (orthographic), of each island's mean distance (perspective), of the prior's
    # unit (perspective with a prior)
    scale: float = 1.0
    unit: str | None = None  # of the files; by default what scale 1 means, in words
    mesh: MeshFormat | None = None  # format, if there is to be one
    max_faces: int | None = None  # see `write_mesh`
    cut: float = CUT  # see `mesh_of_depth`


def write_surface(
    folder: Path,
    normals: np.ndarray,
    mask: np.ndarray | None = None,
    options: SurfaceOptions = SurfaceOptions(),
    *,
    prior: np.ndarray | None = None,
    colors: np.ndarray | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Integrates normals and writes depth, height and, on request, a mesh.

    Mask and prior are as for `integrate_image`; `colors [H, W, 3]`, uint8,
    sRGB, are the mesh's. Returns for the record camera, islands, rounds, unit and
    scale, the meaning of levels. `InputError` if no pixel has a normal, or the mesh
    cannot be written.
    """
    from unips_jax.surface.images import integrate_image

    if prior is not None:
        _check_prior(prior, normals, mask, options.focal)
    found = integrate_image(
        normals,
        mask,
        focal=options.focal,
        prior=prior,
        prior_weight=options.prior_weight,
        sharpness=options.sharpness,
        progress=progress,
    )
    if not found.islands:
        raise InputError(
            "expected normals inside the mask, got none; give normals that are not 0 "
            "there, or another mask"
        )
    unit = options.unit
    if unit is None:
        own = "prior's units" if prior is not None else "mean distances"
        unit = "pixels" if options.focal is None else own
    depth = found.depth * np.float32(options.scale)
    facts: dict[str, Any] = {
        "camera": "orthographic" if options.focal is None else "perspective",
        "focal_px": options.focal,
        "islands": found.islands,
        "rounds": found.rounds,
        "last_change_px": found.last_change_px,
        "scale": options.scale,
        **write_depth(folder, depth, unit=unit),
    }
    if options.mesh is not None:
        shape = mesh_of_depth(
            depth, focal=options.focal, pixel_size=options.scale, cut=options.cut
        )
        facts["faces"] = write_mesh(
            folder / f"mesh.{options.mesh}",
            shape,
            colors=colors,
            max_faces=options.max_faces,
            unit=unit,
        )
    return facts


def _check_prior(
    prior: np.ndarray, normals: np.ndarray, mask: np.ndarray | None, focal: float | None
) -> None:
    """Raises InputError if no pixel with a normal has a known depth."""
    inside = (normals != 0).any(-1) & (True if mask is None else mask > 0)
    known = np.isfinite(prior) & ((focal is None) | (prior > 0))
    if inside.any() and not (inside & known).any():
        above = "" if focal is None else " above 0"
        raise InputError(
            f"--prior: expected a depth{above} at some pixel with a normal, got none; "
            "depth grows away from the viewer (z towards the viewer is its negative)"
        )
