"""Folders of photographs to folders of results: read, advise, estimate, write.

Transfer function: by the files' own colour tags, else by their type; see `io.color`.
`FolderOptions.transfer` overrules it.
"""

import dataclasses
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.capture.unpack import KEYFRAMES, is_container, unpacked
from unips_jax.console import progress
from unips_jax.errors import InputError
from unips_jax.estimation.beyond import Beyond, look_beyond, write_beyond
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.reading import chosen_photographs, dark_file, read_and_look
from unips_jax.io.color import Transfer
from unips_jax.io.images import write_image
from unips_jax.io.normals import write_normals
from unips_jax.io.record import (
    HashingReader,
    complete_record,
    input_record,
    print_line,
    print_record,
    print_selection,
    same_inputs,
    summary,
)
from unips_jax.io.results import (
    appearing_at_once,
    check_target,
    clear_leftovers,
    read_record,
    write_record,
)
from unips_jax.io.selection import Selection
from unips_jax.models.config import ModelConfig
from unips_jax.pictures.estimate_sheet import write_sheet
from unips_jax.provenance import code_hash
from unips_jax.surface.outputs import (
    focal_of,
    mean_colors,
    print_surface,
    write_surface,
)

Progress = Callable[[int, int], None]

# What the results follow from, beside photographs, weights and options.
_CODE = (
    "estimation.streaming",
    "estimation.beyond",
    "estimation.reading",
    "io.photographs",
    "io.official",
    "io.normals",
    "pictures.estimate_sheet",
    "surface.outputs",
    "viewer.page",
)


@dataclasses.dataclass(frozen=True)
class Network:
    """A network, and what the record says of it.

    Attributes:
        config: its configuration.
        params: its parameters.
        record: their name, hash and whether they are trained.
    """

    config: ModelConfig
    params: Any
    record: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Normals, what they were estimated from, and how.

    Attributes:
        images: `[N, H, W, 3]`, as the network was given them.
        mask: `[H, W]`, bool.
        transfer: how the images encode light.
        normals: `[H, W, 3]`, float32, unit length inside the mask, zero outside.
        record: the content of `normals.json`, less the files' hashes.
        focal: in pixels, if there is a depth to write and its camera is not
            orthographic.
        beyond: lights and confidence, where they are wanted.
    """

    images: np.ndarray
    mask: np.ndarray
    transfer: Transfer
    normals: np.ndarray
    record: dict[str, Any]
    focal: float | None = None
    beyond: Beyond = Beyond()


def load_network(source: str = "tiny") -> Network:
    """Loads weights.

    Args:
        source: the name of shipped weights, or a safetensors file.

    Raises:
        InputError: see `load_weights`.
    """
    from unips_jax import weights

    config, params = weights.load_weights(source)
    return _network(config, params, source, trained=True)


def random_network(seed: int = 0) -> Network:
    """An untrained network of the paper's size, for tests.

    Args:
        seed: of its parameters.
    """
    from unips_jax import weights

    config = ModelConfig.paper()
    params = weights.random_weights(config, seed=seed)
    return _network(config, params, f"random, seed {seed}", trained=False)


def estimate_folder(
    folder: Path,
    target: Path,
    network: Network,
    options: FolderOptions | None = None,
    *,
    overwrite: bool = False,
    verbose: bool = False,
    on_progress: Progress | None = None,
) -> dict[str, Any]:
    """Estimates the normals of a folder of photographs, and writes them.

    Args:
        folder: of photographs; or a file that holds them, a video or a TIFF of several
            pages.
        target: folder for the results: `normals.png` (16 bit), `normals.npy`,
            `sheet.png` (a picture to judge the result by) and `normals.json` (how it
            came about). All of these appear, or none.
        network: from `load_network`.
        options: how to read and what to write.
        overwrite: estimate anew even if the target holds what the same photographs,
            mask, weights, options and code gave.
        verbose: say on standard output what is done; warnings about the photographs
            and progress go to standard error.
        on_progress: called with the numbers of pixels done and to do.

    Returns:
        What `normals.json` holds; its "warnings" are about the photographs.

    Raises:
        InputError: if something cannot be read, used or written.
    """
    options = (options or FolderOptions()).spelled_out()
    options.check()
    check_target(target, folder)
    if is_container(folder):
        frames = options.max_images or KEYFRAMES
        with unpacked(folder, frames=frames, max_pixels=options.max_pixels) as place:
            return _estimate(
                place,
                target,
                network,
                options,
                overwrite,
                verbose,
                on_progress,
                {"folder": str(folder)},
            )
    return _estimate(folder, target, network, options, overwrite, verbose, on_progress)


def _estimate(
    folder: Path,
    target: Path,
    network: Network,
    options: FolderOptions,
    overwrite: bool,
    verbose: bool,
    on_progress: Progress | None,
    facts: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Does what `estimate_folder` does, to a folder."""
    clear_leftovers(target.parent)
    earlier = None if overwrite else read_record(target)
    selection = chosen_photographs(folder, options)
    if earlier is not None:
        made_from = _input_record(
            selection, network, options, HashingReader(options.max_pixels)
        )
        if same_inputs(earlier, made_from):
            if verbose:
                print(f"{folder}: {target} is up to date; --overwrite makes it anew")
            return earlier
    estimate = estimate_selection(
        selection, network, options, verbose=verbose, on_progress=on_progress
    )
    return write_estimate(target, estimate, options, facts=facts, verbose=verbose)


def estimate_selection(
    selection: Selection,
    network: Network,
    options: FolderOptions,
    *,
    verbose: bool = False,
    on_progress: Progress | None = None,
) -> Estimate:
    """Reads photographs, looks for what is wrong with them, and estimates normals.

    Args:
        selection: which photographs.
        network: from `load_network`.
        options: how to read them.
        verbose: see `estimate_folder`.
        on_progress: likewise.

    Raises:
        InputError: if a file cannot be read or used, or a normal is not finite.
    """
    from unips_jax.estimation.streaming import estimate_photographs

    if verbose:
        print_selection(selection)
    reader = HashingReader(options.max_pixels)
    looked = read_and_look(selection, options, reader, verbose=verbose)
    capture, warnings = looked.capture, looked.warnings
    images, mask, transfer = capture.images, capture.mask, capture.transfer
    made_from = _input_record(selection, network, options, reader)
    focal = focal_of(options.focal, capture.focal, selection.files[0])
    record = complete_record(
        made_from, images, mask, transfer, capture.transfer_rule, warnings
    )
    record |= looked.facts
    if verbose:
        print_record(record)
        for warning in warnings:
            print(f"warning: {selection.folder}: {warning}", file=sys.stderr)
    estimate = functools.partial(
        estimate_photographs,
        network.params,
        images,
        mask,
        config=network.config,
        transfer=transfer,
        frame="image" if options.reader == "official" else "mask",
    )
    if verbose:
        with progress("estimating normals") as report:
            normals = estimate(progress=report)
    else:
        normals = estimate(progress=on_progress)
    bad = np.count_nonzero(~np.isfinite(normals).all(axis=-1))
    if bad:
        raise InputError(
            f"{selection.folder}: expected normals, got values that are not finite at "
            f"{bad} of {np.count_nonzero(mask)} pixels; nothing was written. Look for "
            "extreme values in the photographs, or try other weights"
        )
    look = functools.partial(
        look_beyond,
        *(network.config, network.params, images, mask, normals, transfer, options),
    )
    if verbose and options.confidence:
        with progress("estimating confidence") as report:
            beyond = look(progress=report)
    else:
        beyond = look()
    return Estimate(images, mask, transfer, normals, record, focal, beyond)


def write_estimate(
    target: Path,
    estimate: Estimate,
    options: FolderOptions,
    *,
    truth: np.ndarray | None = None,
    facts: dict[str, Any] | None = None,
    more: Callable[[Path], None] | None = None,
    verbose: bool = False,
) -> dict[str, Any]:
    """Writes normals, their sheet and their record; all files appear, or none.

    Args:
        target: folder for the results.
        estimate: what to write.
        options: which files, and the maps' convention.
        truth: `[H, W, 3]`, the true normals: the sheet shows the errors.
        facts: more of the record.
        more: writes further files into the folder it is given.
        verbose: print what was written.

    Returns:
        What `normals.json` holds, less the files' hashes.

    Raises:
        InputError: if the file system refuses.
    """
    record = {**estimate.record, **(facts or {})}
    with appearing_at_once(target) as place:
        write_normals(
            place,
            estimate.normals,
            exr=options.exr,
            mat=options.mat,
            normal_map=options.normal_map,
        )
        write_sheet(
            place / "sheet.png",
            estimate.images,
            estimate.normals,
            estimate.mask,
            title=target.name,
            subtitle=summary(record),
            encoded=estimate.transfer == "srgb",
            truth=truth,
        )
        if record["mask_suggested"]:
            write_image(place / "mask.png", estimate.mask.astype(np.uint8) * 255)
        if options.depth or options.mesh:
            colors = None
            if options.mesh:
                colors = mean_colors(estimate.images, estimate.transfer)
            record["surface"] = write_surface(
                place,
                estimate.normals,
                estimate.mask,
                focal=estimate.focal,
                mesh=options.mesh,
                colors=colors,
            )
            if verbose:
                print_surface(record["surface"])
        record |= write_beyond(
            *(place, estimate.beyond, estimate.images, estimate.mask),
            *(estimate.normals, estimate.transfer, list(record["images"]), options),
        )
        if options.view:
            _write_view(place, target.name, estimate, record)
        if more is not None:
            more(place)
        names = write_record(place, record)
    if verbose:
        print_line("wrote", f"{target}/: {', '.join(names)}")
    return record


def _write_view(
    place: Path, title: str, estimate: Estimate, record: dict[str, Any]
) -> None:
    """Writes `view.html`; its depth is that of the files, if there is one."""
    from unips_jax.surface.files import read_depth
    from unips_jax.viewer.page import with_depth, write_view
    from unips_jax.viewer.result import Result, maps_of, photographs_of

    surface = record.get("surface") or {}
    names = tuple(record["images"])
    result = Result(
        title,
        estimate.normals,
        photographs_of(estimate.images, names, estimate.transfer),
        read_depth(place / "depth.exr") if surface else None,
        unit=surface.get("unit", "pixels"),
        focal=surface.get("focal_px"),
        record=record,
        **maps_of(place, estimate.mask.shape),
    )
    write_view(place / "view.html", with_depth(result))


def _network(config: ModelConfig, params: Any, name: str, *, trained: bool) -> Network:
    from unips_jax.weights import params_hash

    digest = params_hash(config, params)
    return Network(config, params, {"name": name, "hash": digest, "trained": trained})


def _input_record(
    selection: Selection,
    network: Network,
    options: FolderOptions,
    reader: HashingReader,
) -> dict[str, Any]:
    # Where the mask lies is no matter: its contents are told apart by their hash.
    chosen = dataclasses.asdict(options)
    chosen["mask"] = "none" if options.mask == "none" else "auto"
    if options.dark is not None:
        chosen["dark"] = reader.hash(dark_file(selection.folder, options.dark))
    chosen |= {name: list(chosen[name]) for name in ("include", "exclude")}  # as JSON
    normals = selection.folder / "normal.tif"
    if options.reader == "official" and not selection.mask_file and normals.is_file():
        selection = dataclasses.replace(selection, mask_file=normals)
    code = code_hash(*_CODE)
    return input_record(selection, network.record, chosen, code, reader)
