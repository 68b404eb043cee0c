"""`unips estimate DIR... -o OUT`: normals from folders of photographs.

For each folder `OUT/NAME/` receives `normals.png` (16 bit), `normals.npy`,
`sheet.png` (a picture to judge the result by) and `normals.json` (how it came about);
NAME is the folder's name without `.data`. The results have the photographs' size and
place. Either all of a folder's files appear or none.

Transfer function: 8-bit files are taken as sRGB encoded, since cameras, phones and
programs write them so; 16-bit and float files as linear, since raw converters for
measurement, data sets and renderers write those so. `--transfer` overrules it.
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from unips_jax.config import ModelConfig
from unips_jax.console import command, keep_compiled, progress, track
from unips_jax.errors import InputError
from unips_jax.io.advice import capture_warnings
from unips_jax.io.color import Transfer
from unips_jax.io.normals import (
    NormalMap,
    appearing_at_once,
    check_target,
    write_normals,
    write_record,
)
from unips_jax.io.official import read_official
from unips_jax.io.photographs import (
    Capture,
    Selection,
    folder_name,
    read_capture,
    select,
)
from unips_jax.io.record import (
    make_record,
    print_line,
    print_record,
    print_selection,
    summary,
)
from unips_jax.pictures.estimate_sheet import write_sheet

DEFAULT_WEIGHTS = "tiny"


@dataclasses.dataclass(frozen=True)
class _Network:
    """A network, and the record of where its parameters come from."""

    config: ModelConfig
    params: Any
    record: dict[str, Any]


def _main(argv: Sequence[str] | None = None) -> None:
    arguments = _parser().parse_args(argv)
    _check_reader(arguments)
    targets = _targets(arguments.folders, arguments.output)
    keep_compiled()
    network = _load_network(arguments)
    failed = []
    for folder, target in targets.items():
        try:
            _estimate_folder(folder, target, network, arguments)
        except BrokenPipeError:
            raise
        except Exception as error:
            if len(targets) == 1:
                raise
            # A batch goes on, whatever befell one folder.
            text = f"{folder}: {type(error).__name__}: {error}"
            text = str(error) if isinstance(error, InputError) else text
            print(f"error: {' '.join(text.split())}", file=sys.stderr)
            failed.append(str(folder))
    if failed:
        raise InputError(
            f"{len(failed)} of {len(targets)} folders gave no normals: "
            f"{', '.join(failed)}; the others are in {arguments.output}"
        )


main = command(_main)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="unips estimate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("folders", nargs="+", type=Path, metavar="DIR", help="photographs of an object")
    add("-o", "--output", required=True, type=Path, metavar="OUT", help="results")
    add("--mask", type=Path, metavar="FILE", help="in place of each DIR's mask.png")
    add("--max-images", type=_positive, metavar="K", help="use K, drawn with --seed")
    add("--seed", type=_seed, default=0, help="seed of the draw (default 0)")
    add(
        "--transfer",
        choices=("auto", *get_args(Transfer)),
        default="auto",
        help="encoding of the photographs (auto: 8 bit is srgb, the rest linear)",
    )
    add(
        "--reader",
        choices=("plain", "official"),
        default="plain",
        help="official: the authors' square crop and resize; results have that size",
    )
    add(
        "--size",
        type=_positive,
        metavar="S",
        help="side that --reader official resizes to (default 512)",
    )
    add("--exr", action="store_true", help="also write normals.exr")
    add("--mat", action="store_true", help="also write normals.mat (key Normal_est)")
    add(
        "--normal-map",
        choices=get_args(NormalMap),
        default="opengl",
        help="green of PNG and EXR: up (opengl, default) or down (directx)",
    )
    weights = parser.add_mutually_exclusive_group()
    weights.add_argument(
        "--weights",
        default=DEFAULT_WEIGHTS,
        metavar="NAME|FILE",
        help=f"shipped weights or a .safetensors file (default {DEFAULT_WEIGHTS})",
    )
    weights.add_argument(
        "--random-weights",
        action="store_true",
        help="an untrained network, for tests: the normals mean nothing",
    )
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {value}")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected 0 or more, got {value}")
    return value


def _check_reader(arguments: argparse.Namespace) -> None:
    """The official reader has its own size and takes every file as linear."""
    official = arguments.reader == "official"
    if official and arguments.transfer == "srgb":
        raise InputError(
            "--transfer srgb: the authors' reader takes every file as linear; leave "
            "out --reader official"
        )
    if arguments.size is not None and not official:
        raise InputError(
            f"--size {arguments.size}: results have the photographs' size; leave it "
            "out, or add --reader official"
        )


def _targets(folders: Sequence[Path], output: Path) -> dict[Path, Path]:
    """The place of each folder's results."""
    targets: dict[Path, Path] = {}
    owners: dict[Path, Path] = {}
    for folder in dict.fromkeys(folders):
        target = output / folder_name(folder)
        if target in owners:
            raise InputError(
                f"{folder}: expected folders of different names, got one named as "
                f"{owners[target]}; run them one by one with different -o"
            )
        owners[target] = folder
        targets[folder] = target
    return targets


def _load_network(arguments: argparse.Namespace) -> _Network:
    from unips_jax import weights

    if arguments.random_weights:
        config = ModelConfig()
        params = weights.random_weights(config, seed=arguments.seed)
        name = f"random, seed {arguments.seed}"
    else:
        config, params = weights.load_weights(arguments.weights)
        name = arguments.weights
    record = {
        "name": name,
        "hash": weights.params_hash(config, params),
        "trained": not arguments.random_weights,
    }
    return _Network(config, params, record)


def _estimate_folder(
    folder: Path, target: Path, network: _Network, arguments: argparse.Namespace
) -> None:
    check_target(target, folder)
    selection = select(
        folder,
        mask_file=arguments.mask,
        max_images=arguments.max_images,
        seed=arguments.seed,
    )
    print_selection(selection)
    capture = _read(selection, arguments)
    warnings = capture_warnings(capture.images, capture.mask, selection.names)
    options = {
        "reader": arguments.reader,
        "transfer": capture.transfer,
        "max_images": arguments.max_images,
        "seed": arguments.seed,
        "normal_map": arguments.normal_map,
    }
    record = make_record(
        selection, capture.images, capture.mask, network.record, options, warnings
    )
    print_record(record)
    for warning in warnings:
        print(f"warning: {folder}: {warning}", file=sys.stderr)
    normals = _estimate(capture, network, official=arguments.reader == "official")
    with appearing_at_once(target) as place:
        write_normals(
            place,
            normals,
            exr=arguments.exr,
            mat=arguments.mat,
            normal_map=arguments.normal_map,
        )
        write_sheet(
            place / "sheet.png",
            capture.images,
            normals,
            capture.mask,
            title=target.name,
            subtitle=summary(record),
            encoded=capture.transfer == "srgb",
        )
        names = write_record(place, record)
    print_line("wrote", f"{target}/: {', '.join(names)}")


def _estimate(capture: Capture, network: _Network, *, official: bool) -> np.ndarray:
    from unips_jax.estimation.streaming import estimate_photographs

    with progress("estimating normals") as report:
        return estimate_photographs(
            network.params,
            capture.images,
            capture.mask,
            config=network.config,
            transfer=capture.transfer,
            frame="image" if official else "mask",
            progress=report,
        )


def _read(selection: Selection, arguments: argparse.Namespace) -> Capture:
    if arguments.reader == "official":
        images, mask, _ = read_official(selection, size=arguments.size or 512)
        return Capture(images, mask, "linear", None)
    capture = read_capture(
        selection, track=functools.partial(track, description="reading photographs")
    )
    if arguments.transfer != "auto":
        return dataclasses.replace(capture, transfer=arguments.transfer)
    return capture


if __name__ == "__main__":
    sys.exit(main())
