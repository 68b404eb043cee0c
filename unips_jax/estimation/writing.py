"""A folder's results on disk: normals, sheet, record, and what else is wanted."""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.estimation.extras import Extras, write_extras
from unips_jax.estimation.options import FolderOptions
from unips_jax.io.color import Transfer
from unips_jax.io.images import read_image_file, write_image
from unips_jax.io.normals import write_normals
from unips_jax.io.record import print_line, summary
from unips_jax.io.results import appearing_at_once, write_record
from unips_jax.pictures.estimate_sheet import write_sheet
from unips_jax.surface import outputs
from unips_jax.surface.depth_files import read_depth
from unips_jax.surface.mesh import NoTriangle


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Normals, what they were estimated from, and how."""

    images: np.ndarray  # `[N, H, W, 3]`, as the network was given them
    mask: np.ndarray  # `[H, W]`, bool
    transfer: Transfer  # how the images encode light
    # `[H, W, 3]`, float32, unit length inside the mask, zero outside
    normals: np.ndarray
    record: dict[str, Any]  # the content of `normals.json`, less the files' hashes
    # in pixels, if there is a depth to write and its camera is not orthographic
    focal: float | None = None
    extras: Extras = Extras()  # lights and confidence, where they are wanted
    to_srgb: np.ndarray | None = None  # see `Encoding`


def write_estimate(
    target: Path,
    estimate: Estimate,
    options: FolderOptions,
    *,
    truth: np.ndarray | None = None,
    facts: dict[str, Any] | None = None,
    more: Callable[[Path], None] | None = None,
    verbose: bool = False,
) -> dict[str, Any]:
    """Writes normals, their sheet and their record; all files appear, or none.

    With the true normals `[H, W, 3]` the sheet shows the errors; `facts` go into the
    record, and `more` writes further files into the folder that it is given. Returns
    what `normals.json` holds, less the files' hashes.
    """
    record = {**estimate.record, **(facts or {})}
    with appearing_at_once(target) as place:
        write_normals(
            place,
            estimate.normals,
            exr=options.exr,
            mat=options.mat,
            normal_map=options.normal_map,
        )
        write_sheet(
            place / "sheet.png",
            estimate.images,
            estimate.normals,
            estimate.mask,
            title=target.name,
            subtitle=summary(record),
            encoded=estimate.transfer == "srgb",
            truth=truth,
        )
        if record["mask_suggested"]:
            write_image(place / "mask.png", estimate.mask.astype(np.uint8) * 255)
        record |= write_extras(place, estimate, options)
        if options.depth or options.mesh:
            record["surface"] = _write_surface(
                place, estimate, options, record["warnings"], verbose
            )
        if options.view:
            _write_view(place, target, estimate, record)
        if more is not None:
            more(place)
        names = write_record(place, record)
    if verbose:
        print_line("wrote", f"{target}/: {', '.join(names)}")
    return record


def _write_surface(
    place: Path,
    estimate: Estimate,
    options: FolderOptions,
    warnings: list[str],
    verbose: bool,
) -> dict[str, Any]:
    colors = None
    if options.mesh and options.base_color:
        base_color = read_image_file(place / "base_color.png").pixels
        colors = outputs.photograph_colors(base_color, "srgb")
    elif options.mesh:
        colors = outputs.mean_colors(
            estimate.images, estimate.transfer, estimate.to_srgb
        )
    how = outputs.SurfaceOptions(focal=estimate.focal, mesh=options.mesh)
    shape = estimate.normals, estimate.mask
    try:
        facts = outputs.write_surface(place, *shape, how, colors=colors)
    except NoTriangle as error:  # of a wire: all else is there
        warnings.append(f"no mesh: {error}")
        if verbose:
            print(f"warning: {warnings[-1]}", file=sys.stderr)
        how = dataclasses.replace(how, mesh=None)
        facts = outputs.write_surface(place, *shape, how)
    if verbose:
        outputs.print_surface(facts)
    return facts


def _write_view(
    place: Path, target: Path, estimate: Estimate, record: dict[str, Any]
) -> None:
    """Writes `view.html`, with an earlier one's notes; its depth is the files'."""
    from unips_jax.viewer.page import with_depth, write_view
    from unips_jax.viewer.result import Result, maps_of, photographs_of

    surface = record.get("surface") or {}
    names = tuple(record["images"])
    result = Result(
        target.name,
        estimate.normals,
        photographs_of(estimate.images, names, estimate.transfer, estimate.to_srgb),
        read_depth(place / "depth.exr") if surface else None,
        unit=surface.get("unit", "pixels"),
        focal=surface.get("focal_px"),
        record=record,
        **maps_of(place, estimate.mask.shape),
    )
    name = "view.html"
    write_view(place / name, with_depth(result), earlier=target / name)
