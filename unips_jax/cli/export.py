"""The network as files for other programs, which need neither this package nor Flax.

--format onnx writes OUT/encoder.onnx and OUT/decoder.onnx, for onnxruntime in any
language and in browsers; stablehlo writes OUT/estimate.stablehlo, one function of
photographs and mask, for JAX. Parameters are inside, numbers and sizes of photographs
free. OUT/export.json says what is in them.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from unips_jax.console import command, parse, start_jax
from unips_jax.export.files import RECORD, Format, write_export
from unips_jax.io.record import print_line
from unips_jax.io.results import check_target
from unips_jax.weights import load_weights, weights_path


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips export`.

    Attributes:
        format: of the files.
        output: folder for the files.
        weights: shipped weights or a .safetensors file.
        half: round parameters to half precision, for half the size; those that it holds
            exactly, as the shipped ones, are stored so in any case.
    """

    format: Format
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    weights: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "tiny"
    half: bool = False


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips export`."""
    options = parse(Options, argv, prog="unips export", description=__doc__)
    source = weights_path(options.weights)
    check_target(options.output, source.parent, record=RECORD)
    start_jax()
    record = write_export(
        options.output,
        load_weights(options.weights),
        format=options.format,
        name=options.weights,
        half=options.half,
    )
    sizes = (
        f"{name} ({(options.output / name).stat().st_size / 1e6:.1f} MB)"
        for name in record["files"]
    )
    print_line("wrote", f"{options.output}/: {', '.join([*sizes, RECORD])}")


if __name__ == "__main__":
    sys.exit(main())
