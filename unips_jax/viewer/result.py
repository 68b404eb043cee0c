"""What the viewer shows: a result in memory, or read from a folder of results."""

import dataclasses
import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, as_linear
from unips_jax.io.images import read_bytes, read_image_file
from unips_jax.io.normal_maps import read_normal_map
from unips_jax.io.results import whole_record
from unips_jax.surface.depth_files import read_depth


@dataclasses.dataclass(frozen=True)
class Photograph:
    """One of the photographs.

    Attributes:
        name: of its file.
        read: gives its pixels, `[H, W, 3]`, linear, float32.
        bright: whether it is to be exposed anew: linear files are of any scale.
    """

    name: str
    read: Callable[[], np.ndarray]
    bright: bool = False


@dataclasses.dataclass(frozen=True)
class Result:
    """Normals and what belongs to them, all of one size.

    Attributes:
        title: the object's name.
        normals: `[H, W, 3]`, float32, unit length or 0.
        photographs: in their order; may be empty.
        depth: `[H, W]`, float32, away from the viewer, NaN where there is none.
        unit: of the depth.
        pixel_size: side of a pixel in that unit (orthographic).
        focal: of the depth's camera, in pixels; None: orthographic.
        pixel_mm: side of a pixel in millimetres, at the mean distance; None: not known.
        base_color: `[H, W, 3]`, linear, float32, in [0, 1].
        expected_error: `[H, W]`, float32, degrees.
        record: the content of `normals.json`.
    """

    title: str
    normals: np.ndarray
    photographs: tuple[Photograph, ...] = ()
    depth: np.ndarray | None = None
    unit: str = "pixels"
    pixel_size: float = 1.0
    focal: float | None = None
    pixel_mm: float | None = None
    base_color: np.ndarray | None = None
    expected_error: np.ndarray | None = None
    record: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def inside(self) -> np.ndarray:
        """Where there is a normal: `[H, W]`, bool."""
        return (self.normals != 0).any(axis=-1)


def photographs_of(
    images: np.ndarray, names: tuple[str, ...], transfer: Transfer
) -> tuple[Photograph, ...]:
    """Photographs `[N, H, W, 3]` that are in memory, uint8, uint16 or float32."""
    return tuple(
        Photograph(
            name,
            functools.partial(as_linear, image, transfer),
            bright=transfer == "linear",
        )
        for name, image in zip(names, images, strict=True)
    )


def read_result(folder: Path, photographs: Path | None = None) -> Result:
    """Reads a folder that `unips estimate` wrote.

    Photographs are shown if they are still where they were, unchanged.

    Args:
        folder: the results.
        photographs: where the photographs are now, if not where they were.

    Raises:
        InputError: if it is no such folder, its files were changed, or a photograph is
            not the one that it was, in the folder given.
    """
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
    """Base colour and expected error of a folder of results: fields of `Result`.

    Raises:
        InputError: if a file cannot be read, or has another size than the normals.
    """
    maps = {}
    color, error = folder / "base_color.png", folder / "confidence.exr"
    if color.is_file():
        maps["base_color"] = _of_size(color, _linear(color), size)
    if error.is_file():
        values = read_image_file(error).pixels[..., 0]
        maps["expected_error"] = _of_size(error, values, size)
    return maps


def _photographs(
    record: dict[str, Any], folder: Path | None, size: tuple[int, ...]
) -> tuple[Photograph, ...]:
    """Those of the record that are there, unchanged and of the normals' size."""
    there = folder or ("folder" in record and Path(record["folder"]))
    if not there or "transfer" not in record:
        return ()
    found = []
    for name, digest in record.get("images", {}).items():
        path = there / name
        try:
            data = read_bytes(path)
            if hashlib.sha256(data).hexdigest() != digest:
                raise InputError(
                    f"{path}: expected the photograph that the normals are from, got "
                    "another; give --photographs, the folder of those"
                )
        except InputError:
            if folder is not None:
                raise
            return ()
        found.append(
            Photograph(
                name,
                functools.partial(_photograph, path, record["transfer"], size),
                bright=record["transfer"] == "linear",
            )
        )
    if record.get("options", {}).get("reader") == "official" or record.get(
        "moved_back"
    ):
        return ()  # as files they do not lie on the normals
    return tuple(found)


def _photograph(path: Path, transfer: Transfer, size: tuple[int, ...]) -> np.ndarray:
    file = read_image_file(path)
    pixels = file.pixels
    if file.encoding.table is not None:
        pixels = file.encoding.table[pixels]
    linear = as_linear(pixels, transfer)
    return np.broadcast_to(_of_size(path, linear, size), (*size, 3))


def _linear(path: Path) -> np.ndarray:
    file = read_image_file(path)
    linear = as_linear(file.pixels, file.encoding.transfer)
    return np.broadcast_to(linear, (*linear.shape[:2], 3))


def _of_size(path: Path, values: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    if values.shape[:2] != tuple(size):
        raise InputError(
            f"{path}: expected the normals' size, {size[1]} x {size[0]}, got "
            f"{values.shape[1]} x {values.shape[0]}; estimate anew"
        )
    return values
