"""A plain folder of photographs with a `normal.*`, or a folder of such folders."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from unips_jax.baselines.method import Lights
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.benchmarks.base import (
    Benchmark,
    Entry,
    Truth,
    at_most_one,
    distant_lights,
)
from unips_jax.io.color import as_linear
from unips_jax.io.images import ImageFile, decode_image, read_image_file
from unips_jax.io.masks import read_mask
from unips_jax.io.naming import natural_key, plain_name
from unips_jax.io.normals import normals_of, true_pixels
from unips_jax.io.photographs import Capture, read_capture
from unips_jax.io.selection import SUFFIXES, Selection, folder_name, select
from unips_jax.lighting.rig import read_directions

_ARRAYS = (".npy", ".mat")
_LIGHTS = ".lp"
# Of several the first is the truth: others may be estimates, or pictures of it.
_TRUTHS = (
    (("normal_gt", "gt_normal"), _ARRAYS),
    (("normal_gt", "gt_normal"), SUFFIXES),
    (("normal", "normals"), SUFFIXES),
    (("normal", "normals"), _ARRAYS),
)


class Folder(Benchmark):
    """Your own objects: photographs, a normal map, and a `mask.png` or none.

    Each object is a folder (ROOT itself, or the folders in it) with photographs of any
    names and formats, `normal.*` (or `normals.*`, `Normal_gt.*`; PNG, TIFF, EXR, or an
    array in `.npy` or `.mat`) in the convention x right, y up, z to the viewer, stored
    as (n + 1) / 2 in images of 8 or 16 bits and as n else, and, where it is given,
    `mask.*`. Without a mask the object's pixels are those whose true normal has unit
    length (to 1e-3 in 16 bits or more, to 0.05 in 8); of a mask, pixels without a true
    normal are left out. Photographs and mask are chosen and read as by `unips estimate`
    (see `io.photographs`), those of 8 bits taken as sRGB (store linear ones in 16). An
    object's photographs are read whole by the check too. The focal length is taken from
    the first photograph's EXIF data, where it carries one, the lights from a list
    `*.lp` that has a direction for each photograph, by name: distant and equally
    strong.
    """

    name = "folder"
    default_protocol = "native"

    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        """Yields the root itself if it has a normal map, else the folders in it."""
        if _truth_files(self.root):
            yield self._entry(self.root)
            return
        inside = sorted(
            (p for p in self.root.iterdir() if p.is_dir()),
            key=lambda p: natural_key(p.name),
        )
        folders = [p for p in inside if _truth_files(p)]
        self.left_out = tuple(
            p for p in inside if p not in folders and _holds_images(p)
        )
        if not folders:
            raise InputError(
                f"{self.root}: expected a normal map `normal.*` (PNG, TIFF, EXR, .npy, "
                ".mat), or folders with one"
            )
        for folder in folders:
            if not objects or folder_name(folder) in objects:
                yield self._entry(folder)

    def _entry(self, folder: Path) -> Entry:
        truth, *others = _truth_files(folder)  # `find` looked
        notes = [f"true normals of {truth.name}, not {p.name}" for p in others]
        selection = select(folder)
        masks = [selection.mask_file] if selection.mask_file else []
        inside = sorted(path for path in folder.iterdir() if path.is_file())
        lists = [path for path in inside if path.suffix.lower() == _LIGHTS]
        name = folder_name(folder)
        read = (truth, *masks, *lists)
        return Entry(name, selection.files, read, {"object": name}, tuple(notes))

    def truth(self, entry: Entry) -> Truth:
        """Reads the true normals, the mask and the lights."""
        normals = _true_normals(entry.files[0])
        others = entry.files[1:]
        lists = [path for path in others if path.suffix.lower() == _LIGHTS]
        lights, notes = _lights(lists, entry.images)
        if len(others) > len(lists):
            mask = read_mask(others[0])
            if mask.shape != normals.shape[:2]:
                raise InputError(
                    f"{others[0]}: {mask.shape[1]} x {mask.shape[0]} pixels, but "
                    f"{entry.files[0].name} has {normals.shape[1]} x {normals.shape[0]}"
                )
            there = _true_within(mask, normals)
            if lost := int((mask & ~there).sum()):
                notes += (f"{lost} masked pixels have no true normal: left out",)
                mask = there
        else:
            mask = true_pixels(normals)
        return Truth(mask, normals, lights, notes=notes)

    def photographs(
        self, entry: Entry, mask: np.ndarray
    ) -> tuple[np.ndarray, float | None, tuple[str, ...]]:
        """Reads the photographs as `unips estimate` does, and makes them linear."""
        read = _read(entry, mask, read_image_file)
        if read.transfer == "linear":
            images, notes = at_most_one(read.images, mask)
            return images, read.focal, notes
        linear = np.empty(read.images.shape, np.float32)
        for place, image in zip(linear, read.images, strict=True):
            place[...] = as_linear(image, "srgb")
        return (
            linear,
            read.focal,
            (f"photographs taken as sRGB ({read.transfer_rule}) and made linear",),
        )

    def checked_photographs(
        self, entry: Entry, mask: np.ndarray
    ) -> Iterator[tuple[Path, bytes]]:
        """Yields the photographs' files and contents, all read before."""
        contents = {}

        def read(path: Path) -> ImageFile:
            contents[path] = files.read_bytes(path)
            return decode_image(contents[path], path)

        _read(entry, mask, read)
        yield from contents.items()


def _read(entry: Entry, mask: np.ndarray, read: Callable[[Path], ImageFile]) -> Capture:
    def read_fitting(path: Path) -> ImageFile:
        file = read(path)
        height, width = file.pixels.shape[:2]
        # Others are compared with the first, some once they are turned as it is.
        if path == entry.images[0] and (height, width) != mask.shape:
            raise InputError(
                f"{path}: expected {mask.shape[1]} x {mask.shape[0]} pixels as "
                f"{entry.files[0].name}, got {width} x {height}; remove or re-export it"
            )
        return file

    selection = Selection(entry.images[0].parent, entry.images, {}, None)
    return read_capture(selection, read=read_fitting, mask=mask)


def _lights(
    lists: list[Path], photographs: tuple[Path, ...]
) -> tuple[Lights | None, tuple[str, ...]]:
    """The lights of the first list that has all, and what is to be said of lists."""
    notes = []
    for path in lists:
        try:
            names, directions = read_directions(path, path.name)
        except InputError as error:
            notes.append(f"lights not known: {error}")
            continue
        rows = {plain_name(name): row for row, name in enumerate(names)}
        wanted = [plain_name(photograph.name) for photograph in photographs]
        missing = [
            p.name for p, w in zip(photographs, wanted, strict=True) if w not in rows
        ]
        if not missing:
            found = directions[[rows[name] for name in wanted]]
            return distant_lights(found, None, path), (f"lights of {path.name}",)
        notes.append(f"lights not known: {path.name} has none of {missing[0]}")
    return None, tuple(notes)


def _true_normals(path: Path) -> np.ndarray:
    """True normals `[H, W, 3]`, float32, 0 where an array has none."""
    if path.suffix.lower() not in _ARRAYS:
        return normals_of(read_image_file(path, vectors=True))
    values = files.read_array_normals(path)
    there = np.isfinite(values).all(axis=-1, keepdims=True)
    return np.where(there, values, 0).astype(np.float32)


def _true_within(mask: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The masked pixels with a true normal; all, where lengths are of no normal map."""
    length = np.linalg.norm(normals, axis=-1)
    known = mask & (length > 0.1)
    # Black and white of integers are no normals, but have a length of 1.7.
    there = known & (length < 1.2)
    usual = 2 * there.sum() > mask.sum() and 0.9 <= np.median(length[known]) <= 1.1
    return there if usual else mask


def _holds_images(folder: Path) -> bool:
    return any(path.suffix.lower() in SUFFIXES for path in folder.iterdir())


def _truth_files(folder: Path) -> list[Path]:
    """What may be the truth of a folder, the first of `_TRUTHS` first."""
    inside = sorted(folder.iterdir())
    return [
        path
        for stems, suffixes in _TRUTHS
        for path in inside
        if path.stem.lower() in stems and path.suffix.lower() in suffixes
    ]
