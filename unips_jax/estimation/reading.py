"""The photographs of a folder: chosen, read, prepared, and looked at for faults."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

from unips_jax.capture.check import check_capture
from unips_jax.capture.prepare import (
    in_place,
    still,
    with_suggested_mask,
    without_ambient,
)
from unips_jax.console import track
from unips_jax.errors import InputError
from unips_jax.estimation.options import FolderOptions
from unips_jax.io.official_photographs import read_official
from unips_jax.io.photographs import Capture, read_capture
from unips_jax.io.record import HashingReader
from unips_jax.io.selection import Selection, drawn, select


@dataclasses.dataclass(frozen=True)
class Looked:
    """Photographs that were read and looked at."""

    capture: Capture  # the photographs
    warnings: list[str]  # what is wrong with them, one line each
    facts: dict[str, Any]  # for the record


def chosen_photographs(folder: Path, options: FolderOptions) -> Selection:
    """Which files of a folder are photographs, and which the mask."""
    selection = select(
        folder,
        mask_file=options.mask if isinstance(options.mask, Path) else None,
        include=options.include,
        exclude=options.exclude,
        masks=options.mask != "none",
    )
    left_out = dict(selection.left_out)
    if options.dark is not None:
        dark = dark_file(folder, options.dark)
        kept = tuple(f for f in selection.files if f.resolve() != dark.resolve())
        if not kept:
            raise InputError(f"{folder}: expected photographs, got none but {dark}")
        left_out["by --dark"] = [dark.name]
        selection = dataclasses.replace(selection, files=kept, left_out=left_out)
    if options.max_images is not None:
        return drawn(selection, options.max_images, options.seed)
    return selection


def dark_file(folder: Path, dark: Path) -> Path:
    """The dark frame: in the folder of photographs, or at its own path."""
    for path in (folder / dark, dark):
        if path.is_file():
            return path
    raise InputError(
        f"--dark {dark}: expected a photograph without the lamp, in {folder} or "
        "at that place, got no such file"
    )


def read_and_look(
    selection: Selection,
    options: FolderOptions,
    reader: HashingReader,
    *,
    verbose: bool,
) -> Looked:
    """Reads photographs, prepares them as the options ask, and looks for faults."""
    capture = _read(selection, options, reader, verbose=verbose)
    facts: dict[str, Any] = {}
    motion, taken = None, None
    if options.dark is not None:
        taken = capture.images
        dark = reader(dark_file(selection.folder, options.dark))
        capture = without_ambient(capture, dark, selection.names)
    if options.register:
        brought_back, motion = in_place(capture)
        facts["moved_back"] = {}
        if brought_back is not capture:
            offsets = motion.offsets.round(2).tolist()
            moves = zip(selection.names, offsets, strict=True)
            facts["moved_back"] = {name: move for name, move in moves if any(move)}
            capture, motion = brought_back, still(motion)
    if options.looks_for_mask and selection.mask_file is None:
        capture = with_suggested_mask(capture)
    findings = check_capture(capture, selection.names, motion=motion, taken=taken)
    facts["findings"] = [finding.record() for finding in findings]
    facts["orientation"] = capture.orientation
    facts["exif_orientation"] = capture.exif_orientation
    facts["mask_contrast"] = capture.mask_contrast
    facts["mask_rule"] = capture.mask_rule
    facts["mask_suggested"] = bool(capture.mask_rule)
    texts = [finding.text for finding in findings]
    return Looked(capture, [*capture.notes, *texts], facts)


def _read(
    selection: Selection,
    options: FolderOptions,
    reader: HashingReader,
    *,
    verbose: bool,
) -> Capture:
    if options.reader == "official":
        size = options.size or 512
        whole = options.mask == "none"
        deep = options.all or options.depth or bool(options.mesh) or options.view
        images, mask, _ = read_official(
            selection, size=size, whole=whole, keep_aspect=deep, read=reader
        )
        return Capture(images, mask, "linear", "the authors' reader")
    tracked: Any = functools.partial(track, description="reading photographs")
    return read_capture(
        selection,
        transfer=None if options.transfer == "auto" else options.transfer,
        max_pixels=options.max_pixels,
        read=reader,
        track=tracked if verbose else iter,
    )
