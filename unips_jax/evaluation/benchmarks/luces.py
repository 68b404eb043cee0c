"""LUCES: near point lights, perspective camera (Mecca et al., BMVC 2021).

`ROOT/{Ball,...}/` (or `ROOT/data/...`) holds `01.png` .. `52.png`, 16-bit linear RGB of
2048 x 1536, `led_params.txt`, `mask.png`, `normals.png` (16 bit, n = 2 v / 65535 - 1)
and `zgt.npz` (array `zgt`, depth).

`led_params.txt`, as the authors' tools write it: a line of names, a line `N rows
columns f x0 y0 mean_distance` (pixels and millimetres), then one line per LED: position
(3), principal direction (3), brightness (1 or 3), anisotropy, and possibly a closing 0.
The lights are near, so no distant lights are given: methods calibrated for those report
that they lack them.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.benchmarks.base import Benchmark, Entry, Truth
from unips_jax.io.masks import read_mask
from unips_jax.io.normals import read_normals

_OBJECTS = (
    "Ball Bell Bowl Buddha Bunny Cup Die Hippo House Jar Owl Queen Squirrel Tool"
).split()
_IMAGES = 52


class Leds(NamedTuple):
    """What `led_params.txt` holds."""

    focal: float  # in pixels
    positions: np.ndarray  # `[N, 3]`, in millimetres, as in the file


class Luces(Benchmark):
    """LUCES: 14 objects, 52 images each; principal point at the image's centre."""

    name = "luces"
    default_protocol = "native"

    def find(self, objects: tuple[str, ...]) -> Iterator[Entry]:
        root = self.root / "data" if (self.root / "data").is_dir() else self.root
        for name in [o for o in _OBJECTS if not objects or o in objects]:
            folder = files.require_folder(root / name, f"LUCES's object {name}")
            extras = ("mask.png", "normals.png", "led_params.txt", "zgt.npz")
            yield Entry(
                name,
                tuple(folder / f"{i:02d}.png" for i in range(1, _IMAGES + 1)),
                tuple(folder / extra for extra in extras),
                {"object": name},
            )

    def truth(self, entry: Entry) -> Truth:
        """Reads mask, true normals and camera, and checks the depth."""
        mask_path, normals_path, leds_path, depth_path = entry.files
        mask = read_mask(mask_path)
        depth = files.read_npz(depth_path, "zgt")
        if depth.shape != mask.shape:
            raise InputError(
                f"{depth_path}: zgt has shape {depth.shape}, the mask {mask.shape}"
            )
        leds = read_leds(leds_path)
        if len(leds.positions) != len(entry.images):
            raise InputError(
                f"{leds_path}: {len(leds.positions)} LEDs but {len(entry.images)} "
                "images"
            )
        normals = read_normals(normals_path)
        if normals.shape[:2] != mask.shape:
            raise InputError(
                f"{normals_path}: shape {normals.shape[:2]}, the mask {mask.shape}"
            )
        return Truth(mask, normals, None, leds.focal)


def read_leds(path: Path) -> Leds:
    """Reads `led_params.txt`; an `InputError` names the line that does not fit."""
    files.require_file(path, "LUCES's camera and lights")
    lines = files.read_bytes(path).decode("utf-8", "replace").splitlines()
    rows = [line.split() for line in lines[1:] if line.strip()]
    try:
        camera = [float(field) for field in rows[0]]
        count = int(camera[0])
        leds = [[float(field) for field in row[:8]] for row in rows[1:]]
    except (IndexError, ValueError) as error:
        raise InputError(
            f"{path}: expected a line of names, then 'N rows columns f x0 y0 "
            f"mean_distance', then numbers for each LED ({error})"
        ) from error
    if len(camera) != 7 or not np.isfinite(camera).all() or camera[3] <= 0:
        raise InputError(f"{path}, line 2: expected 7 numbers, got {len(camera)}")
    if len(leds) != count or any(len(led) != 8 for led in leds):
        raise InputError(
            f"{path}: line 2 announces {count} LEDs of at least 8 numbers, "
            f"{len(leds)} lines follow"
        )
    positions = np.array(leds)[:, :3]
    if not np.isfinite(positions).all():
        raise InputError(f"{path}: a LED's position is not finite")
    return Leds(camera[3], positions)
