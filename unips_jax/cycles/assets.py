"""What is rendered: the user's meshes, materials and environments, or drawn ones.

Each object is a function of the seed and its number (or, in a manifest, of its names),
whatever else the set holds.
"""

import csv
import glob
import re
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unips_jax.cycles.lighting import LIGHTINGS
from unips_jax.errors import InputError
from unips_jax.io.claims import slug

CATEGORIES = ("Fabric", "Concrete", "Wood", "Floor", "Ground", "Metal")
SHAPES = ("cut", "displaced", "knot", "lathe", "extruded", "relief", "pile")
MESHES = frozenset((".obj", ".ply", ".glb", ".gltf", ".stl", ".blend"))
PICTURES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".hdr"))
# How files' names end, without resolutions. "gold_metal_roughness" is the roughness of
# a metal, "metalRoughness" both in one picture.
_MAPS = {
    "packed": (
        "metallicroughness",
        "metallic_roughness",
        "metalroughness",
        "roughnessmetallic",
        "_orm",
        "_arm",
    ),
    "baseColor": ("albedo", "diffuse", "_diff", "color", "colour", "_col"),
    "roughness": ("roughness", "rough"),
    "metal": ("metallic", "metalness", "metal"),
}


class Job(NamedTuple):
    """One object of a set."""

    name: str  # of its folders
    seed: tuple[int, ...]  # draws everything of it that is not named here
    shape: dict[str, Any]  # what Blender's `shapes.build` takes
    material: dict[str, Any]  # what Blender's `materials.build` takes
    # names for `meta.json`: shape, material, category if there is one
    facts: dict[str, str]
    facing: bool = False  # whether only its front is of interest (a relief)
    # which lightings it is to have; None for all
    lightings: tuple[str, ...] | None = None


def find_files(folder: Path, suffixes: frozenset[str], option: str) -> list[Path]:
    """Files below a folder, at least one, sorted."""
    below = glob.iglob("**/*", root_dir=folder, recursive=True)  # through links
    files = (folder / name for name in below)
    found = sorted(p for p in files if p.suffix.lower() in suffixes and p.is_file())
    if not found:
        raise InputError(
            f"{option} {folder}: expected files {', '.join(sorted(suffixes))}, "
            "found none"
        )
    return found


def find_materials(folder: Path) -> dict[str, dict[str, Any]]:
    """Texture sets: a folder each, at any depth; files' names end as their maps do.

    Returns by the path below `folder` what Blender's `materials.build` takes. The
    category is that of the six whose name is part of this path, else of the folder's
    own name, or "". Sets without a base colour are left out.
    """
    found: dict[str, dict[str, Any]] = {}
    for picture in find_files(folder, PICTURES, "--materials"):
        stem = re.sub(r"[^a-z0-9]+", "_", f"_{picture.stem.lower()}")
        stem = re.sub(r"_?\d+k$", "", stem)
        name = next((name for name, ends in _MAPS.items() if stem.endswith(ends)), None)
        if name is None:
            continue
        place = picture.parent
        below = place.relative_to(folder).as_posix()
        key = place.name if place == folder else below
        category = _category(key, folder.name)
        entry = found.setdefault(key, {"category": category, "maps": {}})
        entry["maps"].setdefault(name, str(picture.resolve()))
    found = {key: entry for key, entry in found.items() if "baseColor" in entry["maps"]}
    if not found:
        raise InputError(
            f"--materials {folder}: expected pictures named *baseColor*, *roughness* "
            "and *metallic* in a folder per material, found no base colour"
        )
    return found


def _category(*names: str) -> str:
    """The category named in the first of the names that has one, or ""."""
    named = (c for name in names for c in CATEGORIES if c.lower() in name.lower())
    return next(named, "")


def _number(text: str) -> int:
    return zlib.crc32(text.encode())


def drawn_jobs(
    count: int,
    seed: int,
    meshes: list[Path] | None = None,
    materials: dict[str, dict[str, Any]] | None = None,
) -> list[Job]:
    """Objects `obj000`, `obj001`, ..., each of its own number and seed."""
    jobs = []
    for index in range(count):
        rng = np.random.default_rng((seed, index))
        kind, category = SHAPES[index % len(SHAPES)], CATEGORIES[index % 6]
        shape: dict[str, Any] = {"kind": kind, "seed": int(rng.integers(2**31))}
        material: dict[str, Any]
        material = {"category": category, "seed": int(rng.integers(2**31))}
        facts = {"shape": kind, "material": category.lower(), "category": category}
        if meshes:
            path = meshes[int(rng.integers(len(meshes)))]
            shape, facts["shape"] = {"file": str(path.resolve())}, path.stem
        if materials:
            name = sorted(materials)[int(rng.integers(len(materials)))]
            material = materials[name]
            facts |= {"material": name, "category": material["category"]}
        facts = {fact: value for fact, value in facts.items() if value}
        facing = not meshes and kind == "relief"
        place = (seed, index, 1)
        jobs.append(Job(f"obj{index:03d}", place, shape, material, facts, facing))
    return jobs


def require_meshes(manifest: Path, meshes: list[Path] | None, preset: str) -> None:
    """Checks that a preset's own manifest finds all its meshes."""
    with manifest.open(newline="") as file:
        wanted = [row["object"] for row in csv.DictReader(file)]
    stems = {mesh.stem.lower() for mesh in meshes or []}
    missing = [name for name in wanted if name not in stems]
    if missing:
        raise InputError(
            f"--preset {preset}: expected meshes {', '.join(wanted)} in --meshes, "
            f"found no {missing[0]}; `python tools/fetch_assets.py DIR --meshes` "
            "fetches them to DIR/meshes"
        )


def manifest_jobs(
    path: Path,
    seed: int,
    meshes: list[Path] | None = None,
    materials: dict[str, dict[str, Any]] | None = None,
) -> list[Job]:
    """The objects of a list.

    A shape is drawn by the object's name where no mesh file has it, a material by its
    name where no texture folder (`find_materials`) has it. `path` is a CSV file with
    columns `object`, `material`, `category` and, if wanted, `id` and `lighting`
    (several separated by blanks), as `ps_wild_test.csv`.
    """
    by_name = {mesh.stem.lower(): mesh for mesh in meshes or []}
    named = (materials or {}).items()
    sets = {name.lower().rpartition("/")[2]: entry for name, entry in named}
    sets |= {name.lower(): entry for name, entry in named}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # as Excel writes
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--manifest {path}: cannot be read ({error})") from None
    jobs = []
    for line, row in enumerate(rows, 2):
        missing = [k for k in ("object", "material", "category") if not row.get(k)]
        if missing:
            raise InputError(
                f"{path}, line {line}: expected object, material and category, "
                f"{missing[0]} is missing"
            )
        thing, matter, category = (row[k] for k in ("object", "material", "category"))
        if category not in CATEGORIES:
            raise InputError(
                f"{path}, line {line}: category: expected one of "
                f"{', '.join(CATEGORIES)}, got {category!r}"
            )
        number = _number(f"{seed}/{thing}")
        kind = SHAPES[number % len(SHAPES)]
        shape: dict[str, Any] = {"kind": kind, "seed": number}
        if thing.lower() in by_name:
            shape = {"file": str(by_name[thing.lower()].resolve())}
        drawn = {"category": category, "seed": _number(f"{seed}/{matter}")}
        material = sets.get(matter.lower(), drawn)
        facts = {"shape": thing, "material": matter, "category": category}
        name = slug(f"{row.get('id') or line - 1:>03}-{thing}-{matter}")
        facing = shape.get("kind") == "relief"
        lightings = tuple((row.get("lighting") or "").split()) or None
        unknown = sorted(set(lightings or ()) - set(LIGHTINGS))
        if unknown:
            raise InputError(
                f"{path}, line {line}: lighting: expected some of "
                f"{', '.join(LIGHTINGS)}, got {unknown[0]!r}"
            )
        place = (seed, _number(name))
        jobs.append(Job(name, place, shape, material, facts, facing, lightings))
    if not jobs:
        raise InputError(f"--manifest {path}: expected lines of objects, found none")
    return jobs
