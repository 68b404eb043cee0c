"""Reads a folder of photographs of one object, and its mask.

What is taken: in a folder `X.data` (the authors' layout) the images `L*`, or else
`0*`; elsewhere every image file. Never a normal, depth or material map, a mask, ground
truth or this package's own output (`io.names`), and never hidden files. Files are
sorted by name; whatever is left out is listed with its reason.

The mask is `mask.png` (or another format), or the file given; see `io.masks`. Without
a mask the whole image counts: nothing is cropped or stretched. EXIF orientation: see
`unips_jax.io.images`.
"""

import dataclasses
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import Transfer, usual_transfer
from unips_jax.io.images import ImageFile, read_image_file, require_finite
from unips_jax.io.masks import mask_of
from unips_jax.io.names import SUFFIXES, is_map

_RAW_SUFFIXES = (".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw")


@dataclasses.dataclass(frozen=True)
class Selection:
    """Which files of a folder are photographs.

    Attributes:
        folder: the folder.
        files: the photographs, sorted by name; at least one.
        left_out: for each reason, the names left out for it.
        mask_file: the mask, or None.
    """

    folder: Path
    files: tuple[Path, ...]
    left_out: dict[str, list[str]]
    mask_file: Path | None

    @property
    def names(self) -> tuple[str, ...]:
        """The photographs' file names."""
        return tuple(file.name for file in self.files)


class Photographs(NamedTuple):
    """Photographs in memory, as `estimate_photographs` takes them.

    Attributes:
        images: `[N, H, W, 3]`, RGB in the files' own type: uint8, uint16 or float32;
            gray is replicated.
        mask: `[H, W]`, bool, with at least one pixel.
        transfer: how the values encode light, by the files' type.
    """

    images: np.ndarray
    mask: np.ndarray
    transfer: Transfer


@dataclasses.dataclass(frozen=True)
class Capture:
    """Photographs of one object, read, with what their files tell.

    Attributes:
        images: `[N, H, W, 3]`, RGB in the files' own type: uint8, uint16 or float32;
            grey replicated. Negative floats, which resampling leaves in renderings,
            are 0, as are values outside the mask that are not finite.
        mask: `[H, W]`, bool, with at least one pixel.
        transfer: how the values encode light.
        focal: focal length in pixels by the first file's EXIF data; None where it is
            not told.
    """

    images: np.ndarray
    mask: np.ndarray
    transfer: Transfer
    focal: float | None


def select(
    folder: Path,
    *,
    mask_file: Path | None = None,
    max_images: int | None = None,
    seed: int = 0,
) -> Selection:
    """Finds the photographs and the mask of a folder, without reading them.

    Args:
        folder: the folder.
        mask_file: the mask, in place of the folder's own.
        max_images: if the folder has more photographs, this many are drawn.
        seed: seed of that draw; the same seed and files give the same choice.

    Raises:
        InputError: if there is no such folder, no photograph in it, no such mask, or
            more than one mask.
    """
    if not folder.is_dir():
        what = "a file" if folder.exists() else "nothing of this name"
        hint = f"; give its folder, {folder.parent}" if folder.exists() else ""
        raise InputError(
            f"{folder}: expected a folder of photographs, got {what}{hint}"
        )
    try:
        entries = [e for e in sorted(folder.iterdir()) if not e.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from None
    mask_file = mask_file or _own_mask(folder, entries)
    if mask_file and not mask_file.is_file():
        raise InputError(f"{mask_file}: expected a mask's image file, got no such file")
    files, left_out = _photographs(folder, entries, mask_file)
    if not files:
        raise InputError(_nothing_found(folder, entries, left_out))
    if max_images is not None and max_images < len(files):
        drawn = np.random.default_rng(seed).choice(len(files), max_images, False)
        reason = f"not among the {max_images} drawn with seed {seed}"
        left_out[reason] = [f.name for i, f in enumerate(files) if i not in drawn]
        files = [files[i] for i in sorted(drawn)]
    return Selection(folder, tuple(files), left_out, mask_file)


def read_photographs(
    source: Selection | str | os.PathLike[str],
    *,
    track: Callable[[Iterable[Any]], Iterable[Any]] = iter,
) -> Photographs:
    """Reads the photographs of an object, one at a time, and its mask.

    `images, mask, transfer = read_photographs("folder/")` gives what
    `estimate_photographs(params, images, mask, transfer=transfer, config=config)`
    takes.

    Args:
        source: a folder of photographs, or which of its files (`select`).
        track: wraps the list of files, to show progress.

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
    track: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    read: Callable[[Path], ImageFile] = read_image_file,
    mask: np.ndarray | None = None,
) -> Capture:
    """Does what `read_photographs` does, opens each file once and tells more.

    Args:
        selection: which files.
        track: wraps the list of files, to show progress.
        read: reads one photograph, or the mask.
        mask: `[H, W]`, bool, in place of the selection's mask file.

    Raises:
        InputError: as `read_photographs`.
    """
    images = np.empty(0)
    first: ImageFile | None = None
    for i, path in enumerate(track(selection.files)):
        file = read(path)
        if first is None:
            first = dataclasses.replace(file, pixels=file.pixels[:0], alpha=None)
            if mask is None:
                mask = mask_for(selection, file.pixels.shape[:2], read=read)
            shape = (len(selection.files), *mask.shape, 3)
            images = np.empty(shape, file.pixels.dtype)
        assert mask is not None
        require_orientation(file, first)
        _require_alike(file, first, images)
        images[i] = file.pixels
        if images.dtype == np.float32:
            require_finite(path, images[i][mask])
            np.nan_to_num(images[i], copy=False, nan=0, posinf=0, neginf=0)
            np.maximum(images[i], 0, out=images[i])
        _require_light(path, images[i], mask)
    assert first is not None and mask is not None  # a selection has a file
    return Capture(images, mask, usual_transfer(images.dtype), first.focal)


def mask_for(
    selection: Selection,
    shape: tuple[int, ...],
    *,
    read: Callable[[Path], ImageFile] = read_image_file,
) -> np.ndarray:
    """The mask of photographs: `[H, W]` bool; all true where there is no mask file.

    Args:
        selection: the files.
        shape: the photographs' height and width.
        read: reads the mask's file.

    Raises:
        InputError: if the mask cannot be read, is empty or has another size.
    """
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


def folder_name(folder: Path) -> str:
    """A folder's name as given (links are not followed), without ".data".

    Bytes that are not Unicode are replaced by question marks.
    """
    name = os.fsencode(os.path.abspath(folder)).decode(errors="replace")  # noqa: PTH100
    return Path(name).name.removesuffix(".data")


def require_orientation(file: ImageFile, first: ImageFile) -> None:
    """Raises InputError if two photographs' EXIF orientations differ.

    Args:
        file: one.
        first: the other, which has the say.
    """
    if file.orientation != first.orientation:
        raise InputError(
            f"{file.path}: expected EXIF orientation {first.orientation} as in "
            f"{first.path.name}, got {file.orientation}; if the camera stood still, "
            "remove the tag from all files (exiftool -Orientation= FILES), else leave "
            "this one out"
        )


def _own_mask(folder: Path, entries: list[Path]) -> Path | None:
    masks = [
        e for e in entries if e.stem.lower() == "mask" and e.suffix.lower() in SUFFIXES
    ]
    if len(masks) > 1:
        raise InputError(
            f"{folder}: expected one mask, got {', '.join(m.name for m in masks)}; "
            "keep one, or name it with --mask of `unips estimate`"
        )
    return masks[0] if masks else None


def _photographs(
    folder: Path, entries: list[Path], mask_file: Path | None
) -> tuple[list[Path], dict[str, list[str]]]:
    files: list[Path] = []
    left_out: dict[str, list[str]] = {}
    for entry in entries:
        if entry.is_dir():
            continue
        suffix = entry.suffix.lower()
        if mask_file is not None and entry.resolve() == mask_file.resolve():
            continue
        if suffix in _RAW_SUFFIXES:
            left_out.setdefault(f"{suffix} is not read: export PNG or TIFF", []).append(
                entry.name
            )
        elif suffix not in SUFFIXES:
            left_out.setdefault("not an image", []).append(entry.name)
        elif is_map(entry.name):
            left_out.setdefault("a map or output, by its name", []).append(entry.name)
        else:
            files.append(entry)
    if folder.resolve().suffix == ".data":
        for prefix in ("L", "0"):
            taken = [file for file in files if file.name.upper().startswith(prefix)]
            if taken:
                others = [file.name for file in files if file not in taken]
                if others:
                    left_out[f"not named {prefix}* in a .data folder"] = others
                return taken, left_out
    return files, left_out


def _nothing_found(
    folder: Path, entries: list[Path], left_out: dict[str, list[str]]
) -> str:
    text = f"{folder}: expected photographs ({', '.join(sorted(SUFFIXES))}), got none"
    for reason, names in left_out.items():
        text += f"; {len(names)} left out ({reason}), such as {names[0]}"
    folders = [entry.name for entry in entries if entry.is_dir()]
    if folders:
        text += f"; it has folders, give those: {folder / folders[0]}"
    return text


def _require_alike(file: ImageFile, first: ImageFile, images: np.ndarray) -> None:
    shape, dtype = file.pixels.shape, file.pixels.dtype
    if shape[:2] != images.shape[1:3]:
        raise InputError(
            f"{file.path}: expected {_size(images.shape[1:3])} pixels as "
            f"{first.path.name}, got {_size(shape)}; photographs of one object must be "
            "taken by one camera that does not move: remove or re-export it"
        )
    if dtype != images.dtype:
        raise InputError(
            f"{file.path}: expected {images.dtype} pixels as {first.path.name}, got "
            f"{dtype}; export all photographs in the same way"
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
