"""Sets like PS-Wild from presets, folders of the user's and a manifest."""

import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unips_jax.cycles import assets
from unips_jax.cycles.blender_process import Blender, find_python
from unips_jax.cycles.run import Settings, render_set
from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.io.color import srgb_encode
from unips_jax.io.door import write_whole
from unips_jax.io.images import check_picture, encode_image
from unips_jax.io.ps_wild import PSWildFolders, read_object

PRESETS: dict[str, dict[str, Any]] = {
    "train": {"images": 10, "training": True},
    "test": {"images": 32},
    "ps-wild-mini": {
        "objects": 12,
        "images": 10,
        "size": 256,
        "samples": 64,
        "denoise": True,
        "environments": "blender",
        "seed": 2022,
    },
    "ps-wild-real": {
        "manifest": Path(__file__).with_name("ps_wild_real.csv"),
        "images": 10,
        "size": 256,
        "samples": 64,
        "denoise": True,
        "environments": "blender",
        "seed": 2026,
    },
}
_ENVIRONMENTS = frozenset((".hdr", ".exr"))


def _sizes(option: str, folder: Path, found: list[Path]) -> dict[str, int]:
    """By which a folder of other files is recognised, without reading them."""
    return {
        f"{option} {path.relative_to(folder).as_posix()}": path.stat().st_size
        for path in found
    }


class Plan(NamedTuple):
    """What is to be rendered."""

    jobs: list[assets.Job]  # the objects
    chosen: dict[str, Any]  # fields of `Settings`; environments may be "blender"
    threads: int  # of the renderer


def plan(preset: str = "test", **given: Any) -> Plan:
    """What a preset and options ask for; of these None is the preset's."""
    chosen: dict[str, Any] = {"objects": 6, "seed": 0, "environments": None}
    chosen |= PRESETS[preset]
    chosen |= {name: value for name, value in given.items() if value is not None}
    least = {"objects": 1, "images": 1, "size": 1, "samples": 1, "seed": 0}
    for name, value in least.items():
        if chosen.get(name, value) < value:
            raise InputError(f"--{name}: expected at least {value}, got {chosen[name]}")
    if not 0 <= chosen.get("perspective", 0) <= 1:
        raise InputError(f"--perspective: expected 0 to 1, got {chosen['perspective']}")
    meshes, materials = chosen.pop("meshes", None), chosen.pop("materials", None)
    files: dict[str, int] = {}
    if meshes is not None:
        folder, meshes = meshes, assets.find_files(meshes, assets.MESHES, "--meshes")
        files |= _sizes("--meshes", folder, meshes)
    if materials is not None:
        materials = assets.find_materials(materials)
        for name, entry in materials.items():
            for path in map(Path, entry["maps"].values()):
                files[f"--materials {name}/{path.name}"] = path.stat().st_size
    around = chosen["environments"]
    if around not in (None, "blender"):
        found = assets.find_files(Path(around), _ENVIRONMENTS, "--environments")
        files |= _sizes("--environments", Path(around), found)
        chosen["environments"] = tuple(str(path.resolve()) for path in found)
    count, manifest = chosen.pop("objects"), chosen.pop("manifest", None)
    if manifest is not None and "manifest" in PRESETS[preset]:
        assets.require_meshes(manifest, meshes, preset)
    if manifest is None:
        jobs = assets.drawn_jobs(count, chosen["seed"], meshes, materials)
    else:
        jobs = assets.manifest_jobs(manifest, chosen["seed"], meshes, materials)
        jobs = jobs[: given.get("objects")]
        files["--manifest"] = zlib.crc32(manifest.read_bytes())
    if "lightings" in chosen:
        chosen["lightings"] = tuple(chosen["lightings"])
    threads = chosen.pop("threads")
    return Plan(jobs, {**chosen, "files": files}, threads)


def render(
    output: Path,
    *,
    preset: str = "test",
    sheet: Path | None = None,
    only: str | None = None,
    **given: Any,
) -> None:
    """Renders a set: one of `PRESETS`, with options as in `plan`.

    `sheet` is also a picture of the whole set; `only` renders this object of it alone.
    `InputError` also if objects had to be left out.
    """
    if sheet is not None:
        check_picture(sheet, "--sheet")
    jobs, chosen, threads = plan(preset, **given)
    if only is not None:
        jobs = [job for job in jobs if job.name == only]
    make_folder(output, "-o")
    with Blender(find_python(), threads=threads) as blender:
        around = chosen["environments"] or ()
        if around == "blender":
            around = tuple(blender.ask("environments"))
        settings = Settings(**chosen | {"environments": around})
        failed = render_set(blender, jobs, settings, output)
    if sheet is not None and any(output.glob("*/*.data")):
        write_whole(sheet, encode_image(sheet.suffix, contact_sheet(output)))
        print(f"wrote {sheet}")
    if failed:
        raise InputError(
            f"{len(failed)} of {len(jobs)} objects could not be rendered, or not under "
            f"every lighting ({', '.join(failed[:5])}): see {output / 'failures'}; the "
            "others are complete"
        )
    print(f"wrote {output}")


def contact_sheet(root: Path, *, tile: int = 128) -> np.ndarray:
    """A column per object: its normals, then two photographs under each lighting."""
    folders = sorted(p for p in root.iterdir() if p.is_dir() and any(p.glob("*.data")))
    rows: dict[str, dict[str, np.ndarray]] = {"": {}}
    for place in folders:
        source = PSWildFolders(place, min_images=1)
        shown_here = rows.setdefault(place.name, {})
        for files in (source[i] for i in range(len(source))):
            shown = np.linspace(0, len(files.photographs) - 1, 2).astype(int)
            read = read_object(files, shown, tile)
            bright = srgb_encode(np.clip(read["images"], 0, 1))
            name = files.normals.parent.name
            shown_here[name] = np.concatenate(list(bright))
            rows[""][name] = np.where(
                read["mask"][..., None], 0.5 * read["normals"] + 0.5, 0.25
            )
    if not rows[""]:
        raise InputError(f"{root}: expected folders of objects, found none complete")
    names = sorted(rows[""])
    wide = []
    for _, row in sorted(rows.items()):
        black = np.zeros_like(next(iter(row.values())))
        wide.append(np.concatenate([row.get(name, black) for name in names], 1))
    return np.rint(np.concatenate(wide) * 255).astype(np.uint8)
