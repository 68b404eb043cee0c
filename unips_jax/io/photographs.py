"""Reads photographs of one object, and its mask.

Which files are taken: see `io.selection`.

The mask is `mask.png` (or another format), or the file given; see `io.masks`. Without a
mask the whole image counts: nothing is cropped or stretched. Left out, mask or none,
are pixels that are black in all photographs, where no method can work, and those that
are transparent in one that is cut out. EXIF orientation: see `io.images`. How values
encode light: see `io.color`.
"""

import dataclasses
import functools
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import Encoding, Transfer
from unips_jax.io.images import MAX_PIXELS, ImageFile, read_image_file, require_finite
from unips_jax.io.masks import above_half, lit_pixels, lit_without_mask, mask_of
from unips_jax.io.orientation import oriented_as
from unips_jax.io.selection import Selection, select

_FILES = 10  # times the pixels of a file that a set may have


class Photographs(NamedTuple):
    """Photographs in memory, as `estimate_photographs` takes them.

    `images` are `[N, H, W, 3]`, RGB in the files' own type: uint8, uint16 or float32,
    gray replicated; `mask` is `[H, W]`, bool, not empty; `transfer` is how values
    encode light.
    """

    images: np.ndarray
    mask: np.ndarray
    transfer: Transfer


@dataclasses.dataclass(frozen=True)
class Capture:
    """Photographs of one object, read, and what else their files hold."""

    # as in `Photographs`. Negative floats, which resampling leaves in renderings, are
    # 0, as are values outside the mask that are not finite.
    images: np.ndarray
    mask: np.ndarray  # `[H, W]`, bool, with at least one pixel
    transfer: Transfer  # how the values encode light
    transfer_rule: str = ""  # where that is known from
    # focal length in pixels by the first file's EXIF; None where unknown
    focal: float | None = None
    notes: tuple[str, ...] = ()  # what was dealt with, one sentence each
    # of each photograph by its EXIF data, empty where unknown
    cameras: tuple[str, ...] = ()
    # time x speed / f-number squared, the same; 0 where unknown
    exposures: tuple[float, ...] = ()
    # how sure a mask is that was looked for; None where none was
    mask_contrast: float | None = None
    mask_rule: str = ""  # what found it; empty where nothing did
    # how the first file's values encode light, and how it was turned by EXIF
    encoding: Encoding | None = None
    exif_orientation: int = 1
    # the same, but for HEIC, which every program turns: what lies as others read it
    orientation: int = 1
    # `[H, W]`, bool: where no photograph is transparent; None if that is everywhere
    opaque: np.ndarray | None = None


def read_photographs(
    source: Selection | str | os.PathLike[str],
    *,
    track: Callable[[Iterable[Any]], Iterable[Any]] = iter,
) -> Photographs:
    """Reads the photographs of an object, one at a time, and its mask.

    `images, mask, transfer = read_photographs("folder/")` gives what
    `estimate_photographs(network, images, mask, transfer=transfer)` takes. `track`
    wraps the list of files, to show progress.

    Returns:
        Images `[N, H, W, 3]` in the files' type, the mask `[H, W]` and "srgb" or
        "linear"; see `Photographs`.

    Raises:
        InputError: if a file cannot be used, sizes, types or orientations differ, the
            mask is empty, or an image is black or not finite inside it.
    """
    selection = source if isinstance(source, Selection) else select(Path(source))
    capture = read_capture(selection, track=track)
    return Photographs(capture.images, capture.mask, capture.transfer)


def read_capture(
    selection: Selection,
    *,
    transfer: Transfer | None = None,
    mask: np.ndarray | None = None,
    max_pixels: int = MAX_PIXELS,
    read: Callable[[Path], ImageFile] | None = None,
    track: Callable[[Iterable[Any]], Iterable[Any]] = iter,
) -> Capture:
    """Does what `read_photographs` does, opens each file once and reports more.

    `transfer` and `mask [H, W]` are taken in place of the files' own; `read` in place
    of `read_image_file`. All photographs together may have ten times `max_pixels`.
    """
    read = read or functools.partial(read_image_file, max_pixels=max_pixels)
    stack: _Stack | None = None
    for path in track(selection.files):
        file = read(path)
        if stack is None:
            shape = file.pixels.shape[:2]
            _require_room(selection, shape, max_pixels)
            inside = mask
            if inside is None:
                inside = mask_for(selection, shape, read=read)
            stack = _Stack(file, len(selection.files), inside, transfer)
        stack.add(file)
    assert stack is not None  # a selection has a file
    notes = []
    if stack.turned:
        reference = stack.first.path.name
        note = (
            f"other EXIF orientation than {reference}: {', '.join(stack.turned)}; "
            "turned so that their edges fit"
        )
        if selection.mask_file is not None:
            note += f"; the mask must be one of {reference} as it is shown"
        notes.append(note)
    if stack.colored:
        notes.append(
            f"colour profiles of other colours than {stack.first.path.name}'s: "
            f"{', '.join(stack.colored)}; taken as its own, export all in one"
        )
    if mask is None:
        notes += stack.leave_out(whole=selection.mask_file is None)
    encoding, first = stack.encoding, stack.first
    return Capture(
        stack.images,
        stack.mask,
        encoding.transfer,
        encoding.rule,
        first.focal,
        tuple(notes),
        tuple(stack.cameras),
        tuple(stack.exposures),
        encoding=encoding,
        exif_orientation=first.orientation,
        orientation=1 if first.header.format == "HEIC" else first.orientation,
        opaque=None if stack.opaque.all() else stack.opaque,
    )


class _Stack:
    """Photographs that are read one by one, each compared with the first."""

    def __init__(
        self, first: ImageFile, count: int, mask: np.ndarray, transfer: Transfer | None
    ) -> None:
        self.first = dataclasses.replace(first, pixels=first.pixels[:0], alpha=None)
        self.mask = mask
        self.encoding = first.encoding
        if transfer is not None:
            colors = first.encoding.to_srgb
            self.encoding = Encoding(transfer, "--transfer", to_srgb=colors)
        table = self.encoding.table
        dtype = first.pixels.dtype if table is None else table.dtype
        self.images = np.empty((count, *mask.shape, 3), dtype)
        self.brightest = np.zeros(mask.shape, dtype)
        self.opaque = np.ones(mask.shape, bool)
        self.given = transfer is not None
        self.turned: list[str] = []
        self.colored: list[str] = []  # in other colours than the first
        self.cameras: list[str] = []
        self.exposures: list[float] = []
        self._size = 0

    def add(self, file: ImageFile) -> None:
        """Takes one photograph, or refuses one that does not fit."""
        if file.orientation != self.first.orientation:
            file = oriented_as(file, self.first, self.images[0])
            self.turned.append(file.path.name)
        _require_alike(file, self.first, self.images)
        if not self.given and not file.encoding.agrees(self.encoding):
            raise InputError(
                f"{file.path}: expected {self.encoding.transfer} values as "
                f"{self.first.path.name} ({self.encoding.rule}), got "
                f"{file.encoding.transfer} ones ({file.encoding.rule}); export all "
                "photographs in the same way, or give --transfer"
            )
        if not file.encoding.has_colors_of(self.encoding):
            self.colored.append(file.path.name)
        self.cameras.append(file.header.camera)
        self.exposures.append(file.header.exposure)
        image = self.images[self._size]
        self._size += 1
        image[:] = self.encoding.values(file.pixels)
        if image.dtype == np.float32:
            require_finite(file.path, image[self.mask])
            np.nan_to_num(image, copy=False, nan=0, posinf=0, neginf=0)
            np.maximum(image, 0, out=image)
        _require_light(file.path, image, self.mask)
        np.maximum(self.brightest, image.max(axis=-1), out=self.brightest)
        # Programs that know no alpha leave it 0 everywhere.
        if file.alpha is not None and file.alpha.any() and not file.alpha.all():
            self.opaque &= above_half(file.alpha)

    def leave_out(self, *, whole: bool) -> list[str]:
        """Takes from the mask (or whole image) what no photograph shows; says so."""
        notes = []
        where = "of the whole image (no mask)" if whole else "of the mask"
        if whole:
            lit = lit_without_mask(self.brightest, self.encoding.transfer)
        else:
            lit = lit_pixels(self.brightest, self.encoding.transfer, self.mask)
        for kept, what in (
            (self.opaque, "that are transparent in a photograph"),
            (lit, "that are black in all photographs"),
        ):
            out = int((self.mask & ~kept).sum())
            left = self.mask & kept
            if out and not left.any():
                raise InputError(
                    f"{self.first.path.parent}: expected photographs of an object, got "
                    f"none of {int(self.mask.sum())} pixels other than those {what}; "
                    "check the mask"
                )
            if out:
                notes.append(f"{out} pixels {where} {what[5:]}: left out")
            self.mask = left
        return notes


def _require_room(selection: Selection, shape: tuple[int, ...], limit: int) -> None:
    count = len(selection.files)
    if count * shape[0] * shape[1] > _FILES * limit:
        raise InputError(
            f"{selection.title}: expected at most {_FILES * limit:,} pixels in all "
            f"photographs, got {count} of {_size(shape)} = "
            f"{count * shape[0] * shape[1]:,}; make them smaller, use --max-images, or "
            "raise --max-pixels"
        )


def mask_for(
    selection: Selection,
    shape: tuple[int, ...],
    *,
    read: Callable[[Path], ImageFile] = read_image_file,
) -> np.ndarray:
    """The mask of photographs of a shape: `[H, W]` bool; all true without a file."""
    if selection.mask_file is None:
        return np.ones(shape, bool)
    mask = mask_of(read(selection.mask_file))
    if mask.shape != shape:
        turned = mask.shape == shape[::-1]
        hint = "turn it by 90 degrees" if turned else "make it from a photograph"
        raise InputError(
            f"{selection.mask_file}: expected a mask of {_size(shape)} pixels as "
            f"{selection.names[0]}, got {_size(mask.shape)}; {hint}"
        )
    return mask


def _require_alike(file: ImageFile, first: ImageFile, images: np.ndarray) -> None:
    shape, dtype = file.pixels.shape, file.pixels.dtype
    if shape[:2] != images.shape[1:3]:
        raise InputError(
            f"{file.path}: expected {_size(images.shape[1:3])} pixels as "
            f"{first.path.name}, got {_size(shape)}; photographs of one object must be "
            "taken by one camera that does not move: remove or re-export it"
        )
    if dtype != first.pixels.dtype:
        raise InputError(
            f"{file.path}: expected {first.pixels.dtype} pixels as {first.path.name}, "
            f"got {dtype}; export all photographs in the same way"
        )


def _require_light(file: Path, image: np.ndarray, mask: np.ndarray) -> None:
    if not image[mask].any():
        inside = int(mask.sum())
        raise InputError(
            f"{file}: expected light on the object, got 0 at all {inside} pixels "
            "inside the mask; remove the image, or check the mask"
        )


def _size(shape: tuple[int, ...]) -> str:
    """Width x height, as image programs write it."""
    return f"{shape[1]} x {shape[0]}"
