"""Normals from folders of photographs.

For each folder, OUT/NAME/ receives normals.png (16 bit), normals.npy, sheet.png (a
picture to judge the result by) and normals.json (how it came about); NAME is the
folder's name without ".data". The results have the photographs' size and place. Either
all of a folder's files appear or none; started again, the command does what is left.
"""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from unips_jax.cli.cluster import RayOptions, spread
from unips_jax.console import command, parse, reason_of, start_jax
from unips_jax.errors import InputError
from unips_jax.estimation.folders import (
    NamedNetwork,
    estimate_folder,
    load_network,
    random_network,
)
from unips_jax.estimation.options import FolderOptions
from unips_jax.io.results import check_target, clear_leftovers
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
    overwrite: bool = False
    how: Annotated[FolderOptions, tyro.conf.arg(name="")] = FolderOptions()
    where: Annotated[RayOptions, tyro.conf.arg(name="")] = RayOptions()


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips estimate`."""
    options = parse(Options, argv, prog="unips estimate", description=__doc__)
    targets = _targets(options)
    options.how.check()
    if options.where.ray:
        options.where.check()
    for folder, target in targets.items():
        check_target(target, folder)
    clear_leftovers(options.output)
    if options.where.ray:
        pieces = [(str(f), (f, target, options)) for f, target in targets.items()]
        reasons = spread(_estimate_one, pieces, options.where, "estimating")
        for reason in reasons.values():
            print(f"error: {reason}", file=sys.stderr)
        return _report(list(reasons), targets, options.output)
    start_jax()
    network = _network(options)
    failed = []
    for folder, target in targets.items():
        try:
            estimate_folder(
                folder,
                target,
                network,
                options.how,
                overwrite=options.overwrite,
                verbose=True,
            )
        except BrokenPipeError:
            raise
        except Exception as error:
            if len(targets) == 1:
                raise
            # A batch goes on, whatever befell one folder.
            text = reason_of(error) or f"{folder}: {type(error).__name__}: {error}"
            print(f"error: {' '.join(text.split())}", file=sys.stderr)
            failed.append(str(folder))
    _report(failed, targets, options.output)


def _network(options: Options) -> NamedNetwork:
    if options.random_weights:
        return random_network(options.how.seed)
    return load_network(options.weights)


_cached_network = functools.lru_cache(maxsize=1)(_network)


def _estimate_one(piece: tuple[Path, Path, Options]) -> None:
    """One folder, in a process that may have had others before."""
    folder, target, options = piece
    start_jax()
    network = _cached_network(dataclasses.replace(options, folders=()))
    estimate_folder(folder, target, network, options.how, overwrite=options.overwrite)


def _report(failed: list[str], targets: dict[Path, Path], output: Path) -> None:
    if failed:
        raise InputError(
            f"{len(failed)} of {len(targets)} folders gave no normals: "
            f"{', '.join(failed)}; the others are in {output}"
        )


def _targets(options: Options) -> dict[Path, Path]:
    """The place of each folder's results."""
    if not options.folders:
        raise InputError("expected a folder of photographs, got none; name it")
    if options.random_weights and options.weights != "tiny":
        raise InputError(
            f"--weights {options.weights}: expected one choice of weights, got "
            "--random-weights too; leave one out"
        )
    targets: dict[Path, Path] = {}
    owners: dict[Path, Path] = {}
    for folder in dict.fromkeys(options.folders):
        target = options.output / folder_name(folder)
        if target in owners:
            raise InputError(
                f"{folder}: expected folders of different names, got one named as "
                f"{owners[target]}; run them one by one with different -o"
            )
        owners[target] = folder
        targets[folder] = target
    return targets


if __name__ == "__main__":
    sys.exit(main())
