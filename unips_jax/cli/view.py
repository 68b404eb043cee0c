"""A result as one HTML file, to look at and to measure.

RESULT is a folder of results of `unips estimate`. The page opens from disk, asks for no
network, and shows the surface lit by a light that follows the pointer, in environments,
as a turning 3D surface, its normals, depth and photographs, each against another.
Notes, views and a scale that were saved into the page that is there are kept.
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
from unips_jax.io.results import check_target
from unips_jax.viewer.page import (
    FOLDER_RECORD,
    notes_in,
    shown_title,
    title_in,
    with_depth,
    write_tiled_view,
    write_view,
)
from unips_jax.viewer.result import read_result


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips view`.

    Attributes:
        result: folder that `unips estimate` wrote.
        output: the page; RESULT/view.html if not given. With --tiles a folder;
            RESULT_view if not given.
        photographs: folder of the photographs, if they were moved.
        flat: without a surface, where the results hold no depth: it is not integrated.
        tiles: a folder with a page that zooms in to the photographs' own pixels, in
            place of one file of at most 1024 x 1024.
        pixel_mm: side of a pixel on the object, in millimetres. Lengths can be measured
            in the page, too.
    """

    result: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULT")]
    output: Annotated[
        Path | None, tyro.conf.arg(aliases=["-o"], metavar="VIEW.html")
    ] = None
    photographs: Path | None = None
    flat: bool = False
    tiles: bool = False
    pixel_mm: Annotated[float | None, tyro.conf.arg(metavar="MM")] = None


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips view`."""
    options = parse(Options, argv, prog="unips view", description=__doc__)
    target = _target(options)
    if options.pixel_mm is not None and not 0 < options.pixel_mm < float("inf"):
        raise InputError(f"--pixel-mm {options.pixel_mm}: expected a length above 0")
    result = read_result(options.result, options.photographs)
    result = dataclasses.replace(result, pixel_mm=options.pixel_mm)
    page = target / "index.html" if options.tiles else target
    if options.output is not None:
        _check_notes(page, result.title)
    if result.depth is None and not options.flat:
        start_jax()
        result = with_depth(result)
    if options.tiles:
        count = write_tiled_view(target, result)
        print_line("wrote", f"{page} and {count} tiles: open it in a browser")
        return
    write_view(target, result)
    size = target.stat().st_size / 1e6
    print_line("wrote", f"{target} ({size:.1f} MB): open it in a browser")


def _target(options: Options) -> Path:
    """Where the page goes, checked before there is work."""
    if options.tiles:
        name = f"{options.result.resolve().name}_view"
        target = options.output or options.result.resolve().parent / name
        check_target(target, options.result, record=FOLDER_RECORD)
        return target
    target = options.output or options.result / "view.html"
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"-o {target}: expected a name that ends in .html")
    if target.is_dir():
        raise InputError(f"-o {target}: expected a file, got a folder; name it")
    return target


def _check_notes(page: Path, title: str) -> None:
    """The notes that a page keeps are on the object that it shows."""
    kept = notes_in(page) or {}
    some = kept.get("notes") or kept.get("views") or (kept.get("scale") or {}).get("mm")
    title = shown_title(title)
    if some and title_in(page) != title:
        raise InputError(
            f"{page}: expected a new page, or one of {title}, got notes on "
            f"{title_in(page)}; name another with -o, or delete this one"
        )


if __name__ == "__main__":
    sys.exit(main())
