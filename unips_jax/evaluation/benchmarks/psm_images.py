"""The psmImages of the University of Washington's computer vision course.

`ROOT/{buddha,cat,gray,horse,owl,rock}/NAME.0.png` .. (8 bit, twelve lights), with
`NAME.mask.png` with them, `chrome/` (a mirror sphere that shows the lights; it is not
evaluated) and `lights.txt`: a line with the number of lights, then `x y z` per light.
ROOT may also be the folder above `psmImages`. Where `NAME.txt` is there (a count, then
image names, then the mask's), its order of images is followed; where not, the number in
the file's name.

No truth is published. The grey sphere's normals follow from its outline, and are
computed here from its mask; the others are shown without scores.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from unips_jax.baselines.method import Lights
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.benchmarks.base import Benchmark, Entry, Truth, distant_lights
from unips_jax.io.masks import read_mask
from unips_jax.io.naming import natural_key

_OBJECTS = ("buddha", "cat", "gray", "horse", "owl", "rock")


class PsmImages(Benchmark):
    """UW psmImages: six objects under twelve distant lights, 8 bit."""

    name = "uw"
    default_protocol = "native"

    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        root = self.root
        for parent in ("psmImages", "psmImages_png"):
            root = self.root / parent if (self.root / parent).is_dir() else root
        lights = root / "lights.txt"
        for name in [o for o in _OBJECTS if not objects or o in objects]:
            folder = files.require_folder(root / name, f"psmImages's object {name}")
            extras = [folder / f"{name}.mask.png"]
            extras += [lights] if lights.is_file() else []
            yield Entry(
                name,
                _images(folder, name),
                tuple(extras),
                {"object": name},
                () if lights.is_file() else ("no lights.txt: lights unknown",),
            )

    def truth(self, entry: Entry) -> Truth:
        """Reads mask and lights; computes the grey sphere's normals."""
        mask = read_mask(entry.files[0])
        lights: Lights | None = None
        notes: tuple[str, ...] = ()
        if len(entry.files) > 1:
            lights, notes = _read_lights(entry.files[1])
        if entry.name != "gray" or not mask.any():
            return Truth(mask, None, lights, None, notes)
        notes += ("true normals computed from the sphere's outline",)
        return Truth(mask, sphere_normals(mask), lights, None, notes)


def sphere_normals(mask: np.ndarray) -> np.ndarray:
    """Unit normals `[H, W, 3]` of the sphere whose orthographic outline is the mask."""
    # Pixels at the rim outside the circle of the same area are brought to it.
    rows, columns = np.nonzero(mask)
    radius = np.sqrt(len(rows) / np.pi)
    x = (columns - columns.mean()) / radius
    y = -(rows - rows.mean()) / radius
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    inside = np.stack([x, y, z], axis=-1)
    inside /= np.linalg.norm(inside, axis=-1, keepdims=True)
    normals = np.zeros((*mask.shape, 3), np.float32)
    normals[mask] = inside
    return normals


def _images(folder: Path, name: str) -> tuple[Path, ...]:
    for listing in (folder / f"{name}.txt", folder.parent / f"{name}.txt"):
        if listing.is_file():
            words = files.read_bytes(listing).decode("utf-8", "replace").split()
            names = [os.path.basename(word) for word in words[1:]]
            kept = [n for n in names if "mask" not in n]
            if not kept or words[0] != str(len(kept)):
                raise InputError(
                    f"{listing}: expected a number of images, their names, and the "
                    f"mask's name; got {len(kept)} names after {words[:1]}"
                )
            return tuple((folder / n).with_suffix(".png") for n in kept)
    found = [
        p
        for p in folder.glob(f"{name}.*.png")
        if p.name.removeprefix(f"{name}.").removesuffix(".png").isdigit()
    ]
    if not found:
        raise InputError(f"{folder}: no images; expected {name}.0.png, {name}.1.png")
    return tuple(sorted(found, key=lambda p: natural_key(p.name)))


def _read_lights(path: Path) -> tuple[Lights, tuple[str, ...]]:
    first = files.read_bytes(path).decode("utf-8", "replace").split("\n", 1)[0].split()
    skip = 1 if len(first) == 1 else 0
    table = files.read_numbers(path, 3, "light directions", skip=skip)
    if skip and first != [str(len(table))]:
        raise InputError(f"{path}: announces {first[0]} lights, {len(table)} follow")
    notes: tuple[str, ...] = ()
    if (table[:, 2] < 0).all():
        table = table * [1, 1, -1]
        notes = ("lights.txt has z away from the viewer: negated",)
    return distant_lights(table, None, path), notes
