"""What the viewer shows: a result in memory, or read from a folder of results."""

import dataclasses
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, as_linear, in_srgb
from unips_jax.io.images import (
    image_header,
    linear_of,
    read_bytes,
    read_image_file,
    require_size,
)
from unips_jax.io.normal_maps import read_normal_map
from unips_jax.io.orientation import read_as_estimated
from unips_jax.io.results import require_results, whole_record
from unips_jax.surface.depth_files import read_depth


@dataclasses.dataclass(frozen=True)
class Photograph:
    """One of the photographs."""

    name: str
    read: Callable[[], np.ndarray]  # [H, W, 3], linear, float32
    bright: bool = False  # to be exposed anew: linear files are of any scale


@dataclasses.dataclass(frozen=True)
class Result:
    """Normals and what belongs to them, all of one size."""

    title: str  # the object's name
    normals: np.ndarray  # [H, W, 3], float32, unit length or 0
    photographs: tuple[Photograph, ...] = ()
    # [H, W], float32, away from the viewer, NaN where none
    depth: np.ndarray | None = None
    unit: str = "pixels"
    pixel_size: float = 1.0  # in the unit (orthographic)
    focal: float | None = None  # in pixels; None: orthographic
    pixel_mm: float | None = None  # at the mean distance, if known
    base_color: np.ndarray | None = None  # [H, W, 3], linear, float32, in [0, 1]
    spread: np.ndarray | None = None  # of the normals, [H, W], float32, degrees
    # the content of `normals.json`
    record: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def inside(self) -> np.ndarray:
        """Where there is a normal: `[H, W]`, bool."""
        return (self.normals != 0).any(axis=-1)


def photographs_of(
    images: np.ndarray,
    names: tuple[str, ...],
    transfer: Transfer,
    to_srgb: np.ndarray | None = None,
) -> tuple[Photograph, ...]:
    """Photographs `[N, H, W, 3]` that are in memory, uint8, uint16 or float32."""

    def read(image: np.ndarray) -> np.ndarray:
        return in_srgb(as_linear(image, transfer), to_srgb)

    return tuple(
        Photograph(
            name,
            functools.partial(read, image),
            bright=transfer == "linear",
        )
        for name, image in zip(names, images, strict=True)
    )


def read_result(folder: Path, photographs: Path | None = None) -> Result:
    """Reads a folder of results; photographs are shown if they are as they were."""
    if folder.is_dir():
        require_results(folder)
    record = whole_record(folder)
    normals = read_normal_map(folder).normals
    size = normals.shape[:2]
    surface = record.get("surface") or {}
    depth = None
    if (folder / "depth.exr").is_file() and surface:
        depth = _of_size(folder / "depth.exr", read_depth(folder / "depth.exr"), size)
    return Result(
        folder.resolve().name,
        normals,
        _photographs(record, photographs, size),
        depth,
        unit=surface.get("unit", "pixels"),
        pixel_size=surface.get("scale", 1.0),
        focal=surface.get("focal_px"),
        record=record,
        **maps_of(folder, size),
    )


def maps_of(folder: Path, size: tuple[int, ...]) -> dict[str, Any]:
    """Base colour and spread of a folder of results: fields of `Result`."""
    maps = {}
    color, spread = folder / "base_color.png", folder / "confidence.exr"
    if color.is_file():
        # Always sRGB, also where earlier versions left 16 bits without a tag.
        linear = linear_of(read_image_file(color), "srgb")
        maps["base_color"] = _of_size(color, linear, size)
    if spread.is_file():
        values = read_image_file(spread).pixels[..., 0]
        maps["spread"] = _of_size(spread, values, size)
    return maps


def _photographs(
    record: dict[str, Any], folder: Path | None, size: tuple[int, ...]
) -> tuple[Photograph, ...]:
    """Those of the record that are there, unchanged and of the normals' size."""
    there = folder or ("folder" in record and Path(record["folder"]))
    if not there or "transfer" not in record:
        return ()
    found: list[Photograph] = []
    to_srgb = None
    for name, digest in record.get("images", {}).items():
        path = there / name
        try:
            data = read_bytes(path)
            if hashlib.sha256(data).hexdigest() != digest:
                raise InputError(
                    f"{path}: expected the photograph that the normals are from, got "
                    "another; give --photographs, the folder of those"
                )
            if not found:  # the first, whose colours hold
                to_srgb = image_header(data, path).encoding.to_srgb
        except InputError:
            if folder is not None:
                raise
            return ()
        found.append(
            Photograph(
                name,
                functools.partial(_photograph, path, record, size, to_srgb),
                bright=record["transfer"] == "linear",
            )
        )
    if record.get("options", {}).get("reader") == "official" or record.get(
        "moved_back"
    ):
        return ()  # as files they do not lie on the normals
    return tuple(found)


def _photograph(
    path: Path,
    record: dict[str, Any],
    size: tuple[int, ...],
    to_srgb: np.ndarray | None,
) -> np.ndarray:
    linear = as_linear(read_as_estimated(path, record), record["transfer"])
    linear = np.broadcast_to(_of_size(path, linear, size), (*size, 3))
    return in_srgb(linear, to_srgb)


def _of_size(path: Path, values: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    require_size(path, values.shape[:2], size, "estimate anew")
    return values
