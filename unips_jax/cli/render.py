"""Scenes with known normals, as folders of photographs or a sheet.

The folders follow PS-Wild-Test: one per object and lighting, with 16-bit linear images
L_*.png, mask.png, and normal.tif (n = 2 v / 65535 - 1, x right, y up, z to the viewer,
background 32768); meta.json holds what was drawn. Under directional light it holds
light_directions and light_intensities, such that a Lambertian surface appears as
albedo x intensity x max(n . l, 0). Stop it whenever you like: started again, or several
times at once, it only does what is left.

With --engine cycles, Blender Cycles renders instead; that has options of its own: see
`unips render --engine cycles --help`.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from unips_jax.console import command, one_of, parse, start_jax
from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.io.images import check_picture
from unips_jax.scenes.config import SHAPE_KINDS


@dataclasses.dataclass(frozen=True)
class _Engine:
    engine: Literal["jax", "cycles"] = "jax"


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips render`.

    Attributes:
        output: folder for PS-Wild folders.
        sheet: picture of 64 random scenes, .png, .jpg or .tif.
        objects: how many, each under three lightings.
        images: per folder.
        size: side of the images in pixels, a multiple of 4.
        seed: of the scenes.
        shapes: of the objects, and of the sheet's rows, in turn; any without.
        engine: what renders.
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = None
    sheet: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    objects: int = 6
    images: int = 8
    size: int = 128
    seed: int = 0
    shapes: Annotated[tuple[str, ...], one_of(SHAPE_KINDS, several=True)] = ()
    engine: Literal["jax", "cycles"] = "jax"


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips render`."""
    engine, rest = tyro.cli(
        _Engine, args=argv, return_unknown_args=True, add_help=False
    )
    if engine.engine == "cycles":
        from unips_jax.cli import render_cycles

        return render_cycles.run(rest)
    options = parse(Options, argv, prog="unips render", description=__doc__)
    if options.output is None and options.sheet is None:
        raise InputError("expected -o DIR, --sheet OUT.png or both, got neither")
    if options.size <= 0 or options.size % 4:
        raise InputError(f"--size: expected a multiple of 4, got {options.size}")
    for name, least in (("objects", 1), ("images", 1), ("seed", 0)):
        value = getattr(options, name)
        if value < least:
            raise InputError(f"--{name}: expected at least {least}, got {value}")
    if options.seed >= 2**32:
        raise InputError(f"--seed: expected less than 2^32, got {options.seed}")
    if options.output is not None:
        make_folder(options.output, "-o")
    if options.sheet is not None:
        check_picture(options.sheet, "--sheet")
    start_jax()
    from unips_jax.scenes.folders import render_folders, render_sheet

    if options.sheet is not None:
        render_sheet(
            options.sheet, size=options.size, seed=options.seed, shapes=options.shapes
        )
        print(f"wrote {options.sheet}")
    if options.output is not None:
        render_folders(
            options.output,
            objects=options.objects,
            images=options.images,
            size=options.size,
            seed=options.seed,
            shapes=options.shapes,
        )
        print(f"wrote {options.output}")


if __name__ == "__main__":
    sys.exit(main())
