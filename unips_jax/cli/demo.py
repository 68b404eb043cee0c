"""`unips demo`: normals of the bundled object, compared with the truth.

The object was rendered with Blender Cycles, eight photographs under a lamp and a
turning environment: `unips render --engine cycles --objects 2 --images 8 --size 192
--samples 64 --denoise --environments blender --lightings mixed --seed 11`.
"""

import argparse
import importlib.resources
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unips_jax.console import command, keep_compiled, progress
from unips_jax.io.normals import (
    appearing_at_once,
    check_target,
    write_normals,
    write_record,
)
from unips_jax.io.ps_wild import PSWildFolders, read_object
from unips_jax.pictures.estimate_sheet import write_sheet

SAMPLE = Path(str(importlib.resources.files("unips_jax"))) / "assets" / "sample"
SIDE = 192  # of its images, in pixels


def _main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="unips demo", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("unips_demo"))
    parser.add_argument("--weights", default="tiny", help="shipped name or file")
    arguments = parser.parse_args(argv)
    check_target(arguments.output, SAMPLE)
    keep_compiled()

    from unips_jax.estimation.streaming import estimate_photographs
    from unips_jax.metrics import mean_angular_error_deg
    from unips_jax.weights import load_weights

    config, params = load_weights(arguments.weights)
    files = PSWildFolders(SAMPLE, min_images=1)[0]
    sample = read_object(files, np.arange(len(files.photographs)), SIDE)
    images, mask, truth = (sample[name] for name in ("images", "mask", "normals"))
    with progress("estimating normals") as report:
        normals = estimate_photographs(
            params, images, mask, config=config, progress=report
        )
    error = float(mean_angular_error_deg(normals, truth, mask))
    towards = np.array([0.0, 0.0, 1.0])
    constant = float(mean_angular_error_deg(towards, truth, mask))
    scores = f"mean angular error {error:.2f} degrees (constant normal {constant:.2f})"
    with appearing_at_once(arguments.output) as place:
        write_normals(place, normals)
        for name, shown in (("sheet", normals), ("truth", truth)):
            write_sheet(
                place / f"{name}.png",
                images / images.max(axis=(1, 2, 3), keepdims=True),
                shown,
                mask,
                title="estimated" if name == "sheet" else "true normals",
                subtitle=scores if name == "sheet" else "the same object",
                encoded=False,
            )
        record = {"mae_deg": error, "constant_mae_deg": constant}
        write_record(place, {**record, "weights": str(arguments.weights)})
    print(f"{len(images)} photographs, {scores}")
    print(f"wrote {arguments.output}/: sheet.png, truth.png, normals.png, normals.npy")


main = command(_main)

if __name__ == "__main__":
    raise SystemExit(main())
