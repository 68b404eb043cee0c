"""PS-Wild: rendered objects with measured materials (UniPS, CVPR 2022, Sec. 5).

A folder `X.data/` holds linear RGB photographs and `normal.tif`, 16 bit,
n = 2 v / 65535 - 1 (x right, y up, z to the viewer). Pixels of the object are those
where | 1 - |n| | < 1e-3; a `mask.png`, where there is one, narrows them. The sets that
`unips render` writes have the same layout, with a `meta.json` too.

The public description leaves open how PS-Wild-Test's three lightings lie on disk.
Every `*.data` folder at most three levels below the root is taken; the folder above it
names its lighting (`directional`; `environment`, `hdri`, `env`; `mixed`,
`directional_hdri`, ...), and an object without such a folder has none.
"""

import csv
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks.base import Benchmark, Entry, Truth, distant_lights
from unips_jax.io.masks import read_mask
from unips_jax.io.naming import natural_key
from unips_jax.io.normals import has_unit_length, read_normals
from unips_jax.io.ps_wild import (
    MASK,
    META,
    NORMALS,
    meta_focal,
    meta_lights,
    photographs_of,
    read_meta,
)
from unips_jax.io.selection import folder_name, unicode_name

_SPELLED = {
    "directional": "directional dir directional_light",
    "environment": "environment env hdri hdr",
    "mixed": "mixed directional_hdri dir_hdri dirhdri both",
}
_LIGHTINGS = {word: name for name, words in _SPELLED.items() for word in words.split()}
_ORDER = {name: place for place, name in enumerate(_SPELLED)}


class PSWildTest(Benchmark):
    """PS-Wild-Test, or what `unips render` wrote: photographs `L*`.

    The categories of material come from `meta.json` where there is one, otherwise from
    the paper's supplement (Figures 3-52): by the object's and the material's names if
    the folder's name holds both, else by position if a lighting has exactly 50 objects
    and the folder's name is a number, or holds the name of the object in that place.
    """

    name = "ps-wild"
    default_protocol = "crop"
    crop_focal_ratio = 1.0  # the paper ran Variational with f = 256 on 256 x 256
    prefix = "l"
    _sets: frozenset[Path] = frozenset()

    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        """Yields lighting by lighting, object by object."""
        folders: list[Path] = []
        for depth in range(4):
            folders += [p for p in self.root.glob("*/" * depth + "*.data")]
        groups: dict[Path, list[Path]] = {}
        for folder in sorted({p for p in folders if p.is_dir()}, key=_path_key):
            groups.setdefault(folder.parent, []).append(folder)
        if not groups:
            raise InputError(
                f"{self.root}: expected folders X.data at most three levels down, "
                "found none"
            )
        parents = sorted(groups, key=lambda p: (_ORDER.get(_lighting(p), 9), str(p)))
        self._sets = frozenset(map(self._set_of, parents))
        for parent in parents:
            for position, folder in enumerate(groups[parent]):
                if not objects or set(objects) & set(self._named(folder)):
                    yield self._entry(folder, position, len(groups[parent]))

    def _set_of(self, parent: Path) -> Path:
        """Where a lighting's folder lies, from the root."""
        return parent.relative_to(self.root).parent

    def _named(self, folder: Path) -> tuple[str, str]:
        """The names of the object and of its entry."""
        name = folder_name(folder)
        parent = folder.parent.relative_to(self.root).as_posix()
        entry = (Path(unicode_name(parent)) / name).as_posix()
        if len(self._sets) > 1:  # which may have objects of one name
            place = unicode_name(self._set_of(folder.parent).as_posix())
            name = (Path(place) / name).as_posix()
        return name, entry

    def _entry(self, folder: Path, position: int, count: int) -> Entry:
        photographs = tuple(photographs_of(folder, self.prefix))
        if not photographs:
            raise InputError(f"{folder}: no photographs named {self.prefix.upper()}*")
        extras = [p for n in (MASK, META) if (p := folder / n).is_file()]
        name, entry = self._named(folder)
        tags = {"object": name}
        if folder.parent != self.root:
            tags["lighting"] = _lighting(folder.parent)
        tags |= _materials(folder, position, count)
        return Entry(entry, photographs, (folder / NORMALS, *extras), tags)

    def truth(self, entry: Entry) -> Truth:
        """Reads the true normals and what `meta.json` holds of lights and camera."""
        path = entry.files[0]
        normals = read_normals(path)
        mask = has_unit_length(normals)
        notes = []
        for extra in entry.files[1:]:
            if extra.name != MASK:
                continue
            given = read_mask(extra)
            if given.shape != mask.shape:
                raise InputError(
                    f"{extra}: {given.shape[1]} x {given.shape[0]} pixels, but "
                    f"{path.name} has {mask.shape[1]} x {mask.shape[0]}"
                )
            lost = int((given & ~mask).sum())
            if lost:
                notes.append(f"{lost} masked pixels have no true normal: left out")
            mask &= given
        meta, where = read_meta(path.parent), path.parent / META
        lights = meta_lights(meta, where)
        known = distant_lights(*lights, path.parent) if lights else None
        return Truth(mask, normals, known, meta_focal(meta, where), tuple(notes))


class PSWildTrain(PSWildTest):
    """PS-Wild's training folders: photographs `0*`, ten per object; no other maps."""

    name = "ps-wild-train"
    prefix = "0"


def _path_key(path: Path) -> tuple[Any, ...]:
    return (str(path.parent), natural_key(path.name))


def _lighting(folder: Path) -> str:
    name = folder.name.lower().replace("-", "_").replace("+", "_").replace(" ", "_")
    return _LIGHTINGS.get(name, unicode_name(folder.name))


@functools.cache
def manifest() -> tuple[Mapping[str, str], ...]:
    """The 50 test objects in the supplement's order: object, material, category."""
    path = Path(__file__).with_name("ps_wild_test.csv")
    with path.open(newline="") as file:
        return tuple(csv.DictReader(file))


def _materials(folder: Path, position: int, count: int) -> dict[str, str]:
    meta = read_meta(folder)
    if meta:
        tags = {k: meta.get(k) for k in ("category", "material", "shape")}
        return {k: v for k, v in tags.items() if isinstance(v, str) and v}
    stem = folder.name.lower().replace("_", "-")
    named = [r for r in manifest() if r["object"] in stem and r["material"] in stem]
    # "explosion-blue" is also part of "explosion-blue-1": the longest name is meant.
    named.sort(key=lambda row: -len(row["object"] + row["material"]))
    if not named and count == len(manifest()):
        placed = manifest()[position]
        if folder.stem.isdigit() or placed["object"] in stem:
            named = [placed]
    return {k: named[0][k] for k in ("category", "material")} if named else {}
