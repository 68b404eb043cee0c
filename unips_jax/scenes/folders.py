"""Scenes as folders of photographs with known normals, and as a sheet to look at.

The folders follow PS-Wild-Test: one per object and lighting, with 16-bit linear
images `L_*.png`, `mask.png`, and `normal.tif` (n = 2 v / 65535 - 1, x right, y up,
z to the viewer, background 32768); `meta.json` holds what was drawn.
Under directional light it holds `light_directions` and `light_intensities`, such that a
Lambertian surface appears as albedo x intensity x max(n . l, 0).
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from unips_jax.console import track
from unips_jax.errors import InputError
from unips_jax.io.claims import claimed
from unips_jax.io.door import write_whole
from unips_jax.io.images import encode_image
from unips_jax.io.ps_wild import read_meta, write_folder
from unips_jax.provenance import code_hash
from unips_jax.scenes import (
    LIGHT_KINDS,
    MATERIALS,
    SHAPE_KINDS,
    SHAPE_NAMES,
    Scene,
    SceneConfig,
    render_batch,
)
from unips_jax.scenes.draws import seeded

LIGHTINGS = ("directional", "environment", "mixed")


# What the folders' contents follow from; the renderer is imported when it is used.
_CODE = ("scenes.folders", "scenes.render")
_FOLDER_CONFIG = SceneConfig(
    linear_rate=1.0, eight_bit_rate=0.0, blur_rate=0.0, mask_error_rate=0.0
)


def describe(scene: Scene) -> dict[str, Any]:
    """What was drawn of one scene, in plain values."""
    focal_mm = float(scene.focal)
    facts: dict[str, Any] = {
        "light": LIGHT_KINDS[int(scene.light_kind)],
        "shape": SHAPE_NAMES[int(scene.shape_kind)],
        "material": MATERIALS[int(scene.material)],
        # Not `focal`, in pixels: frames are cropped beside the optical axis.
        "focal_mm": round(focal_mm, 3) or None,
    }
    if facts["light"] == "directional":
        facts["light_directions"] = np.asarray(scene.light_directions).tolist()
        # A Lambertian surface reflects its albedo / pi of the irradiance.
        intensities = np.asarray(scene.light_intensities) / np.pi
        facts["light_intensities"] = intensities.tolist()
    return facts


def render_folders(
    out: Path,
    *,
    objects: int,
    images: int,
    size: int,
    seed: int,
    shapes: tuple[str, ...] = (),
) -> None:
    """Writes `out/LIGHTING/objNNN.data` for every object and lighting.

    Object K of a seed is always the same; folders that exist are kept, `InputError` if
    they were rendered otherwise, or by other code. Several processes may share the
    work. Objects take `shapes` in turn; `size` is a multiple of 4.
    """
    options: dict[str, Any] = {"seed": seed, "size": size, "images": images}
    if shapes:
        options["shapes"] = list(shapes)
    locks = out / ".locks"
    locks.mkdir(parents=True, exist_ok=True)
    folders = {
        (index, name): out / name / f"obj{index:03d}.data"
        for index in range(objects)
        for name in LIGHTINGS
    }
    left = [job for job, folder in folders.items() if not _is_there(folder, options)]
    ours = claimed(left, lambda job: locks / f"{job[1]}-{job[0]:03d}")
    for index, name in track(ours, "rendering", total=len(left)):
        folder = folders[index, name]
        if _is_there(folder, options):  # another process was faster
            continue
        key = jax.random.fold_in(seeded(seed), index)
        batch = render_batch(
            key[None],
            shape=_in_turn(shapes, index),
            size=size,
            num_images=images,
            config=_FOLDER_CONFIG,
            light_kind=np.int32(LIGHT_KINDS.index(name)),
        )
        scene = jax.tree.map(lambda leaf: leaf[0], batch)
        facts = {"seed": seed, "object": index, "size": size, **describe(scene)}
        facts["code"] = code_hash(*_CODE)
        if shapes:
            facts["shapes"] = list(shapes)
        photographs, mask, normals = map(
            np.asarray, (scene.images, scene.mask, scene.normals)
        )
        write_folder(folder, photographs, mask, normals, facts)


def _in_turn(shapes: tuple[str, ...], index: int) -> np.int32 | None:
    """The shape's number; None for any."""
    return np.int32(SHAPE_KINDS.index(shapes[index % len(shapes)])) if shapes else None


def _is_there(folder: Path, options: dict[str, Any]) -> bool:
    """Refuses a folder of another seed, size, number, shapes or code."""
    if not folder.exists():
        return False
    facts = read_meta(folder)
    facts["images"] = len(list(folder.glob("L_*")))
    found = {k: facts[k] for k in ("seed", "size", "images", "shapes") if k in facts}
    if found != options:
        raise InputError(
            f"{folder}: expected a folder of {options}, got one of {found}; choose "
            "another -o, or the same options"
        )
    if facts.get("code") != code_hash(*_CODE):
        raise InputError(
            f"{folder}: expected scenes of this version of unips_jax, got those of "
            "another; choose another -o"
        )
    return True


def contact_sheet(scenes: Scene, *, columns: int = 8) -> np.ndarray:
    """Tiles of a normal map and three images each, RGB uint8, of a batch of scenes."""
    normals = np.where(
        np.asarray(scenes.mask)[..., None], 0.5 * np.asarray(scenes.normals) + 0.5, 0.25
    )
    images = np.asarray(scenes.images)
    top = np.concatenate([normals, images[:, 0]], 2)
    bottom = np.concatenate([images[:, 1], images[:, 2]], 2)
    tiles = np.concatenate([top, bottom], 1)
    tiles = np.pad(tiles, ((0, 0), (2, 2), (2, 2), (0, 0)), constant_values=0.5)
    rows = [
        np.concatenate(list(tiles[first : first + columns]), 1)
        for first in range(0, len(tiles) - columns + 1, columns)
    ]
    return np.rint(np.clip(np.concatenate(rows), 0, 1) * 255).astype(np.uint8)


def render_sheet(
    path: Path, *, size: int, seed: int, scenes: int = 64, shapes: tuple[str, ...] = ()
) -> None:
    """Writes a contact sheet of random scenes, eights of them, images `size` wide.

    Rows of eight take `shapes` in turn.
    """
    batches = []
    for first in track(range(0, scenes, 8), "rendering"):
        keys = jax.random.split(jax.random.fold_in(seeded(seed), first), 8)
        shape = _in_turn(shapes, first // 8)
        batch = render_batch(keys, shape=shape, size=size, num_images=3)
        batches.append(jax.tree.map(np.asarray, batch))
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *batches)
    write_whole(path, encode_image(path.suffix, contact_sheet(joined)))
