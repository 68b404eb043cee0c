"""`unips render`: scenes with known normals, as folders of photographs or a sheet.

The folders follow PS-Wild-Test: one per object and lighting, with 16-bit linear
images `L_*.png`, `mask.png`, and `normal.tif` (n = 2 v / 65535 - 1, x right, y up,
z to the viewer, background 32768); `meta.json` says what was drawn.
Under directional light it holds `light_directions` and `light_intensities`, such that a
Lambertian surface appears as albedo x intensity x max(n . l, 0).
`--engine cycles` renders with Blender Cycles instead, and has options of its own: see
`unips render --engine cycles --help`.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.io.images import check_picture
from unips_jax.scenes.folders import render_folders, render_sheet


def _main(argv: Sequence[str] | None = None) -> None:
    chooser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chooser.add_argument("--engine", choices=("jax", "cycles"), default="jax")
    engine, rest = chooser.parse_known_args(argv)
    if engine.engine == "cycles":
        from unips_jax.cycles import command as cycles

        return cycles.main(rest)
    parser = argparse.ArgumentParser(
        prog="unips render",
        description=__doc__,
        parents=[chooser],
        allow_abbrev=False,  # nor does the chooser take an engine's abbreviation
    )
    parser.add_argument("-o", "--output", type=Path, help="folder for PS-Wild folders")
    parser.add_argument("--sheet", type=Path, help="picture of 64 random scenes")
    parser.add_argument("--objects", type=int, default=6, help="(6)")
    parser.add_argument("--images", type=int, default=8, help="per folder (8)")
    parser.add_argument("--size", type=int, default=128, help="in pixels (128)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(rest)
    if options.output is None and options.sheet is None:
        raise InputError("expected -o DIR, --sheet OUT.png or both, got neither")
    if options.size <= 0 or options.size % 4:
        raise InputError(f"--size: expected a multiple of 4, got {options.size}")
    for name in ("objects", "images"):
        if getattr(options, name) < 1:
            raise InputError(
                f"--{name}: expected at least 1, got {getattr(options, name)}"
            )
    if options.output is not None:
        make_folder(options.output, "-o")
    if options.sheet is not None:
        check_picture(options.sheet, "--sheet")
        render_sheet(options.sheet, size=options.size, seed=options.seed)
        print(f"wrote {options.sheet}")
    if options.output is not None:
        render_folders(
            options.output,
            objects=options.objects,
            images=options.images,
            size=options.size,
            seed=options.seed,
        )
        print(f"wrote {options.output}")


main = command(_main)
