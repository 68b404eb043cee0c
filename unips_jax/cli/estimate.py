"""Normals from folders of photographs.

For each folder, OUT/NAME/ receives normals.png (16 bit), normals.npy, sheet.png (a
picture to judge the result by) and normals.json (how it came about); NAME is the
folder's name without ".data". The results have the photographs' size and place. Either
all of a folder's files appear or none; started again, the command does what is left.

With --pause, a folder holds photographs of several places of the camera, one after the
other: NAME-00, NAME-01, ... receive a view's normals each.
"""

import contextlib
import dataclasses
import functools
import glob
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import tyro

from unips_jax.capture.views import views_by_time
from unips_jax.cli.cluster import RayOptions, spread
from unips_jax.console import (
    command,
    expanded,
    parse,
    reason_of,
    require_patterns,
    start_jax,
)
from unips_jax.errors import InputError
from unips_jax.estimation.folders import (
    NamedNetwork,
    estimate_folder,
    load_network,
    random_network,
)
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.reading import chosen_photographs
from unips_jax.io.naming import composed
from unips_jax.io.record_schema import load_record
from unips_jax.io.results import RECORD, check_target, clear_leftovers
from unips_jax.io.selection import folder_name


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips estimate`.

    Attributes:
        folders: photographs of an object; or a file that holds them, a video or a TIFF
            of several pages.
        output: folder for the results.
        weights: shipped weights or a .safetensors file.
        random_weights: an untrained network, for tests: the normals mean nothing.
        pause: seconds; where more than this went by between two photographs of a
            folder, by their EXIF data, another view begins, with results of its own.
        overwrite: also estimate what the same photographs, weights and options gave
            before.
        how: how photographs are read, and what is written.
        where: where folders are worked on.
    """

    folders: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="DIR [DIR ...]", help_behavior_hint=""),
    ]
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    weights: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "tiny"
    random_weights: bool = False
    pause: float | None = None
    overwrite: bool = False
    how: Annotated[FolderOptions, tyro.conf.arg(name="")] = FolderOptions()
    where: Annotated[RayOptions, tyro.conf.arg(name="")] = RayOptions()


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips estimate`."""
    options = parse(Options, argv, prog="unips estimate", description=__doc__)
    options.how.check()
    require_patterns(options.how.include, options.how.exclude)
    if options.where.ray:
        options.where.check()
    jobs, failed = _jobs(options)
    for job in jobs:
        check_target(job.target, job.folder)
    clear_leftovers(options.output)
    if options.where.ray:
        pieces = [(job.title, (job, options)) for job in jobs]
        reasons = spread(_estimate_one, pieces, options.where, "estimating")
        for reason in reasons.values():
            print(f"error: {reason}", file=sys.stderr)
        return _report([*failed, *reasons], jobs, options.output)
    start_jax()
    network = _network(options)
    for job in jobs:
        try:
            estimate_folder(
                job.folder,
                job.target,
                network,
                job.how,
                overwrite=options.overwrite,
                verbose=True,
            )
        except BrokenPipeError:
            raise
        except Exception as error:
            if len(jobs) + len(failed) == 1:
                raise
            # A batch goes on, whatever befell one folder.
            text = reason_of(error) or f"{job.title}: {type(error).__name__}: {error}"
            print(f"error: {' '.join(text.split())}", file=sys.stderr)
            failed.append(job.title)
    _report(failed, jobs, options.output)


def _network(options: Options) -> NamedNetwork:
    if options.random_weights:
        return random_network(options.how.seed)
    return load_network(options.weights)


_cached_network = functools.lru_cache(maxsize=1)(_network)


def _estimate_one(piece: tuple["_Job", Options]) -> None:
    """One folder, in a process that may have had others before."""
    job, options = piece
    start_jax()
    network = _cached_network(dataclasses.replace(options, folders=()))
    estimate_folder(
        job.folder, job.target, network, job.how, overwrite=options.overwrite
    )


def _report(failed: list[str], jobs: list["_Job"], output: Path) -> None:
    if failed:
        every = {*failed, *(job.title for job in jobs)}
        others = f"; the others are in {output}" * (len(failed) < len(every))
        raise InputError(
            f"{len(failed)} of {len(every)} folders gave no normals: "
            f"{', '.join(failed)}{others}"
        )


class _Job(NamedTuple):
    """A folder, or one view of it, the place of its results, and how it is read."""

    folder: Path
    target: Path
    how: FolderOptions

    @property
    def title(self) -> str:
        """What messages call it."""
        if self.target.name == folder_name(self.folder):
            return str(self.folder)
        return f"{self.folder} ({self.target.name})"


def _jobs(options: Options) -> tuple[list[_Job], list[str]]:
    """What is to be estimated: every folder, or every view of them.

    Also the folders of several whose views cannot be told apart, which are named.
    """
    if not options.folders:
        raise InputError("expected a folder of photographs, got none; name it")
    if options.random_weights and options.weights != "tiny":
        raise InputError(
            f"--weights {options.weights}: expected one choice of weights, got "
            "--random-weights too; leave one out"
        )
    jobs: dict[Path, _Job] = {}
    failed = []
    folders = list(dict.fromkeys(expanded(options.folders)))
    for folder in folders:
        target = options.output / folder_name(folder)
        if options.pause is None:
            found = [_Job(folder, target, options.how)]
        else:
            try:
                found = _views(folder, target, options.how, options.pause)
            except InputError as error:
                if len(folders) == 1:
                    raise
                print(f"error: {error}", file=sys.stderr)
                failed.append(str(folder))
                continue
        for job in found:
            place = job.target
            if sys.platform == "darwin":  # there Bust and bust are one folder
                place = place.with_name(composed(place.name).casefold())
            if place in jobs:
                raise InputError(
                    f"{job.title}: expected folders of different names, or views, got "
                    f"one named as that of {jobs[place].title}; run them one by one "
                    "with different -o"
                )
            jobs[place] = job
    return list(jobs.values()), failed


def _views(folder: Path, target: Path, how: FolderOptions, pause: float) -> list[_Job]:
    """A folder's views, by the times of its photographs."""
    if not pause >= 0:
        raise InputError(f"--pause: expected seconds, 0 or more, got {pause}")
    if folder.is_file():
        raise InputError(
            f"--pause: expected a folder of photographs with times, got {folder}; "
            "leave --pause out"
        )
    selection = chosen_photographs(folder, dataclasses.replace(how, max_images=None))
    mask = how.mask if isinstance(how.mask, Path) else selection.mask_file
    if mask is not None and how.mask != "none":
        raise InputError(
            f"{mask}: expected no mask with --pause, since views differ; put the "
            "photographs of each view into a folder of their own, with its mask, or "
            "give --mask none"
        )
    views = views_by_time(selection.files, pause, max_pixels=how.max_pixels)
    counts = " + ".join(str(len(view)) for view in views)
    print(f"{folder}: {len(views)} views, of {counts} photographs")
    if earlier := _earlier_views(target, len(views)):
        print(
            f"warning: {folder}: {', '.join(earlier)} in {target.parent}: views of an "
            "earlier run, which this one does not have; remove them",
            file=sys.stderr,
        )
    return [
        _Job(
            folder,
            target.with_name(f"{target.name}-{index:02}"),
            dataclasses.replace(how, include=tuple(glob.escape(f.name) for f in view)),
        )
        for index, view in enumerate(views)
    ]


def _earlier_views(target: Path, count: int) -> list[str]:
    """Results of further views of a folder of this name, from another --pause."""
    found = []
    for place in sorted(target.parent.glob(f"{glob.escape(target.name)}-*")):
        number = place.name.removeprefix(f"{target.name}-")
        if re.fullmatch("[0-9]{2,}", number) and int(number) >= count:
            with contextlib.suppress(InputError):
                made_of = Path(load_record(place / RECORD).get("folder", ""))
                if made_of.name.removesuffix(".data") == target.name:
                    found.append(place.name)
    return found


if __name__ == "__main__":
    sys.exit(main())
