"""DiLiGenT, DiLiGenT-MV and DiLiGenT10^2: real objects under known distant lights.

Sources: DiLiGenT (Shi et al., CVPR 2016), DiLiGenT-MV (Li et al., TIP 2020),
DiLiGenT10^2 (Ren et al., CVPR 2022).

A folder of any of them holds 16-bit linear RGB images listed by `filenames.txt`,
`light_directions.txt` (one line `x y z` per image, x right, y up, z to the viewer),
`light_intensities.txt` (one line `R G B` per image: what each channel is to be divided
by), `mask.png` and, where the truth is public, `Normal_gt.mat` (key `Normal_gt`).
`normal.txt` is never read: harvest's is upside down.
"""

import io
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.benchmarks.base import Benchmark, Entry, Truth, distant_lights
from unips_jax.io.masks import read_mask
from unips_jax.io.naming import natural_key

_OBJECTS = "ball bear buddha cat cow goblet harvest pot1 pot2 reading".split()
# Of each object's published mask.
_PIXELS = (15791, 41512, 44864, 45200, 26421, 26193, 57342, 57721, 35278, 27654)
_MASK_PIXELS = dict(zip(_OBJECTS, _PIXELS, strict=True))
_IMAGES, _CORRUPT = 96, {"bear": 20}  # of an object as published; the first ones
_MV_OBJECTS = ("bear", "buddha", "cow", "pot2", "reading")
_MV_VIEWS = 20
_SHAPES = "BALL GOLF SPIKE NUT SQUARE PENTAGON HEXAGON PROPELLER TURBINE BUNNY".split()
_MATERIALS = "POM PP NYLON PVC ABS BAKELITE AL CU STEEL ACRYLIC".split()
_102_SIZE = (1001, 1001)
_TABLES = ("filenames.txt", "light_directions.txt", "light_intensities.txt")


class Diligent(Benchmark):
    """DiLiGenT: `ROOT/{ball,bear,...}PNG/`, or `ROOT/pmsData/...`.

    Ten objects, 96 images of 612 x 512, orthographic. The first 20 images of bear are
    corrupt and dropped, as everyone does. True normals of zero length (73 pixels of
    pot2) count as 90 degrees, as in the published table.
    """

    name = "diligent"
    default_protocol = "native"
    folder: ClassVar[str] = "pmsData"

    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        root = _data_folder(self.root, self.folder)
        for name in [o for o in _OBJECTS if not objects or o in objects]:
            folder = files.require_folder(
                root / f"{name}PNG", f"DiLiGenT's object {name}"
            )
            photographs = _listed_images(folder)
            drop = _corrupt(name, photographs)
            if len(photographs) <= drop:
                raise InputError(
                    f"{folder / 'filenames.txt'}: lists {len(photographs)} images, of "
                    f"which the first {drop} are known to be corrupt"
                )
            yield Entry(
                name,
                photographs[drop:],
                _companions(folder, truth=True),
                {"object": name},
                (f"the first {drop} images are corrupt: dropped",) if drop else (),
            )

    def truth(self, entry: Entry) -> Truth:
        listed = _listed_images(entry.images[0].parent)
        truth = _read_truth(entry, skip=_corrupt(entry.name, listed))
        published = _MASK_PIXELS[entry.name]
        pixels = int(truth.mask.sum())
        if truth.mask.shape == (512, 612) and pixels != published:
            note = f"the mask has {pixels} pixels, the published one {published}"
            truth = truth._replace(notes=(note,))
        return truth._replace(focal=math.inf)


class DiligentMV(Benchmark):
    """DiLiGenT-MV: `ROOT/{bear,...}PNG/view_01/..view_20/`, or `ROOT/mvpmsData/...`.

    Five objects, 20 views of 96 images; each view is laid out as an object of DiLiGenT.
    `Calib_Results.mat` next to the views holds the camera: `KK` `[3, 3]`, and per view
    `Rc_i`, `Tc_i`. The focal length given is `KK[0, 0]`; the principal point is taken
    at the image's centre, from which the real one is a few pixels away.
    """

    name = "diligent-mv"
    default_protocol = "native"

    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        """Yields object by object, view by view."""
        root = _data_folder(self.root, "mvpmsData")
        wanted = {name.split("/")[0] for name in objects}
        for name in [o for o in _MV_OBJECTS if not wanted or o in wanted]:
            folder = files.require_folder(
                root / f"{name}PNG", f"DiLiGenT-MV's object {name}"
            )
            for view in range(1, _MV_VIEWS + 1):
                if objects and not {name, f"{name}/view_{view:02d}"} & set(objects):
                    continue
                path = files.require_folder(
                    folder / f"view_{view:02d}", f"view {view} of {_MV_VIEWS}"
                )
                yield Entry(
                    f"{name}/view_{view:02d}",
                    _listed_images(path),
                    (*_companions(path, truth=True), folder / "Calib_Results.mat"),
                    {"object": name, "view": f"{view:02d}"},
                )

    def truth(self, entry: Entry) -> Truth:
        truth = _read_truth(entry)
        view = int(entry.tags["view"])
        path = entry.files[-1]
        rotation, translation = f"Rc_{view}", f"Tc_{view}"
        camera = files.read_mat(path, ("KK", rotation, translation))
        for key, size in (("KK", 9), (rotation, 9), (translation, 3)):
            if camera[key].size != size or not np.isfinite(camera[key]).all():
                raise InputError(
                    f"{path}: expected {size} finite numbers in {key}, got shape "
                    f"{camera[key].shape}"
                )
        focal = float(camera["KK"][0, 0])
        return truth._replace(focal=focal)


class Diligent102(Benchmark):
    """DiLiGenT10^2: `ROOT/{BALL,...}_{POM,...}/`, 100 objects of 1001 x 1001.

    The truth is withheld: the evaluation writes, for each method, a submission
    `{name}.mat` with the variable `Normal_est`. Where `filenames.txt` is absent the
    images are those with numbers for names (how the public release names them could not
    be checked).
    """

    name = "diligent102"
    default_protocol = "native"

    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        root = _data_folder(self.root, "pmsData")
        for shape in _SHAPES:
            for material in _MATERIALS:
                name = f"{shape}_{material}"
                if objects and name not in objects:
                    continue
                folder = files.require_folder(
                    root / name, f"DiLiGenT10^2's object {name}"
                )
                truth = (folder / "Normal_gt.mat").is_file()
                yield Entry(
                    name,
                    _listed_images(folder, optional=True),
                    _companions(folder, truth=truth),
                    {"object": name, "category": material, "shape": shape},
                )

    def truth(self, entry: Entry) -> Truth:
        """Reads mask and lights, and true normals for whoever has them."""
        truth = _read_truth(entry)
        if truth.mask.shape != _102_SIZE:
            raise InputError(
                f"{self.root}, {entry.name}: expected images of 1001 x 1001, which "
                f"submissions must have, got {truth.mask.shape[::-1]}"
            )
        return truth


def submission_bytes(normals: np.ndarray) -> bytes:
    """Normals `[1001, 1001, 3]`, 0 outside the mask, as a file for DiLiGenT10^2."""
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(buffer, {"Normal_est": normals.astype(np.float64)}, do_compression=True)
    data = bytearray(buffer.getvalue())
    # The first 116 bytes are free text, where scipy writes the date.
    data[:116] = b"MATLAB 5.0 MAT-file, written by unips_jax".ljust(116)
    return bytes(data)


def _data_folder(root: Path, name: str) -> Path:
    """The folder of the archives, given itself or its parent."""
    return root / name if (root / name).is_dir() else root


def _listed_images(folder: Path, *, optional: bool = False) -> tuple[Path, ...]:
    listing = folder / "filenames.txt"
    if optional and not listing.is_file():
        names = sorted(
            (p.name for p in folder.glob("*.png") if p.stem.isdigit()),
            key=natural_key,
        )
    else:
        files.require_file(listing, "the list of images, one name per line")
        names = files.read_bytes(listing).decode("utf-8", "replace").split()
    if not names:
        raise InputError(f"{folder}: no images; expected 001.png, 002.png, ...")
    strange = [name for name in names if os.path.basename(name) != name]
    if strange:
        raise InputError(f"{listing}: not the name of an image: {strange[0][:60]!r}")
    return tuple(folder / name for name in names)


def _companions(folder: Path, *, truth: bool) -> tuple[Path, ...]:
    names = ["mask.png", *_TABLES[1:], *(["Normal_gt.mat"] if truth else [])]
    return tuple(folder / name for name in names)


def _corrupt(name: str, listed: Sequence[Path]) -> int:
    """How many of the listed images are corrupt, the first; 0 if they are left out."""
    last = _CORRUPT.get(name, 0)
    if len(listed) == _IMAGES - last:
        return 0
    numbers = (int(path.stem) if path.stem.isdigit() else _IMAGES for path in listed)
    return sum(1 for _ in itertools.takewhile(lambda number: number <= last, numbers))


def _read_truth(entry: Entry, *, skip: int = 0) -> Truth:
    folder = entry.images[0].parent
    mask = read_mask(folder / "mask.png")
    tables = []
    for name in _TABLES[1:]:
        what = f"{name.removesuffix('.txt').replace('_', ' ')}, three per image"
        table = files.read_numbers(folder / name, 3, what)
        if len(table) != len(entry.images) + skip:
            raise InputError(
                f"{folder / name}: {len(table)} lines, but filenames.txt lists "
                f"{len(entry.images) + skip} images"
            )
        tables.append(table[skip:])
    lights = distant_lights(tables[0], tables[1], folder)
    path = folder / "Normal_gt.mat"
    if path not in entry.files:
        return Truth(mask, None, lights)
    normals = files.read_mat(path, ("Normal_gt",))["Normal_gt"]
    if normals.shape != (*mask.shape, 3) or normals.dtype.kind != "f":
        raise InputError(
            f"{path}: expected Normal_gt of shape {(*mask.shape, 3)}, as the mask, got "
            f"{normals.dtype} of shape {normals.shape}"
        )
    if not np.isfinite(normals[mask]).all():
        raise InputError(f"{path}: Normal_gt is not finite inside the mask")
    return Truth(mask, normals.astype(np.float32), lights)
