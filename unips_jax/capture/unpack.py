"""Photographs that lie in one file: the pages of a TIFF, the frames of a video."""

import contextlib
import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import tifffile

from unips_jax.errors import InputError
from unips_jax.io.images import MAX_PIXELS, write_image
from unips_jax.io.naming import VIDEO_SUFFIXES

KEYFRAMES = 12
"""Frames that are taken of a video by default."""

_LOOKED_AT = 300  # frames
_THUMB = 48  # pixels of the longer side
_SHARP = 0.8  # of the sharpest of neighbours
_NEIGHBOURS = 2
_ICC, _REDUCED = 34675, 1 | 4


def is_container(path: Path) -> bool:
    """Whether a path is, by its name, a file that may hold several photographs."""
    suffix = path.suffix.lower()
    return suffix in (".tif", ".tiff", *VIDEO_SUFFIXES) and path.is_file()


@contextlib.contextmanager
def unpacked(
    path: Path, *, frames: int = KEYFRAMES, max_pixels: int = MAX_PIXELS
) -> Iterator[Path]:
    """Gives a folder, for as long as it is needed, of the photographs in one file.

    Args:
        path: a TIFF of several pages, or a video of a still object under a lamp that
            moves.
        frames: how many of a video are taken, those whose light differs most.

    Raises:
        InputError: if it cannot be read, or holds too little.
    """
    with tempfile.TemporaryDirectory(prefix="unips-") as place:
        folder = Path(place) / path.stem
        folder.mkdir()
        if path.suffix.lower() in VIDEO_SUFFIXES:
            _unpack_video(path, folder, frames, max_pixels)
        else:
            _unpack_pages(path, folder, max_pixels)
        yield folder


def _unpack_pages(path: Path, folder: Path, max_pixels: int) -> None:
    try:
        with tifffile.TiffFile(path) as tiff:
            images = _pages(tiff, path, max_pixels)
            for index, (pixels, icc) in enumerate(images, 1):
                tifffile.imwrite(
                    folder / f"page_{index:03}.tif",
                    pixels,
                    photometric="rgb" if pixels.ndim == 3 else "minisblack",
                    iccprofile=icc,
                    metadata=None,
                )
    except InputError:
        raise
    except Exception as error:  # the library raises many kinds
        raise InputError(
            f"{path}: expected a TIFF of several photographs, got one that cannot be "
            f"read ({' '.join(str(error).split())[:120]}); save each page as a file of "
            "its own"
        ) from None


def _pages(
    tiff: tifffile.TiffFile, path: Path, max_pixels: int
) -> Iterator[tuple[np.ndarray, bytes | None]]:
    pages = [
        page
        for page in tiff.pages
        if isinstance(page, tifffile.TiffPage) and not int(page.subfiletype) & _REDUCED
    ]
    stack = None
    if len(pages) == 1 and tiff.is_imagej and len(tiff.series[0].shape) > 2:
        _check_size(path, pages[0].imagelength, pages[0].imagewidth, max_pixels)
        stack = tiff.series[0].asarray()
    count = len(pages) if stack is None else len(stack)
    if count < 2:
        raise InputError(
            f"{path}: expected a folder of photographs, or a TIFF of several, got "
            f"one of {count}; give its folder, {path.parent}"
        )
    for index in range(count):
        page = pages[0 if stack is not None else index]
        _check_size(path, page.imagelength, page.imagewidth, max_pixels)
        icc = page.tags.valueof(_ICC)
        yield stack[index] if stack is not None else page.asarray(), icc


def _check_size(path: Path, height: int, width: int, max_pixels: int) -> None:
    if height * width > max_pixels:
        raise InputError(
            f"{path}: expected at most {max_pixels:,} pixels, got {width} x {height}; "
            "make it smaller, or raise --max-pixels of `unips estimate`"
        )


@dataclasses.dataclass(frozen=True)
class _Seen:
    """What is kept of a frame that was looked at."""

    number: int
    shading: np.ndarray
    sharpness: float


def _unpack_video(path: Path, folder: Path, frames: int, max_pixels: int) -> None:
    seen = _look_through(path, max_pixels)
    if len(seen) < 2:
        raise InputError(
            f"{path}: expected a video of some seconds, got {len(seen)} frames that "
            "can be read; export it as MP4 (H.264)"
        )
    chosen = {seen[i].number for i in choose_frames(seen, frames)}
    for number, frame in _frames(path, max_pixels):
        if number in chosen:
            write_image(folder / f"frame_{number:05}.png", frame[..., ::-1])


def choose_frames(seen: list[_Seen], count: int) -> list[int]:
    """Which frames differ most in light, and are sharp among their neighbours.

    Each next one is the farthest from all that were chosen before (Gonzalez, 1985).
    """
    sharp = [
        index
        for index, frame in enumerate(seen)
        if frame.sharpness
        >= _SHARP
        * max(
            near.sharpness
            for near in seen[max(index - _NEIGHBOURS, 0) : index + _NEIGHBOURS + 1]
        )
    ]
    shading = np.stack([seen[index].shading for index in sharp])
    distance = np.abs(shading - shading.mean(axis=0)).mean(axis=1)
    chosen: list[int] = []
    for _ in range(min(count, len(sharp))):
        farthest = int(distance.argmax())
        chosen.append(farthest)
        to_it = np.abs(shading - shading[farthest]).mean(axis=1)
        distance = np.minimum(distance, to_it) if len(chosen) > 1 else to_it
    return sorted(sharp[index] for index in chosen)


def _look_through(path: Path, max_pixels: int) -> list[_Seen]:
    capture = cv2.VideoCapture(str(path))
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    step = max(1, total // _LOOKED_AT)
    seen = []
    for number, frame in _frames(path, max_pixels, step):
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).astype(np.float32)
        small = _reduced(grey, _THUMB / max(grey.shape))
        fine, coarse = (
            float(np.abs(cv2.Laplacian(picture, cv2.CV_32F)).mean())
            for picture in (grey, _reduced(grey, 0.25))
        )
        shading = small.ravel() / max(float(small.mean()), 1e-6)
        if small.mean() > 2:  # levels: the lamp is on
            seen.append(_Seen(number, shading, fine / max(coarse, 1e-6)))
    return seen


def _reduced(grey: np.ndarray, scale: float) -> np.ndarray:
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _frames(
    path: Path, max_pixels: int, step: int = 1
) -> Iterator[tuple[int, np.ndarray]]:
    """Numbers and pixels, `[H, W, 3]` (BGR), of every `step`-th frame."""
    capture = cv2.VideoCapture(str(path))
    try:
        width, height = (
            int(capture.get(side))
            for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        _check_size(path, height, width, max_pixels)
        number = 0
        while capture.grab():
            if number % step == 0:
                good, frame = capture.retrieve()
                if good:
                    yield number, frame
            number += 1
    finally:
        capture.release()
