"""A result as one HTML file, to look at and to measure.

RESULT is a folder of results of `unips estimate`. The page opens from disk, asks for no
network, and shows the surface lit by a light that follows the pointer, in environments,
as a turning 3D surface, its normals, depth and photographs, each against another.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from unips_jax.console import command, parse, start_jax
from unips_jax.errors import InputError
from unips_jax.io.record import print_line
from unips_jax.viewer.page import with_depth, write_view
from unips_jax.viewer.result import read_result


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips view`.

    Attributes:
        result: folder that `unips estimate` wrote.
        output: the page; RESULT/view.html if not given.
        photographs: folder of the photographs, if they were moved.
        flat: without a surface, where the results hold no depth: it is not integrated.
    """

    result: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULT")]
    output: Annotated[
        Path | None, tyro.conf.arg(aliases=["-o"], metavar="VIEW.html")
    ] = None
    photographs: Path | None = None
    flat: bool = False


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips view`."""
    options = parse(Options, argv, prog="unips view", description=__doc__)
    target = options.output or options.result / "view.html"
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"-o {target}: expected a name that ends in .html")
    if target.is_dir():
        raise InputError(f"-o {target}: expected a file, got a folder; name it")
    result = read_result(options.result, options.photographs)
    if result.depth is None and not options.flat:
        start_jax()
        result = with_depth(result)
    write_view(target, result)
    size = target.stat().st_size / 1e6
    print_line("wrote", f"{target} ({size:.1f} MB): open it in a browser")


if __name__ == "__main__":
    sys.exit(main())
