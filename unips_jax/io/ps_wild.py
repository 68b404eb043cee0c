"""PS-Wild's layout on disk: written whole or not at all, and read object by object.

A folder `X.data/` holds linear photographs, `0*` for training or `L*` for tests,
`normal.tif`, 16 bit, see `io.normals`, and what is ours: `mask.png` and `meta.json`.
The object is where | 1 - |n| | < 1e-3, and within the mask if there is one. Photographs
that certainly have a display's curve, by their format or a tag, are refused.
`baseColor.tif`, `roughness.tif`, `metal.tif` and `depth.exr`, where they are there, are
never read.

`meta.json` may hold `seed`, `size`, `light`, `shape`, `material`, `category`; `focal`,
the focal length in pixels; `focal_mm`, the same for a frame of 36 mm, null for an
orthographic camera; and, per image, `light_directions` and `light_intensities`, such
that a Lambertian surface appears as albedo x intensity x max(n . l, 0).

Plain NumPy.
"""

import glob
import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import as_float
from unips_jax.io.door import write_json
from unips_jax.io.images import (
    read_image_file,
    require_finite,
    write_exr,
    write_image,
)
from unips_jax.io.masks import read_mask
from unips_jax.io.naming import in_order
from unips_jax.io.normals import encode_normals, read_normals, true_pixels
from unips_jax.io.results import UNSEEN, appearing_at_once
from unips_jax.io.selection import is_photograph

META, NORMALS, MASK = "meta.json", "normal.tif", "mask.png"
# What objects consist of whose `meta.json` lists no files.
_EARLIER = (
    "L_[0-9]*.png [0-9]*.tif baseColor.tif roughness.tif metal.tif depth.exr".split()
)
_FOR_DISPLAYS = ("JPEG", "HEIC", "AVIF")  # values are never linear
FRAME_MM = 36.0  # the frame's side that focal lengths in mm refer to


def photographs_of(folder: Path, prefixes: str) -> list[Path]:
    """An object's photographs: names that begin with one of the letters, in order."""
    return [
        path
        for path in in_order(folder)
        if path.name[0].lower() in prefixes.lower() and is_photograph(path)
    ]


def focal_facts(focal_mm: float | None, size: int) -> dict[str, float | None]:
    """What `meta.json` holds of the camera; `focal_mm` None or 0: orthographic."""
    if not focal_mm:
        return {"focal_mm": None}
    return {"focal_mm": focal_mm, "focal": focal_mm / FRAME_MM * size}


def read_meta(folder: Path) -> dict[str, Any]:
    """An object's `meta.json`; empty where there is none."""
    path = folder / META
    if not path.is_file():
        return {}
    try:
        meta = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: expected JSON that can be read ({error}); mend or remove it"
        ) from error
    if not isinstance(meta, dict):
        raise InputError(
            f"{path}: expected a JSON object, got {type(meta).__name__}; mend or "
            "remove it"
        )
    return meta


def meta_focal(meta: Mapping[str, Any], path: Path) -> float | None:
    """The focal length in pixels; infinite if orthographic, None where unknown."""
    focal = meta.get("focal")
    if focal is None:
        return math.inf if meta.get("focal_mm", 0) is None else None
    if not (isinstance(focal, (int, float)) and focal > 0):
        raise InputError(
            f"{path}: focal: expected a length in pixels, got {focal!r:.40}; mend or "
            "remove it"
        )
    return focal


def meta_lights(
    meta: Mapping[str, Any], path: Path
) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Directions `[N, 3]` and intensities `[N, 3]`, these None where all are 1."""
    directions, intensities = (
        _vectors(meta, key, path) for key in ("light_directions", "light_intensities")
    )
    return None if directions is None else (directions, intensities)


def _vectors(meta: Mapping[str, Any], key: str, path: Path) -> np.ndarray | None:
    if meta.get(key) is None:
        return None
    try:
        array = np.array(meta[key], np.float64)
    except (ValueError, TypeError):
        array = np.empty(0)
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise InputError(f"{path}: expected three finite numbers per image in {key}")
    return array


def encode_linear(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1], clipped, as 16-bit integers."""
    return np.rint(np.clip(values, 0, 1) * 65535).astype(np.uint16)


def write_folder(
    folder: str | os.PathLike[str],
    images: Iterable[np.ndarray],
    mask: np.ndarray,
    normals: np.ndarray,
    facts: Mapping[str, Any],
    *,
    maps: Mapping[str, np.ndarray] | None = None,
    depth: np.ndarray | None = None,
    name: str = "L_{:02d}.png",
) -> None:
    """Writes one object; the folder appears only when it is complete.

    An object that was written there before is replaced; other files in it stay. The
    photographs it is made from belong elsewhere.

    Args:
        folder: `X.data`.
        images: `[H, W, 3]` each, linear floats; 1 becomes 65535, more is burnt out.
        mask: `[H, W]`, bool, or numbers that are 0 outside the object.
        normals: `[H, W, 3]`, unit inside the mask.
        facts: for `meta.json`, numbers and arrays too.
        maps: of the material in [0, 1], `[H, W]` or `[H, W, 3]`, kept as 16-bit TIFF
            under their names.
        depth: `[H, W]`, kept as `depth.exr`; 0 outside the mask.
        name: of the images' files, by number.

    Raises:
        InputError: if the folder holds files, but no `meta.json` of this function: it
            is somebody's own.
        ValueError: if images are integers, or most of the object is burnt out.
    """
    folder, mask = Path(folder), np.asarray(mask).astype(bool)
    own = folder.is_dir() and {path.name for path in folder.iterdir()} - UNSEEN
    meta = read_meta(folder)
    if own and not {"files", "light"} & meta.keys():
        raise InputError(
            f"{folder}: expected a new folder, or one that was written here before "
            f"({META}), got one with other files, such as {min(own)}; choose another"
        )
    plain = json.loads(json.dumps(dict(facts), default=_plain))
    earlier = () if "files" in meta else _EARLIER
    with appearing_at_once(folder, record=META, ours=earlier) as place:
        _write_files(place, images, mask, normals, name)
        for title, values in (maps or {}).items():
            write_image(place / f"{title}.tif", encode_linear(values))
        if depth is not None:
            write_exr(place / "depth.exr", {"Z": np.where(mask, depth, 0)})
        files = sorted(path.name for path in place.iterdir())
        write_json(place / META, {**plain, "files": files}, indent=1)


def _plain(value: Any) -> Any:
    """Numbers and arrays of NumPy as JSON has them."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"facts: expected values that JSON holds, got {type(value)}")


def _write_files(
    folder: Path,
    images: Iterable[np.ndarray],
    mask: np.ndarray,
    normals: np.ndarray,
    name: str,
) -> None:
    for index, image in enumerate(images):
        _require_linear(np.asarray(image), mask)
        write_image(folder / name.format(index), encode_linear(image))
    write_image(folder / MASK, mask.astype(np.uint8) * 255)
    inside = np.where(mask[..., None], normals, 0)
    write_image(folder / NORMALS, encode_normals(inside))


def _require_linear(image: np.ndarray, mask: np.ndarray) -> None:
    if image.dtype.kind != "f":
        raise ValueError(
            f"images: expected linear floats in [0, 1], got {image.dtype}; "
            "unips_jax.io.color.as_linear makes them of photographs"
        )
    if mask.any() and np.median(image[mask]) > 1:
        raise ValueError(
            "images: expected linear floats in [0, 1], got values up to "
            f"{image[mask].max():g}; divide all photographs by their largest"
        )


class TrainingObject(NamedTuple):
    """Where an object's files are: photographs, sorted by name, and true normals."""

    photographs: tuple[Path, ...]
    normals: Path


class PSWildFolders:
    """All objects below a root; a random-access source for grain."""

    def __init__(self, root: str | os.PathLike[str], *, min_images: int) -> None:
        """Finds `X.data` folders in `root`, or in its folders of lightings."""
        root = Path(root)
        below = glob.glob("**/*.data", root_dir=root, recursive=True)  # through links
        folders = sorted(path for name in below if (path := root / name).is_dir())
        if not folders:
            raise InputError(
                f"{root}: expected folders X.data with photographs 0* or L* and "
                "normal.tif, found none; `unips render` makes some"
            )
        self._objects = [_find_files(folder, min_images) for folder in folders]

    def __len__(self) -> int:
        """Number of objects."""
        return len(self._objects)

    def __getitem__(self, index: int) -> TrainingObject:
        """Where object number `index` is."""
        return self._objects[index]


def _find_files(folder: Path, min_images: int) -> TrainingObject:
    normals = folder / NORMALS
    if not normals.is_file():
        raise InputError(f"{normals}: expected the object's true normals, found none")
    photographs = tuple(photographs_of(folder, "0L"))
    if not photographs:
        raise InputError(
            f"{folder}: expected photographs named 0* or L*, such as L_00.png, found "
            "none; rename them, or write the folder by unips_jax.training.write_folder"
        )
    if len(photographs) < min_images:
        raise InputError(
            f"{folder}: expected at least {min_images} photographs 0* or L*, found "
            f"{len(photographs)}; lower the largest of --data.num-images"
        )
    return TrainingObject(photographs, normals)


def read_object(
    files: TrainingObject, chosen: np.ndarray, size: int
) -> dict[str, np.ndarray]:
    """Reads some of an object's photographs, averaged down to a square size.

    Zeros below or to the right make squares of those that are none.

    Returns:
        `images [N, size, size, 3]`, float32 linear light, zero outside the mask; `mask
            [size, size]`, bool; `normals [size, size, 3]`, unit length inside.
    """
    normals = read_normals(files.normals)
    mask = true_pixels(normals)
    given = files.normals.with_name(MASK)
    if given.is_file():
        inside = read_mask(given)
        if inside.shape != mask.shape:
            raise InputError(
                f"{given}: expected {mask.shape} pixels as in {NORMALS}, got "
                f"{inside.shape}"
            )
        mask &= inside
    if not mask.any():
        raise InputError(
            f"{files.normals}: expected unit normals (inside {MASK}, if there is one), "
            "found no pixel"
        )
    share = _resize(mask.astype(np.float32), size)
    small_mask = share > 0.5
    small = _resize(normals * mask[..., None], size) * small_mask[..., None]
    length = np.linalg.norm(small, axis=-1, keepdims=True)
    images = np.zeros((len(chosen), size, size, 3), np.float32)
    for i, index in enumerate(chosen):
        path = files.photographs[index]
        image = _read(path)
        if image.shape != normals.shape:
            raise InputError(
                f"{path}: expected {normals.shape[:2]} pixels as in "
                f"{files.normals.name}, got {image.shape[:2]}"
            )
        image = _resize(image * mask[..., None], size)
        images[i] = image / np.maximum(share, 0.5)[..., None] * small_mask[..., None]
    return {
        "images": images,
        "mask": small_mask,
        "normals": (small / np.maximum(length, 1e-6)).astype(np.float32),
    }


def _read(path: Path) -> np.ndarray:
    """A photograph `[H, W, 3]`, float32; integers become [0, 1]."""
    file = read_image_file(path)
    require_finite(path, file.pixels)
    encoding = file.encoding
    tagged = encoding.transfer == "srgb" and encoding.rule != "8-bit values"
    if tagged or file.header.format in _FOR_DISPLAYS:
        raise InputError(
            f"{path}: expected linear values, as in untagged PNG or TIFF files of 16 "
            f"bits, got sRGB ({file.header.format}, {encoding.rule}); "
            "unips_jax.training.write_folder writes linear ones"
        )
    image = np.maximum(as_float(file.pixels), 0)
    return np.broadcast_to(image, (*image.shape[:2], 3))


def _resize(image: np.ndarray, size: int) -> np.ndarray:
    """Makes a square, with zeros, and averages it down, or interpolates it up."""
    height, width = image.shape[:2]
    if height == width == size:
        return image
    side = max(height, width)
    bottom, right = side - height, side - width
    image = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_CONSTANT)
    method = cv2.INTER_AREA if side >= size else cv2.INTER_LINEAR
    return cv2.resize(image, (size, size), interpolation=method)
