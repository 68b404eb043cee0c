"""Folders of photographs to folders of results.

Transfer function: by the files' own colour tags, else by their type; see `io.color`.
`FolderOptions.transfer` overrules it.
"""

import contextlib
import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unips_jax.console import progress
from unips_jax.errors import InputError
from unips_jax.estimation.extras import estimate_extras
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.reading import chosen_photographs, dark_file, read_and_look
from unips_jax.estimation.writing import Estimate, write_estimate
from unips_jax.io.door import write_json
from unips_jax.io.orientation import ADVICE
from unips_jax.io.photographs import Capture
from unips_jax.io.record import (
    HashingReader,
    complete_record,
    input_record,
    print_record,
    print_selection,
    same_inputs,
)
from unips_jax.io.record_schema import load_record
from unips_jax.io.results import (
    RECORD,
    check_target,
    clear_leftovers,
    file_hash,
    mended_mask,
    read_record,
)
from unips_jax.io.selection import Selection
from unips_jax.lighting.known import read_known_lights
from unips_jax.lighting.rig import read_rig, rig_file, turned_to
from unips_jax.models.config import ModelConfig, require_known_lights
from unips_jax.provenance import code_hash
from unips_jax.surface.outputs import focal_of

if TYPE_CHECKING:  # JAX is imported when there is something to estimate
    from unips_jax.estimation.streaming import NormalsAndLights
    from unips_jax.models.network import UniversalNetwork

Progress = Callable[[int, int], None]
Preview = Callable[[np.ndarray], None]

# The code that results follow from.
_CODE = (
    "estimation.streaming",
    "estimation.extras",
    "estimation.reading",
    "estimation.writing",
    "io.photographs",
    "io.official_photographs",
    "io.normals",
    "pictures.estimate_sheet",
    "surface.outputs",
    "viewer.page",
)


@dataclasses.dataclass(frozen=True)
class NamedNetwork:
    """A network, and for the record its name, hash and whether it is trained."""

    network: "UniversalNetwork"
    record: dict[str, Any]


def load_network(source: str = "tiny") -> NamedNetwork:
    """`load_weights`, with what the record holds of them."""
    from unips_jax.weights import load_weights

    return _named(load_weights(source), source, trained=True)


def random_network(seed: int = 0) -> NamedNetwork:
    """An untrained network of the paper's size, for tests."""
    from unips_jax.weights import random_weights

    network = random_weights(ModelConfig.paper(), seed=seed)
    return _named(network, f"random, seed {seed}", trained=False)


def estimate_folder(
    folder: Path,
    target: Path,
    network: NamedNetwork,
    options: FolderOptions | None = None,
    *,
    overwrite: bool = False,
    verbose: bool = False,
    on_progress: Progress | None = None,
    on_preview: Preview | None = None,
) -> dict[str, Any]:
    """Estimates the normals of a folder of photographs, and writes them.

    Args:
        folder: or a file that holds photographs, a video or a TIFF of several pages.
        target: folder for `normals.png` (16 bit), `normals.npy`, `sheet.png` (a picture
            to judge the result by) and `normals.json` (how it came about): all of
            these, or none.
        network: from `load_network`.
        options: how to read and what to write.
        overwrite: estimate anew even if the target holds what the same photographs,
            mask, weights, options and code gave.
        verbose: print what is done; warnings and progress go to standard error.
        on_progress: called with the numbers of pixels done and to do, first when the
            photographs are read.
        on_preview: called early with normals of a coarse grid, `[h, w, 3]`.

    Returns:
        What `normals.json` holds; its "warnings" are about the photographs.

    Raises:
        InputError: if something cannot be read, used or written.
    """
    options = (options or FolderOptions()).spelled_out()
    options.check()
    check_target(target, folder)
    clear_leftovers(target.parent)
    earlier = None if overwrite else read_record(target)
    with _as_folder(folder, options) as place:
        selection = chosen_photographs(place, options)
        if place != folder:
            selection = dataclasses.replace(selection, source=folder)
        if not overwrite and (target / RECORD).is_file():
            reader = HashingReader(options.max_pixels)
            now = _input_record(selection, network, options, reader)
            if earlier is not None and same_inputs(earlier, now):
                if verbose:
                    title = selection.title
                    print(f"{title}: {target} is up to date; --overwrite makes it anew")
                return _moved(earlier, now, target)
            _require_same_object(target, now)
        if options.looks_for_mask and selection.mask_file is None:
            _require_no_mended_mask(target)
        estimate = estimate_selection(
            selection,
            network,
            options,
            verbose=verbose,
            on_progress=on_progress,
            on_preview=on_preview,
        )
        return write_estimate(target, estimate, options, verbose=verbose)


def _moved(record: dict[str, Any], now: dict[str, Any], target: Path) -> dict[str, Any]:
    """The record of results that hold, with their photographs' place of now."""
    places = {name: now[name] for name in ("folder", "mask")}
    if places.items() <= record.items():
        return record
    record = {**record, **places}
    write_json(target / RECORD, record, indent=2)
    return record


def _require_same_object(target: Path, now: dict[str, Any]) -> None:
    """Refuses to replace results of another folder, if no photograph is the same."""
    try:
        before = load_record(target / RECORD)
    except InputError:
        return  # of no use any more
    known, folder = before.get("images"), before.get("folder")
    if not known or not folder:
        return
    with contextlib.suppress(OSError, ValueError):
        if Path(folder).samefile(now["folder"]):
            return
    if set(known.values()).isdisjoint(now["images"].values()):
        raise InputError(
            f"{target}: expected results of {now['folder']}, got those of {folder}; "
            "choose another -o, or replace them by --overwrite"
        )


def _require_no_mended_mask(target: Path) -> None:
    mended = mended_mask(target)
    if mended is not None:
        raise InputError(
            f"{mended}: was changed since it was written, and a mask that is looked "
            f"for would replace it; use it by --mask {mended}, or remove it"
        )


@contextlib.contextmanager
def _as_folder(path: Path, options: FolderOptions) -> Iterator[Path]:
    """The folder, or a temporary one of what a file of photographs holds."""
    if path.is_file():
        from unips_jax.capture.unpack import KEYFRAMES, is_container, unpacked

        if is_container(path):
            frames = options.max_images or KEYFRAMES
            with unpacked(path, frames=frames, max_pixels=options.max_pixels) as place:
                yield place
            return
    yield path


def estimate_selection(
    selection: Selection,
    network: NamedNetwork,
    options: FolderOptions,
    *,
    verbose: bool = False,
    on_progress: Progress | None = None,
    on_preview: Preview | None = None,
) -> Estimate:
    """Reads photographs, looks for faults, and estimates; see `estimate_folder`."""
    if verbose:
        print_selection(selection)
    if options.confidence and len(selection.files) < 2:
        raise InputError(
            f"{selection.folder}: expected 2 photographs or more for --confidence (or "
            "--all), got 1; leave it out"
        )
    known = _known_lights(selection, options)
    if known is not None:
        _check_use_of_lights(network)
    rig = None
    if options.lights_from is not None:
        rig = read_rig(options.lights_from, selection.names)
    reader = HashingReader(options.max_pixels)
    looked = read_and_look(selection, options, reader, verbose=verbose)
    capture, warnings = looked.capture, looked.warnings
    images, mask, transfer = capture.images, capture.mask, capture.transfer
    if rig is not None and options.lights_from is not None:
        rig = turned_to(rig, options.lights_from, capture.exif_orientation)
    warnings += _of_lists(options, capture.exif_orientation)
    made_from = _input_record(selection, network, options, reader)
    focal = None
    if options.focal is not None:
        focal = focal_of(options.focal, capture.focal, selection.files[0], mask.shape)
    record = complete_record(
        made_from, images, mask, transfer, capture.transfer_rule, warnings
    )
    record |= looked.facts
    if verbose:
        print_record(record)
        for warning in warnings:
            print(f"warning: {selection.title}: {warning}", file=sys.stderr)
    found = _ask_network(
        selection,
        capture,
        network,
        options,
        known,
        verbose=verbose,
        on_progress=on_progress,
        on_preview=on_preview,
    )
    look = functools.partial(
        estimate_extras,
        network.network,
        images,
        mask,
        found,
        transfer,
        options,
        rig=rig,
        known=known,
    )
    if verbose and options.confidence:
        with progress("estimating confidence") as report:
            extras = look(progress=report)
    else:
        extras = look()
    to_srgb = None if capture.encoding is None else capture.encoding.to_srgb
    return Estimate(
        images, mask, transfer, found.normals, record, focal, extras, to_srgb
    )


def _ask_network(
    selection: Selection,
    capture: Capture,
    network: NamedNetwork,
    options: FolderOptions,
    known: np.ndarray | None,
    *,
    verbose: bool,
    on_progress: Progress | None,
    on_preview: Preview | None,
) -> "NormalsAndLights":
    """The network's estimate, all finite; progress is shown, or reported."""
    from unips_jax.estimation.streaming import estimate_with_lights

    mask = capture.mask
    estimate = functools.partial(
        estimate_with_lights,
        network.network,
        capture.images,
        mask,
        transfer=capture.transfer,
        frame=options.frame,
        lights=known,
        fast=options.fast,
    )
    if verbose:
        with progress("estimating normals") as report:
            found = estimate(progress=report)
    else:
        if on_progress is not None:
            on_progress(0, int(np.count_nonzero(mask)))
        found = estimate(progress=on_progress, preview=on_preview)
    bad = np.count_nonzero(~np.isfinite(found.normals).all(axis=-1))
    if bad:
        raise InputError(
            f"{selection.title}: expected normals, got values that are not finite at "
            f"{bad} of {np.count_nonzero(mask)} pixels; nothing was written. Look for "
            "extreme values in the photographs, or try other weights"
        )
    return found


def _known_lights(selection: Selection, options: FolderOptions) -> np.ndarray | None:
    if not options.known_lights:
        return None
    return read_known_lights(options.known_lights, selection.names)


def _of_lists(options: FolderOptions, orientation: int) -> list[str]:
    """A warning where EXIF turns photographs whose lights a list gives."""
    given = [str(options.lights_from or ""), *options.known_lights]
    lists = [name for name in given if name.lower().endswith(".lp")]
    if orientation == 1 or not lists:
        return []
    return [
        f"directions of {lists[0]} are taken as in the photographs as shown, which "
        f"EXIF turns (orientation {orientation}); if they were made for the files as "
        f"stored, {ADVICE}"
    ]


def _check_use_of_lights(named: NamedNetwork) -> None:
    try:
        require_known_lights(named.network.config)
    except ValueError:
        raise InputError(
            "--known-lights: expected weights of a network that guesses lights, as the "
            f"shipped ones, got {named.record['name']}; leave the option out"
        ) from None


def _named(network: "UniversalNetwork", name: str, *, trained: bool) -> NamedNetwork:
    from unips_jax.weights import weights_hash

    record = {"name": name, "hash": weights_hash(network), "trained": trained}
    return NamedNetwork(network, record)


def _input_record(
    selection: Selection,
    network: NamedNetwork,
    options: FolderOptions,
    reader: HashingReader,
) -> dict[str, Any]:
    # The mask counts by its contents' hash, not by where it is.
    chosen = dataclasses.asdict(options)
    chosen["mask"] = "none" if options.mask == "none" else "auto"
    if options.dark is not None:
        chosen["dark"] = reader.hash(dark_file(selection.folder, options.dark))
    if options.lights_from is not None:
        chosen["lights_from"] = file_hash(rig_file(options.lights_from))
    known = _known_lights(selection, options)
    chosen["known_lights"] = None
    if known is not None:
        named = zip(selection.names, known, strict=True)
        chosen["known_lights"] = {name: x.tolist() for name, x in named if x.any()}
    chosen |= {name: list(chosen[name]) for name in ("include", "exclude")}  # as JSON
    normals = selection.folder / "normal.tif"
    own = options.mask != "none" and selection.mask_file is None
    if options.reader == "official" and own and normals.is_file():
        selection = dataclasses.replace(selection, mask_file=normals)
    code = code_hash(*_CODE)
    return input_record(selection, network.record, chosen, code, reader)
