"""Depth and a mesh from normals.

NORMALS is a normal map (PNG, EXR, TIFF), an array (.npy) or a folder of results of
`unips estimate`. OUT receives depth.exr (float), depth.png and height.png (16 bit),
surface.json, which states units and scales, and on request mesh.ply, .obj or .glb, or
files for a purpose (--export): NAME.glb with a material for Blender and games, NAME.stl
on a base, to print; NAME.zip with all of it and a text on each file.
Depth grows away from the viewer; normals tell it up to an offset (orthographic) or a
scale (perspective) of each connected part of the mask.

Method: bilateral normal integration (Cao et al., ECCV 2022), which keeps jumps.
"""

import dataclasses
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from unips_jax.console import command, parse, progress, start_jax
from unips_jax.errors import InputError
from unips_jax.io.door import write_json, write_whole
from unips_jax.io.images import read_image_file, require_finite, require_size
from unips_jax.io.masks import read_mask
from unips_jax.io.normal_maps import print_examined, read_normal_map
from unips_jax.io.normals import NormalMap, read_numbers
from unips_jax.io.record import print_line
from unips_jax.io.results import (
    appearing_at_once,
    check_target,
    normal_map_of,
    results_of,
    transfer_of,
)
from unips_jax.surface.archive import archive
from unips_jax.surface.depth_files import read_depth
from unips_jax.surface.exports import Scale, blender_model, printable
from unips_jax.surface.mesh import METRES, check_mesh_file
from unips_jax.surface.outputs import (
    MeshFormat,
    SurfaceOptions,
    focal_of,
    photograph_colors,
    print_surface,
    write_surface,
)

RECORD = "surface.json"
Export = Literal["blender", "print", "archive"]


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips surface`.

    Attributes:
        normals: a normal map, a .npy, or a folder of results.
        output: folder for the results.
        mask: an image that is bright on the object; by default where normals are not 0.
        normal_map: green is up (opengl) or down (directx), down and blue away from the
            viewer (opencv), or red to the left (x-left).
        as_stored: take the values as they are: what is certainly wrong with them is not
            mended.
        photograph: an image of the same size: colours of the mesh, and --focal exif.
        focal: focal length in pixels, or exif, of the photograph; without it the camera
            is orthographic.
        prior: known depth in the results' sense, an EXR (channel Z) or .npy, NaN where
            unknown; in pixels if orthographic.
        prior_weight: trust in the prior, against the normals.
        sharpness: how readily depth breaks; 0 never.
        scale: size of a pixel (orthographic), or the object's mean distance
            (perspective), in the unit.
        unit: of the scale, such as mm.
        mesh: also write a mesh.
        max_faces: simplify the mesh to this many triangles, and take a grid of as many
            for --export.
        export: also files for a purpose, one or more of blender, print, archive.
        directx: green is down in the normal map for Blender and games.
        cut: leave out triangles that range over more than this many pixels in depth.
    """

    normals: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="NORMALS")]
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    mask: Path | None = None
    normal_map: NormalMap = "opengl"
    as_stored: bool = False
    photograph: Path | None = None
    focal: Annotated[str | None, tyro.conf.arg(metavar="PIXELS|exif")] = None
    prior: Path | None = None
    prior_weight: float = 1e-4
    sharpness: float = 2.0
    scale: float = 1.0
    unit: str | None = None
    mesh: MeshFormat | None = None
    max_faces: int | None = None
    cut: float = 20.0
    export: tuple[Export, ...] = ()
    directx: bool = False


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips surface`."""
    options = parse(Options, argv, prog="unips surface", description=__doc__)
    _check(options)
    examined = read_normal_map(
        options.normals, options.normal_map, as_stored=options.as_stored
    )
    print_examined(examined)
    normals = examined.normals
    size = normals.shape[:2]
    mask = None
    if options.mask is not None:
        mask = read_mask(options.mask)
        require_size(options.mask, mask.shape, size)
    photograph = None
    if options.photograph is not None:
        photograph = read_image_file(options.photograph)
        require_size(options.photograph, photograph.pixels.shape[:2], size)
    prior = None if options.prior is None else _prior(options.prior, size)
    exif = None if photograph is None else photograph.focal
    focal = focal_of(options.focal, exif, options.photograph, size)
    colors = _base_color(options, size)
    if photograph is not None:
        require_finite(photograph.path, photograph.pixels)
        encoding = photograph.encoding
        pixels = encoding.values(photograph.pixels)
        colors = photograph_colors(pixels, transfer_of(photograph), encoding.to_srgb)
    names = (field.name for field in dataclasses.fields(SurfaceOptions))
    given = {name: getattr(options, name) for name in names} | {"focal": focal}
    start_jax()
    with (
        appearing_at_once(options.output, record=RECORD) as place,
        progress("integrating") as report,
    ):
        facts = write_surface(
            place,
            normals,
            mask,
            SurfaceOptions(**given),
            prior=prior,
            colors=colors,
            progress=lambda share: report(round(100 * share), 100),
        )
        exported = _exports(options, place, normals, facts, colors)
        written = sorted(file.name for file in place.iterdir())
        record = {
            "normals": str(options.normals),
            "mended": examined.mended,
            "warnings": examined.doubts,
            **facts,
            "exports": exported,
            "files": written,
        }
        write_json(place / RECORD, record, indent=2)
        if "archive" in options.export:
            exported["archive"] = _write_archive(options, place)
            written = sorted([*written, f"{_name(options.normals)}.zip"])
            write_json(place / RECORD, {**record, "files": written}, indent=2)
    print_surface(facts)
    print_line("wrote", f"{options.output}/: {', '.join([*written, RECORD])}")


def _base_color(options: Options, size: tuple[int, ...]) -> np.ndarray | None:
    """Colours of a folder of results that has some: `[H, W, 3]`, uint8, sRGB."""
    path = options.normals / "base_color.png"
    if not path.is_file():
        return None
    pixels = read_image_file(path).pixels
    require_size(path, pixels.shape[:2], size)
    return photograph_colors(pixels, "srgb")


def _exports(
    options: Options,
    place: Path,
    normals: np.ndarray,
    facts: dict[str, Any],
    colors: np.ndarray | None,
) -> dict[str, Any]:
    """Writes models that `--export` asks for; gives what the record states of them."""
    if not options.export:
        return {}
    depth = read_depth(place / "depth.exr")
    name = _name(options.normals)
    scale = Scale(facts["focal_px"], facts["scale"], facts["unit"])
    made: dict[str, Any] = {}
    if "blender" in options.export:
        base_color = _base_color(options, normals.shape[:2])
        colors = colors if base_color is None else base_color
        data, made["blender"] = blender_model(
            depth,
            normals,
            scale,
            name=name,
            colors=colors,
            max_faces=options.max_faces,
            cut=options.cut,
            directx=options.directx,
        )
        write_whole(place / f"{name}.glb", data, sync=False)
    if "print" in options.export:
        data, made["print"] = printable(depth, scale, max_faces=options.max_faces)
        write_whole(place / f"{name}.stl", data, sync=False)
    return made


def _write_archive(options: Options, place: Path) -> list[str]:
    """Writes a ZIP of the results and of all that is in `place`; gives their names."""
    name = _name(options.normals)
    files = {file.name: file for file in results_of(options.normals)}
    files |= {file.name: file for file in place.iterdir()}
    written = [files[key] for key in sorted(files)]
    own = options.normals
    packed = archive(
        name, written, normal_map_of(own) if own.is_dir() else options.normal_map
    )
    write_whole(place / f"{name}.zip", packed, sync=False)
    return sorted(files)


def _name(normals: Path) -> str:
    """That of the object: of a folder its name, of a file less its suffix."""
    place = normals.resolve()
    name = place.name if place.is_dir() else place.stem
    return os.fsencode(name).decode(errors="replace")


def _check(options: Options) -> None:
    for name in ("scale", "cut", "max_faces"):
        value = getattr(options, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            option = name.replace("_", "-")
            raise InputError(f"--{option}: expected above 0, got {value}")
    for name in ("prior_weight", "sharpness"):
        value = getattr(options, name)
        if not (np.isfinite(value) and value >= 0):
            option = name.replace("_", "-")
            raise InputError(f"--{option}: expected 0 or more, got {value}")
    model = "blender" in options.export
    shaped = options.mesh or model or "print" in options.export
    for option, used, needs in (
        ("max_faces", shaped, "--mesh, --export blender or print"),
        ("directx", model, "--export blender"),
    ):
        if getattr(options, option) and not used:
            raise InputError(
                f"--{option.replace('_', '-')}: expected something to use it for, got "
                f"none; add {needs}"
            )
    if options.scale != 1 and options.unit is None:
        raise InputError(
            f"--scale {options.scale:g}: expected its unit, got none; add --unit mm or "
            "another"
        )
    if (model or "print" in options.export) and options.unit not in (None, *METRES):
        raise InputError(
            f"--unit {options.unit}: expected one of {', '.join(METRES)} with --export "
            "blender or print, which have a size, got another; convert --scale"
        )
    if model and options.mesh == "glb" and _name(options.normals) == "mesh":
        raise InputError(
            "--export blender: expected another name than that of --mesh glb, got "
            f"mesh.glb for both; rename {options.normals}"
        )
    if options.mesh is not None:
        check_mesh_file(Path(f"mesh.{options.mesh}"))
    check_target(options.output, options.normals, record=RECORD)


def _prior(path: Path, size: tuple[int, int]) -> np.ndarray:
    prior = (
        read_numbers(path).astype(np.float32)
        if path.suffix == ".npy"
        else read_depth(path)
    )
    require_size(path, prior.shape, size)
    return prior


if __name__ == "__main__":
    sys.exit(main())
