"""Normals of the bundled object, as `unips estimate` makes them, next to the truth.

OUT receives what `unips estimate` writes, with a map of the errors in sheet.png, and
truth.png, the same for the true normals. The object was rendered with Blender Cycles,
eight photographs under a lamp and a turning environment.
"""

# unips render --engine cycles --objects 2 --images 8 --size 192 --samples 64
#     --denoise --environments blender --lightings mixed --seed 11

import dataclasses
import importlib.resources
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from unips_jax.console import command, parse, start_jax
from unips_jax.estimation.folders import estimate_selection, load_network
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.writing import write_estimate
from unips_jax.io.ps_wild import PSWildFolders, read_object
from unips_jax.io.results import check_target
from unips_jax.io.selection import select
from unips_jax.pictures.estimate_sheet import write_sheet

SAMPLE = Path(str(importlib.resources.files("unips_jax"))) / "assets" / "sample"
SIDE = 192  # of its images, in pixels


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips demo`.

    Attributes:
        output: folder for the results.
        weights: shipped weights or a .safetensors file.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = Path(
        "unips_demo"
    )
    weights: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "tiny"


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips demo`."""
    options = parse(Options, argv, prog="unips demo", description=__doc__)
    files = PSWildFolders(SAMPLE, min_images=1)[0]
    folder = files.normals.parent
    check_target(options.output, folder)
    start_jax()
    from unips_jax.metrics import mean_angular_error_deg

    network = load_network(options.weights)
    how = FolderOptions()
    estimate = estimate_selection(select(folder), network, how, verbose=True)
    truth = read_object(files, np.arange(0), SIDE)["normals"]
    error, constant = (
        float(mean_angular_error_deg(normals, truth, estimate.mask))
        for normals in (estimate.normals, np.array([0.0, 0.0, 1.0]))
    )

    def write_truth(place: Path) -> None:
        write_sheet(
            place / "truth.png",
            estimate.images,
            truth,
            estimate.mask,
            title="true normals",
            subtitle="the same object",
            encoded=False,
        )

    write_estimate(
        options.output,
        estimate,
        how,
        truth=truth,
        facts={"mae_deg": error, "constant_mae_deg": constant},
        more=write_truth,
        verbose=True,
    )
    print(
        f"{len(estimate.images)} photographs, mean angular error {error:.2f} degrees "
        f"(constant normal {constant:.2f})"
    )


if __name__ == "__main__":
    sys.exit(main())
