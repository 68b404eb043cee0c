"""What is taken from EXIF data of JPEG, TIFF, PNG and WebP files."""

import contextlib
import math
import mmap
import struct
from collections.abc import Iterator
from pathlib import Path

JPEG_START = b"\xff\xd8\xff"
PNG_START = b"\x89PNG\r\n\x1a\n"
_EXIF_START = b"Exif\0\0"
_ORIENTATION_TAG = 0x0112
_EXIF_TAG = 0x8769
_FOCAL_35MM_TAG = 0xA405
_DIAGONAL_MM = math.hypot(36, 24)


def exif_orientation(path: Path) -> int:
    """The orientation in a file's EXIF data, 1 (upright) to 8; 1 where there is none.

    Args:
        path: the file; formats without EXIF data give 1.
    """
    value = _integers(path).get(_ORIENTATION_TAG, 1)
    return value if 1 <= value <= 8 else 1


def exif_focal(path: Path, height: int, width: int) -> float | None:
    """The focal length in a file's EXIF data, in pixels; None where there is none.

    Args:
        path: the file; formats without EXIF data give None.
        height: of the image in pixels.
        width: likewise. The 35 mm equivalent refers to the images' diagonals.
    """
    equivalent = _integers(path).get(_FOCAL_35MM_TAG, 0)
    return equivalent / _DIAGONAL_MM * math.hypot(height, width) or None


def jpeg_segments(data: bytes | mmap.mmap) -> Iterator[tuple[int, int, int]]:
    """Yields (marker, start, end) of a JPEG's segments, up to the first scan.

    Args:
        data: the file's bytes; another format has no segments.
    """
    position = 2 if data[:3] == JPEG_START else len(data)
    while position + 4 <= len(data):
        marker = data[position + 1]
        if data[position] != 0xFF or marker in (0, 0xFF):
            position += 1  # what decoders pass over between segments
            continue
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        yield marker, position + 4, position + 2 + length
        if marker == 0xDA:
            return
        position += 2 + length


def _integers(path: Path) -> dict[int, int]:
    """Integers among a file's EXIF data, by tag."""
    with (
        contextlib.suppress(OSError, ValueError, struct.error, KeyError),
        path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        for block in _blocks(data):
            return _tiff_integers(block)
    return {}


def _blocks(data: mmap.mmap) -> Iterator[bytes | mmap.mmap]:
    """EXIF data are a TIFF file's first directory, or such a file inside another."""
    if data[:4] in (b"II*\0", b"MM\0*"):
        yield data
    for marker, start, end in jpeg_segments(data):
        if marker == 0xE1 and data[start : start + 6] == _EXIF_START:
            yield data[start + 6 : end]
    if data[:8] == PNG_START:
        yield from _chunks(data, 8, b"eXIf", png=True)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        yield from _chunks(data, 12, b"EXIF", png=False)


def _chunks(
    data: mmap.mmap, position: int, name: bytes, *, png: bool
) -> Iterator[bytes]:
    """The contents of a PNG's or else WebP's chunks of one name, from a position on."""
    while position + 8 <= len(data):
        first, second = data[position : position + 4], data[position + 4 : position + 8]
        found = second if png else first
        length = (
            int.from_bytes(first, "big") if png else int.from_bytes(second, "little")
        )
        position += 8
        if found == name:
            yield data[position : position + length].removeprefix(_EXIF_START)
        position += length + (4 if png else length % 2)  # a checksum, or padding


def _tiff_integers(data: bytes | mmap.mmap) -> dict[int, int]:
    """The 16- and 32-bit integers of the first directory and the EXIF one."""
    order = {b"II": "<", b"MM": ">"}[data[:2]]
    found: dict[int, int] = {}
    (first,) = struct.unpack_from(order + "I", data, 4)
    for pointer in (None, _EXIF_TAG):
        offset = first if pointer is None else found.get(pointer)
        if offset is None:
            break
        (count,) = struct.unpack_from(order + "H", data, offset)
        for entry in range(offset + 2, offset + 2 + 12 * count, 12):
            tag, kind, _ = struct.unpack_from(order + "HHI", data, entry)
            if kind in (3, 4):
                code = order + ("H" if kind == 3 else "I")
                (found[tag],) = struct.unpack_from(code, data, entry + 8)
    return found
