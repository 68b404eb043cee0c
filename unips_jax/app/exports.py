"""A result's files for a purpose, made when its visitor asks for them."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.app.work import Chosen
from unips_jax.app.worker import Report
from unips_jax.errors import InputError
from unips_jax.io.color import as_float
from unips_jax.io.door import write_whole, writing
from unips_jax.io.images import image_header, read_bytes, read_image_file
from unips_jax.io.orientation import read_as_estimated

SUFFIXES = {"blender": ".glb", "print": ".stl", "archive": ".zip"}
"""Of each purpose's file."""
_MOST_MM = 1e6


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What a visitor asks for."""

    purpose: str  # of `SUFFIXES`
    directx: bool = False  # green is down in the model's normal map
    longest_mm: float | None = None  # the object's longest side, if known


def wanted(asked: dict[str, Any]) -> Wanted:
    """What JSON asks for; `ValueError` if there is no such thing."""
    longest = asked.get("longest_mm")
    if asked.get("purpose") not in SUFFIXES:
        raise ValueError("no such purpose")
    if longest is not None:
        longest = float(longest)
        if not (math.isfinite(longest) and 0 < longest <= _MOST_MM):
            raise ValueError("no length")
    return Wanted(asked["purpose"], asked.get("directx") is True, longest)


def export(
    chosen: Chosen,
    results: Path,
    place: Path,
    name: str,
    wanted: Wanted,
    max_pixels: int,
    *,
    report: Report,
) -> dict[str, Any]:
    """Writes a file for a purpose, in place of an earlier one.

    The model has the photographs' mean colours where the results have no base colour.
    Returns "file", its name, and what is known of its size. `InputError` if results are
    gone or changed, or give no surface.
    """
    from unips_jax.io.normal_maps import read_normal_map
    from unips_jax.io.record_schema import load_record
    from unips_jax.io.results import RECORD, normal_map_of, results_of
    from unips_jax.surface.archive import archive
    from unips_jax.surface.depth_files import read_depth
    from unips_jax.surface.exports import Scale, blender_model, printable

    report("exporting", 0.0)
    with writing(place):
        place.mkdir(exist_ok=True)
    file = place / f"{name}{SUFFIXES[wanted.purpose]}"
    facts: dict[str, Any] = {}
    if not (results / RECORD).is_file():
        raise InputError(f"{results}: expected results, found none there any more")
    if wanted.purpose == "archive":
        made = [f for f in place.glob(f"{name}.*") if f.suffix in (".glb", ".stl")]
        files = [*results_of(results), *sorted(made)]
        data = archive(name, files, normal_map_of(results))
    else:
        record = load_record(results / RECORD)
        surface = record.get("surface")
        if not surface:
            raise InputError(f"{results}: expected a surface, got normals alone")
        scale = Scale(surface["focal_px"], surface["scale"], surface["unit"])
        depth, longest = read_depth(results / "depth.exr"), wanted.longest_mm
        if wanted.purpose == "print":
            data, facts = printable(depth, scale, longest_mm=longest)
        else:
            normals = read_normal_map(results, as_stored=True).normals
            data, facts = blender_model(
                depth,
                normals,
                scale,
                name=name,
                colors=_colors(chosen, results, record, normals.shape, max_pixels),
                directx=wanted.directx,
                longest_mm=longest,
            )
    write_whole(file, data)
    return {"file": file.name, "bytes": len(data), **facts}


def _colors(
    chosen: Chosen,
    results: Path,
    record: dict[str, Any],
    shape: tuple[int, ...],
    max_pixels: int,
) -> np.ndarray | None:
    """The results' base colour, else the photographs' mean: `[H, W, 3]`, uint8.

    None of photographs that were moved back: as files they lie beside each other.
    """
    from unips_jax.surface.outputs import photograph_colors

    base_color = results / "base_color.png"
    if base_color.is_file():
        colors = photograph_colors(read_image_file(base_color).pixels, "srgb")
    elif record.get("moved_back"):
        return None
    else:
        mean = np.zeros(shape, np.float32)
        for photograph in chosen.photographs:
            path = chosen.folder / photograph
            pixels = read_as_estimated(path, record, max_pixels=max_pixels)
            _require(pixels.shape[:2] == shape[:2], results)
            mean += as_float(pixels) / len(chosen.photographs)
        first = chosen.folder / chosen.photographs[0]  # whose colours hold
        data = read_bytes(first, max_pixels=max_pixels)
        encoding = image_header(data, first, max_pixels=max_pixels).encoding
        transfer = record.get("transfer", "srgb")
        colors = photograph_colors(mean, transfer, encoding.to_srgb)
    _require(colors.shape == shape, results)
    return colors


def _require(same: bool, results: Path) -> None:
    if not same:
        raise InputError(
            f"{results}: expected colours of the normals' size, got another; they are "
            "not as they were estimated"
        )
