"""Normals that another program made, from a folder: `files:DIR,option=value,...`.

An object's normals are looked for as `DIR/NAME.*`, in `DIR/NAME/`, `DIR/NAME.data/` and
`DIR/NAMEPNG/` (a file with `normal` or `nml` in its name), NAME being the object's in
the tables, with `_` in place of `/`; or where `file=` puts it, as in
`file=results/{object}.data/normal.png`. Where a run has several subsets of images, DIR
holds a folder for each, named as in `OUT/inputs`: `8-seed-0`, `all`.

They are `.npy` or `.mat` arrays `[H, W, 3]`, float EXR or TIFF images, all holding n,
or PNG or TIFF images of integers holding (n + 1) / 2: x right, y up, z towards the
viewer, unit length. `x=left`, `y=down`, `z=away` and `channels=bgr` state what is
otherwise. Their size is that of the photographs, or what the protocol showed; where
both are one, the background shows which is meant. What their values stand for is
examined on the object, and mended where it is certain (`io.normal_values`);
`values=stored` leaves them as they are.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np

from unips_jax.baselines.method import Observed, Unsupported
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.variants import (
    Variant,
    built,
    bytes_hash,
    described,
    label_of,
    parse_options,
    take_oracle,
)
from unips_jax.io.color import as_linear
from unips_jax.io.images import read_image_file
from unips_jax.io.normal_values import OVERRULE, decode_values
from unips_jax.io.normals import decode_normals, require_three_channels
from unips_jax.provenance import code_hash

# Those that lose least come first.
_SUFFIXES = (".npy", ".mat", ".exr", ".tif", ".tiff", ".png")
_WORDS = ("normal", "nml")
_NO_NORMALS = ("gt", "error", "mask")
_LENGTHS = (0.9, 1.1)


@dataclasses.dataclass(frozen=True)
class Subset:
    """Which images a result is of."""

    count: int | None  # None for all
    seed: int | None  # of the draw; None where all are used
    alone: bool  # whether the run has no other subset

    @property
    def folder(self) -> str:
        """Its folder's name."""
        return "all" if self.seed is None else f"{self.count}-seed-{self.seed}"


@dataclasses.dataclass(frozen=True)
class NormalFiles:
    """A folder of normals."""

    folder: Path
    signs: tuple[int, int, int] = (1, 1, 1)  # of x, y and z, by which they become ours
    order: tuple[int, int, int] = (0, 1, 2)  # of the channels
    # where an object's file is in the folder, with `{object}`; empty: see the module
    file: str = ""
    as_stored: bool = False  # whether values are believed

    def find(self, name: str, subset: Subset) -> Path | None:
        """An object's file; None where there is none. Several are an `InputError`."""
        bases = [self.folder / subset.folder, *([self.folder] if subset.alone else [])]
        for base in bases:
            if self.file:
                path = base / self.file.replace("{object}", name.replace("/", "_"))
                if path.is_file():
                    return path
                continue
            for spelled in dict.fromkeys([name, name.replace("/", "_")]):
                found = _best(base / spelled, _named(base, spelled))
                if found is not None:
                    return found
        return None

    def hash_of(self, name: str, subset: Subset) -> str:
        """A hash of an object's file; empty where there is none."""
        path = self.find(name, subset)
        return "" if path is None else bytes_hash(files.read_bytes(path))

    def read(
        self, path: Path, masks: list[np.ndarray], mended: list[str] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals `[H, W, 3]` of a file, in our convention, and their mask.

        It is the one of `masks` that they were made for. `mended` receives a line for
        each departure from what the format means.
        """
        values = _stored(path)[..., list(self.order)]
        fitting = [mask for mask in masks if mask.shape == values.shape[:2]]
        if not fitting:
            sizes = dict.fromkeys(f"{m.shape[1]} x {m.shape[0]}" for m in masks)
            raise InputError(
                f"{path}: expected normals of {' or '.join(sizes)} pixels, got "
                f"{values.shape[1]} x {values.shape[0]}"
            )
        normals = _plain(values, path)
        mask = _meant(path, normals, fitting)
        if not self.as_stored:
            normals, lines = _examined(values, normals, mask)
            if mended is not None:
                mended += lines
        _check_lengths(path, normals[mask])
        return normals * np.array(self.signs, np.float32), mask

    def method(
        self,
        name: str,
        subset: Subset,
        mask: np.ndarray,
        crop: Callable[[np.ndarray], np.ndarray],
    ) -> Callable[[Observed], np.ndarray]:
        """One object's normals as a method; `crop` brings them to what is shown.

        `mask` is of the photographs' size.
        """

        def method(observed: Observed) -> np.ndarray:
            path = self.find(name, subset)
            if path is None:
                raise Unsupported(f"files: no normals in {self.folder.name}")
            normals, meant = self.read(path, [observed.mask, mask])
            return normals if meant is observed.mask else crop(normals)

        return method


def from_files(request: str) -> Variant:
    """The normals of `files:DIR,option=value,...`."""
    text = request.partition(":")[2]
    folder, _, rest = (text, "", "") if Path(text).is_dir() else text.partition(",")
    if not folder or not Path(folder).is_dir():
        raise InputError(
            f"method {request!r}: expected files:DIR, found no such folder"
        )
    options = parse_options(request, rest)
    oracle = take_oracle(options)
    name = str(options.pop("name", Path(folder).resolve().name))
    found = built(request, normal_files, options, folder)
    key = {
        "method": "files",
        "options": options,
        "oracle": oracle,
        "method_code": code_hash("evaluation.normal_files"),
    }
    about = described("Normals made elsewhere, read from files", oracle=oracle)
    label = label_of(name, {}, oracle=oracle)
    return Variant(label, key, _refuse, about, oracle, found, foreign=True)


def normal_files(
    folder: str,
    *,
    x: Literal["right", "left"] = "right",
    y: Literal["up", "down"] = "up",
    z: Literal["viewer", "away"] = "viewer",
    channels: Literal["rgb", "bgr"] = "rgb",
    file: str = "",
    values: Literal["examined", "stored"] = "examined",
) -> NormalFiles:
    """A folder of normals: where x, y and z point, the channels' order, and `file`."""
    signs = 1 - 2 * (x == "left"), 1 - 2 * (y == "down"), 1 - 2 * (z == "away")
    order = (2, 1, 0) if channels == "bgr" else (0, 1, 2)
    return NormalFiles(Path(folder), signs, order, file, values == "stored")


def _stored(path: Path) -> np.ndarray:
    """The values of an array or an image, `[H, W, 3]`, in their own type."""
    if path.suffix.lower() not in (".npy", ".mat"):
        file = read_image_file(path, vectors=True)
        require_three_channels(file)  # the background may be NaN
        return file.pixels
    return files.read_array_normals(path)


def _plain(values: np.ndarray, path: Path) -> np.ndarray:
    """What values mean by the format: arrays hold n, images of integers (n + 1) / 2."""
    is_array = path.suffix.lower() in (".npy", ".mat")
    return values.astype(np.float32) if is_array else decode_normals(values)


def _meant(path: Path, normals: np.ndarray, masks: list[np.ndarray]) -> np.ndarray:
    """Which mask a file's normals are of, where several have its size."""
    first, *others = masks
    if all(np.array_equal(first, other) for other in others):
        return first
    # Outside every mask is background: 0, nothing, or whatever stands for it there.
    there = np.isfinite(normals).all(-1)
    around = normals[there & ~np.any(masks, axis=0)]
    if len(around):
        there &= (normals != np.median(around, axis=0)).any(-1)
    # How far object and background are where a mask has them: 0 is all of both.
    misfits = [1 - min(_share(there, m), _share(~there, ~m)) for m in masks]
    best, second = np.argsort(misfits)[:2]
    if not 2 * misfits[best] < misfits[second]:
        raise InputError(
            f"{path}: {normals.shape[1]} x {normals.shape[0]} pixels are the "
            "photographs' size and the crop's, and its background does not show which "
            "is meant; store 0 outside the object, or take another --crop-size"
        )
    return masks[best]


def _share(found: np.ndarray, where: np.ndarray) -> float:
    return float((found & where).sum() / max(where.sum(), 1))


def _examined(
    values: np.ndarray, plain: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """What values on the object stand for, and a line for each departure from `plain`.

    `plain` itself where there is none.
    """
    found: list[str] = []
    if values.dtype not in (np.uint8, np.uint16):
        values = values.astype(np.float32)
    elif plain.max(initial=0) > 1:
        found.append(f"the array holds {values.dtype}: read as a picture's (n + 1) / 2")
    there = mask & np.isfinite(values).all(-1)
    normals = decode_values(values, there, found)
    option = "files:DIR,values=stored"
    return normals if found else plain, [x.replace(OVERRULE, option) for x in found]


def _refuse(observed: Observed) -> NoReturn:
    raise Unsupported("files: normals are read for known objects only")


def _named(base: Path, name: str) -> Iterator[Path]:
    """Files that could hold an object's normals."""
    yield from (p for s in _SUFFIXES if (p := base / f"{name}{s}").is_file())
    for folder in (base / name, base / f"{name}.data", base / f"{name}PNG"):
        if folder.is_dir():
            yield from sorted(path for path in folder.iterdir() if _speaks(path))


def _speaks(path: Path) -> bool:
    """Whether a file, by its name, holds estimated normals."""
    stem = path.stem.lower()
    return (
        path.suffix.lower() in _SUFFIXES
        and not path.name.startswith(".")
        and any(word in stem for word in _WORDS)
        and not any(word in stem for word in _NO_NORMALS)
    )


def _best(place: Path, found: Iterator[Path]) -> Path | None:
    """The one of the kind that loses least."""
    by_suffix: dict[str, list[Path]] = {}
    for path in found:
        by_suffix.setdefault(path.suffix.lower(), []).append(path)
    for suffix in _SUFFIXES:
        same = by_suffix.get(suffix, [])
        if len(same) > 1:
            raise InputError(
                f"{place}: expected one file of normals, found {same[0].name} and "
                f"{same[1].name}; say which by ,file=..."
            )
        if same:
            return same[0]
    return None


def _check_lengths(path: Path, inside: np.ndarray) -> None:
    """Refuses what is no normals, and names what it looks like."""
    known = inside[np.isfinite(inside).all(-1) & inside.any(-1)].astype(float)
    if not len(known):
        raise InputError(f"{path}: expected normals on the object, found only zeros")
    length = float(np.median(np.linalg.norm(known, axis=-1)))
    if _LENGTHS[0] <= length <= _LENGTHS[1]:
        return
    readings: dict[str, Any] = {
        "(n + 1) / 2; store 2 v - 1": 2 * known - 1,
        "bytes; store v / 127.5 - 1": known / 127.5 - 1,
        "16 bits; store v / 32767.5 - 1": known / 32767.5 - 1,
        "colours as a display shows them; save them as data, without a curve": 2
        * as_linear(np.clip((known + 1) / 2, 0, 1), "srgb")
        - 1,
        "such colours in floats; store 2 linear(v) - 1": 2
        * as_linear(np.clip(known, 0, 1), "srgb")
        - 1,
    }
    hint = ""
    for what, read in readings.items():
        if _LENGTHS[0] <= np.median(np.linalg.norm(read, axis=-1)) <= _LENGTHS[1]:
            hint = f"; it seems to hold {what}"
            break
    raise InputError(
        f"{path}: expected unit vectors, got a median length of {length:.3g}{hint}"
    )
