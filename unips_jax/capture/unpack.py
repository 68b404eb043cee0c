"""Photographs that lie in one file: the pages of a TIFF, the frames of a video."""

import contextlib
import dataclasses
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
import tifffile

from unips_jax.errors import InputError
from unips_jax.io.color import CURVES, encoding_of, srgb_encode
from unips_jax.io.door import NotWritten, new_file, write_whole
from unips_jax.io.formats.encoded import NotRead, box_transfer_code, known_code
from unips_jax.io.formats.raster import marked_srgb
from unips_jax.io.formats.tiff import count_pages, open_page, whole_pages
from unips_jax.io.images import MAX_PIXELS, encode_image
from unips_jax.io.naming import VIDEO_SUFFIXES
from unips_jax.io.results import clear_leftovers, workspace

KEYFRAMES = 12
"""Frames that are taken of a video by default."""

_LOOKED_AT = 300  # frames
_MOST_FRAMES = 100_000  # of a video: an hour
_MOST_PAGES = 4096  # of a TIFF
_PAGES_TOGETHER = 10  # times the pixels that a photograph may have
_MOST_BOXES = 1 << 26  # bytes of what describes a video
_VIDEO = re.compile(
    rb"....(?:ftyp|moov|mdat|wide|free|skip)|RIFF....AVI |\x1a\x45\xdf\xa3|"
    rb"\x30\x26\xb2\x75|\x00\x00\x01[\xb3\xba]|(?:.{4})?\x47",
    re.DOTALL,
)
"""How MP4, AVI, Matroska, WMV, MPEG and its transport streams begin. Others, such as
play lists that name files elsewhere, do not reach the decoder."""
_HDR = (16, 18)  # which decoders tone-map or not, by their version
_MATROSKA_COLOURS = re.compile(rb"\x55\xb0.{1,60}?\x55\xba\x81(.)", re.DOTALL)
_THUMB = 48  # pixels of the longer side
_SHARP = 0.8  # of the sharpest of neighbours
_NEIGHBOURS = 2
_ICC, _ORIENTATION, _YCBCR = 34675, 274, 6


def is_container(path: Path) -> bool:
    """Whether a path is, by its name, a file that may hold several photographs."""
    suffix = path.suffix.lower()
    return suffix in (".tif", ".tiff", *VIDEO_SUFFIXES) and path.is_file()


@contextlib.contextmanager
def unpacked(
    path: Path, *, frames: int = KEYFRAMES, max_pixels: int = MAX_PIXELS
) -> Iterator[Path]:
    """Gives a folder, for as long as it is needed, of the photographs in one file.

    A TIFF of several pages, or a video of a still object under a lamp that moves, of
    which the `frames` whose light differs most are taken.
    """
    temporary = Path(tempfile.gettempdir())
    clear_leftovers(temporary)
    with workspace(temporary) as place:
        folder = place / path.stem
        folder.mkdir()
        try:
            if path.suffix.lower() in VIDEO_SUFFIXES:
                _unpack_video(path, folder, frames, max_pixels)
            else:
                _unpack_pages(path, folder, max_pixels)
            yield folder
        except NotWritten as error:
            raise InputError(
                f"{temporary}: cannot hold what {path} unpacks to "
                f"({error.reason}); free space there, or set TMPDIR"
            ) from None
        except InputError as error:
            raise InputError(without_place(str(error), folder, path)) from None


def without_place(text: str, folder: Path, path: Path) -> str:
    """What is said of the folder of `unpacked`, which goes, said of the file."""
    part = re.escape(str(folder)) + r"(?:[/\\]([^:,;]+)\.\w+)?"
    return re.sub(part, lambda m: f"{path} {m[1] or ''}".rstrip(), text)


def _unpack_pages(path: Path, folder: Path, max_pixels: int) -> None:
    try:
        with path.open("rb") as opened:
            count_pages(opened, _MOST_PAGES)
        # Of an OME-TIFF other files may be parts.
        with tifffile.TiffFile(path, is_ome=False) as tiff:
            images = _pages(tiff, path, max_pixels)
            for index, (pixels, icc, turn) in enumerate(images, 1):
                samples = pixels.shape[2] if pixels.ndim == 3 else 1
                with new_file(folder / f"page_{index:03}.tif") as file:
                    tifffile.imwrite(
                        file,
                        pixels,
                        photometric="rgb" if samples > 2 else "minisblack",
                        planarconfig="contig" if samples > 1 else None,
                        extrasamples=["unassalpha"] if samples in (2, 4) else None,
                        iccprofile=icc,
                        extratags=[(_ORIENTATION, "H", 1, int(turn), True)],
                        metadata=None,
                    )
    except (InputError, OSError):
        raise
    except Exception as error:  # the library raises many kinds
        raise InputError(
            f"{path}: expected a TIFF of several photographs, got one that cannot be "
            f"read ({' '.join(str(error).split())[:120]}); save each page as a file of "
            "its own"
        ) from None


def _pages(
    tiff: tifffile.TiffFile, path: Path, max_pixels: int
) -> Iterator[tuple[np.ndarray, bytes | None, int]]:
    pages = whole_pages(tiff)
    stack, facts = None, tiff.imagej_metadata or {}
    images, channels = (int(facts.get(name, 1)) for name in ("images", "channels"))
    if channels in (2, 3) and images > channels and pages[0].samplesperpixel == 1:
        raise InputError(
            f"{path}: expected photographs as pages, got {channels} colours of each as "
            "pages of their own; save each photograph as an RGB file"
        )
    # ImageJ's stacks may be one page.
    if len(pages) == 1 and images > 1:
        _check_size(path, pages[0].imagelength, pages[0].imagewidth, max_pixels)
        stack = tiff.series[0].asarray()
    count = len(pages) if stack is None else len(stack)
    if count < 2:
        raise InputError(
            f"{path}: expected a folder of photographs, or a TIFF of several, got "
            f"one of {count}; give its folder, {path.parent}"
        )
    sizes = [page.imagelength * page.imagewidth for page in pages]
    pixels_in_all = sum(sizes) if stack is None else count * sizes[0]
    if pixels_in_all > _PAGES_TOGETHER * max_pixels:
        raise InputError(
            f"{path}: expected at most {_PAGES_TOGETHER * max_pixels:,} pixels in all "
            f"pages, got {pixels_in_all:,}; raise --max-pixels, or save the pages that "
            "are wanted as files"
        )
    for index in range(count):
        page = pages[0 if stack is not None else index]
        _check_size(path, page.imagelength, page.imagewidth, max_pixels)
        icc, turn = page.tags.valueof(_ICC), page.tags.valueof(_ORIENTATION) or 1
        if stack is not None:
            pixels = stack[index]
        elif page.photometric == _YCBCR:  # of a JPEG, which tifffile makes RGB
            pixels = page.asarray()
        else:  # as of a file of its own: palettes, few bits, white at zero
            pixels = open_page(page).decode()
        yield pixels, icc, turn


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
    table = _table(path)
    seen = _look_through(path, max_pixels)
    if len(seen) < 2:
        raise InputError(
            f"{path}: expected a video of some seconds, got {len(seen)} frames that "
            "can be read; export it as MP4 (H.264)"
        )
    chosen = {seen[i].number for i in choose_frames(seen, frames)}
    for number, seconds, frame in _frames(path, max_pixels):
        if number in chosen:
            pixels = frame[..., ::-1]
            data = encode_image(".png", pixels if table is None else table[pixels])
            name = f"at_{int(seconds // 60):02}m{seconds % 60:06.3f}s.png"
            data = data if table is None else marked_srgb(data)
            write_whole(folder / name, data, sync=False)


def _table(path: Path) -> np.ndarray | None:
    """What replaces a video's 8-bit values, so that they are sRGB; see `io.color`."""
    try:
        with path.open("rb") as opened:
            head = opened.read(1 << 16)
            if not _VIDEO.match(head):
                raise InputError(
                    f"{path}: expected a video, got a file that does not begin like "
                    "one; export it as MP4 (H.264)"
                )
            found = _MATROSKA_COLOURS.search(head)
            code = found[1][0] if found else box_transfer_code(_description(opened))
        if code in _HDR:
            kind = f"an HDR video ({CURVES[code][0]})"
            raise NotRead(kind, "record or export it without HDR, as H.264")
        encoding = encoding_of(np.uint8, code=known_code(code, "a video"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except NotRead as error:
        raise InputError(
            f"{path}: expected a video that can be read, got {error}; {error.fix}"
        ) from None
    if encoding.transfer == "linear":
        levels = np.arange(256) / 255
        return np.rint(srgb_encode(levels) * 65535).astype(np.uint16)
    return encoding.table


def _description(opened: BinaryIO) -> bytes:
    """An MP4's box `moov`; empty where there is none."""
    place, end = 0, opened.seek(0, os.SEEK_END)
    for _ in range(_MOST_PAGES):
        opened.seek(place)
        head = opened.read(16)
        if len(head) < 8:
            break
        size = int.from_bytes(head[:4], "big")
        size = int.from_bytes(head[8:], "big") if size == 1 else size or end - place
        if head[4:8] == b"moov":
            return opened.read(min(size, _MOST_BOXES))
        place += max(size, 8)
    return b""


def choose_frames(seen: list[_Seen], count: int) -> list[int]:
    """Which frames differ most in light, and are sharp among their neighbours."""
    # Each next one is the farthest from all that were chosen before (Gonzalez, 1985).
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
    capture = _opened(path)
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    step = max(1, total // _LOOKED_AT)
    seen = []
    for number, _, frame in _frames(path, max_pixels, step):
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


def _opened(path: Path) -> cv2.VideoCapture:
    # A relative "a:b" would name a protocol.
    whole = os.path.abspath(path)
    try:
        whole.encode()
    except UnicodeEncodeError:  # which ends OpenCV's process
        raise InputError(
            f"{path}: expected a path in UTF-8 for a video, got other bytes; rename it"
        ) from None
    return cv2.VideoCapture(whole)


def _reduced(grey: np.ndarray, scale: float) -> np.ndarray:
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _frames(
    path: Path, max_pixels: int, step: int = 1
) -> Iterator[tuple[int, float, np.ndarray]]:
    """Numbers, times in s and pixels, `[H, W, 3]` (BGR), of every `step`-th frame."""
    capture = _opened(path)
    try:
        width, height, rate = (
            capture.get(what)
            for what in (
                cv2.CAP_PROP_FRAME_WIDTH,
                cv2.CAP_PROP_FRAME_HEIGHT,
                cv2.CAP_PROP_FPS,
            )
        )
        _check_size(path, int(height), int(width), max_pixels)
        rate = rate if 0.1 < rate < 10_000 else 25.0
        number = 0
        while capture.grab():
            if number % step == 0:
                good, frame = capture.retrieve()
                if good:
                    yield number, number / rate, frame
            number += 1
            if number > _MOST_FRAMES:
                raise InputError(
                    f"{path}: expected a video of at most {_MOST_FRAMES:,} frames, got "
                    "more; cut out the part that shows the object"
                )
    finally:
        capture.release()
