"""Looks for what is wrong with folders of photographs, before an estimate.

Photographs that moved, repeat each other, are too bright, too dark or out of focus,
light from one side only, masks with holes, files that do not fit together: each is one
line that names the photographs and says what to do. Nothing is written. `unips
estimate` says the same of what it takes.

A normal map, or an array of normals (.npy), is looked at too: its range and lengths,
its background, its axes, as `unips surface` and `unips relight` do.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from unips_jax.capture.folder import Report, check_photographs
from unips_jax.capture.unpack import is_container, unpacked, without_place
from unips_jax.console import command, expanded, parse, require_patterns
from unips_jax.errors import InputError
from unips_jax.io.images import MAX_PIXELS
from unips_jax.io.normal_maps import Examined, is_normal_map, read_normal_map
from unips_jax.io.normals import NormalMap
from unips_jax.io.record import print_line, print_selection
from unips_jax.io.selection import select


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips check`.

    Attributes:
        folders: photographs of an object; or a file that holds them, a video or a TIFF
            of several pages; or a normal map.
        mask: an image that is bright on the object, in place of the folder's mask;
            auto: the folder's, else a suggested one; none: the whole image.
        include: patterns such as "img_*.png": the images they fit are the photographs.
        exclude: patterns of files to leave out.
        transfer: how the photographs encode light (auto: by their colour tags).
        max_pixels: refuse larger images.
        normal_map: convention of normal maps; see `unips surface`.
        json: print a list of JSON objects, one a folder, and nothing else.
    """

    folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="DIR [DIR ...]", help_behavior_hint=""),
    ]
    mask: Annotated[
        Literal["auto", "none"] | Path, tyro.conf.arg(metavar="auto|none|FILE")
    ] = "auto"
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    transfer: Literal["auto", "linear", "srgb"] = "auto"
    max_pixels: int = MAX_PIXELS
    normal_map: NormalMap = "opengl"
    json: bool = False


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips check`."""
    options = parse(Options, argv, prog="unips check", description=__doc__)
    if not options.folders:
        raise InputError("expected a folder of photographs, got none; name it")
    require_patterns(options.include, options.exclude)
    records, failed = [], []
    folders = [*expanded(options.folders)]
    for folder in folders:
        try:
            records.append(_looked_at(folder, options))
        except InputError as error:
            if len(folders) == 1:
                raise
            print(f"error: {error}", file=sys.stderr)
            failed.append(str(folder))
    if options.json:
        print(json.dumps(records, indent=2))  # in any console's encoding
    if failed:
        raise InputError(
            f"{len(failed)} of {len(folders)} could not be looked at: "
            f"{', '.join(failed)}"
        )


def _looked_at(folder: Path, options: Options) -> dict[str, Any]:
    """What is found in a folder or a normal map; printed, unless as JSON."""
    if is_normal_map(folder):
        _require_none_of_photographs(folder, options)
        found = read_normal_map(folder, options.normal_map)
        if not options.json:
            _print_normal_map(folder, found)
        return _normal_map_record(folder, found)
    report = _check(folder, options)
    if not options.json:
        _print(report)
    return report.record()


def _require_none_of_photographs(path: Path, options: Options) -> None:
    names = ("mask", "include", "exclude", "transfer", "max_pixels")
    given = [n for n in names if getattr(options, n) != getattr(Options, n)]
    if given:
        shown = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise InputError(
            f"{path}: expected options of a normal map, got {shown}, of photographs; "
            "leave them out, or name a folder"
        )


def _check(folder: Path, options: Options, source: Path | None = None) -> Report:
    if is_container(folder):
        with unpacked(folder, max_pixels=options.max_pixels) as place:
            report = _check(place, options, folder)
            return report.renamed(lambda text: without_place(text, place, folder))
    selection = select(
        folder,
        mask_file=options.mask if isinstance(options.mask, Path) else None,
        include=options.include,
        exclude=options.exclude,
        masks=options.mask != "none",
    )
    selection = dataclasses.replace(selection, source=source)
    return check_photographs(
        selection,
        transfer=None if options.transfer == "auto" else options.transfer,
        look_for_mask=options.mask == "auto",
        max_pixels=options.max_pixels,
    )


def _normal_map_record(path: Path, found: Examined) -> dict[str, Any]:
    height, width, _ = found.normals.shape
    return {
        "normals": str(path),
        "width": width,
        "height": height,
        "pixels": int((found.normals != 0).any(-1).sum()),
        "integrability": round(found.integrability, 3),
        "mended": found.mended,
        "findings": found.doubts,
    }


def _print_normal_map(path: Path, found: Examined) -> None:
    record = _normal_map_record(path, found)
    size = f"{record['width']} x {record['height']}"
    print(f"{path}: normals of {record['pixels']} of {size} pixels")
    print_line("slopes", f"correlation of dp/dy and dq/dx: {found.integrability:+.2f}")
    for text in found.mended:
        print_line("normals", text)
    for text in found.doubts:
        print_line("look", text)
    if any("--" in text for text in (*found.mended, *found.doubts)):
        print_line("", "options named here are of `unips surface` and `unips relight`")
    if not (found.mended or found.doubts):
        print_line("", "nothing found that is wrong")


def _print(report: Report) -> None:
    print_selection(report.selection)
    record = report.record()
    if report.capture is not None:
        what = record["mask"] or "none"
        if record["mask_suggested"]:
            rule, figure = record["mask_rule"], record["mask_contrast"]
            what = f"suggested by {rule} ({figure:.2f})"
        size = f"{record['width']} x {record['height']}"
        print_line("mask", f"{what}: {record['mask_pixels']} of {size} pixels")
        print_line("transfer", f"{record['transfer']} ({record['transfer_rule']})")
        for note in record["notes"]:
            print_line("note", note)
    for finding in report.findings:
        print_line("look", finding.text)
    if not report.findings:
        print_line("", "nothing found that is wrong")


if __name__ == "__main__":
    sys.exit(main())
