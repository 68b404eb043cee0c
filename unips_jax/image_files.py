"""Reads one image file of any supported format, or says in one line why it cannot.

Formats: PNG, JPEG, TIFF, WebP, BMP and Radiance HDR through OpenCV, OpenEXR through
the `OpenEXR` package, recognised by content, 8 bit, 16 bit or float. Pixels come back
as they are stored: no scaling, no transfer function. Alpha is dropped.

The EXIF orientation is applied, for photographs and masks alike, so that pixels are
where every viewer shows them: a mask drawn over the displayed photograph fits.

A damaged file is never read as a picture with a grey rest: decoders that only
complain (on standard error, which is kept quiet here) are taken at their word, and
JPEG and PNG must have their end markers.
"""

import contextlib
import io
import math
import os
import re
import struct
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from unips_jax.command import InputError

SUFFIXES = frozenset(
    (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".exr", ".hdr")
)

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"IEND\xae\x42\x60\x82"
_ORIENTATION_TAG = 0x0112
_EXIF_TAG = 0x8769
_FOCAL_35MM_TAG = 0xA405
_DIAGONAL_MM = math.hypot(36, 24)


def read_image(path: Path) -> np.ndarray:
    """Reads an image in its storage type.

    Args:
        path: the file.

    Returns:
        `[H, W, C]`, C = 3 (RGB) or 1 (gray), uint8, uint16 or float32. Negative
        floats, which resampling leaves in renderings, become 0.

    Raises:
        InputError: if the file cannot be read, is damaged, has another type of pixels
            or values that are not finite.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise InputError(
            f"{path}: expected an image, got an empty file (0 bytes); copy it again or "
            "remove it"
        )
    with _quiet_decoders() as said:
        is_exr = data.startswith(_EXR_MAGIC)
        image = _decode_exr(path) if is_exr else _decode(data)
    complaint = _complaint(said)
    if image is None or complaint:
        raise InputError(
            f"{path}: expected a readable image, got a damaged, truncated or unknown "
            f"file{complaint}; copy or export it again, or remove it"
        )
    return _checked(path, image)


def exif_orientation(path: Path) -> int:
    """The orientation in a JPEG's EXIF data, 1 (upright) to 8; 1 where there is none.

    Args:
        path: the file; other formats give 1.
    """
    value = _exif(path).get(_ORIENTATION_TAG, 1)
    return value if 1 <= value <= 8 else 1


def exif_focal(path: Path, height: int, width: int) -> float | None:
    """The focal length in a JPEG's EXIF data, in pixels; None where there is none.

    Args:
        path: the file; other formats give None.
        height: of the image in pixels.
        width: likewise. The 35 mm equivalent refers to the images' diagonals.
    """
    equivalent = _exif(path).get(_FOCAL_35MM_TAG, 0)
    return equivalent / _DIAGONAL_MM * math.hypot(height, width) or None


def _exif(path: Path) -> dict[int, int]:
    """Integers among a JPEG's EXIF data, by tag."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        data = file.read(1 << 18)
        for marker, start, end in _jpeg_segments(data):
            if marker == 0xE1 and data[start : start + 6] == b"Exif\0\0":
                with contextlib.suppress(struct.error, KeyError):
                    return _tiff_tags(data[start + 6 : end])
    return {}


def _checked(path: Path, image: np.ndarray) -> np.ndarray:
    if image.dtype in (np.float16, np.float64):
        image = image.astype(np.float32)
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(
            f"{path}: expected 8-bit, 16-bit or float pixels, got {image.dtype}; "
            "export it as one of these"
        )
    if image.dtype == np.float32:
        bad = image.size - np.count_nonzero(np.isfinite(image))
        if bad:
            raise InputError(
                f"{path}: expected finite values, got {bad} NaN or infinite ones; "
                "replace them by 0 or remove the image"
            )
        image = np.maximum(image, 0)
    return image


def _decode(data: bytes) -> np.ndarray | None:
    """Decodes with OpenCV; None if the data is damaged or unknown."""
    if data.startswith(_PNG_MAGIC) and _PNG_END not in data:
        return None
    if data.startswith(_JPEG_MAGIC) and not _jpeg_ends(data):
        return None
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None
    if image is None:
        return None
    return image[..., None] if image.ndim == 2 else image[..., ::-1]


def _decode_exr(path: Path) -> np.ndarray | None:
    """Decodes R, G, B or else Y, of the only layer that has them."""
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        planes = {name: channel.pixels for name, channel in channels.items()}
    except Exception:  # the binding raises several kinds for a damaged file
        return None
    for colours in ("RGB", "rgb", "Y"):
        layers = {
            name[:-1] for name in planes if re.search(rf"(^|\.){colours[0]}$", name)
        }
        names = [layer + c for layer in sorted(layers)[:1] for c in colours]
        if len(layers) == 1 and all(name in planes for name in names):
            return np.stack([planes[name] for name in names], axis=-1)
    raise InputError(
        f"{path}: expected the channels R, G, B or Y in one layer, got "
        f"{', '.join(sorted(planes)) or 'none'}; export one RGB layer"
    )


@contextlib.contextmanager
def _quiet_decoders() -> Iterator[list[str]]:
    """Collects what decoders print: C libraries to descriptor 2, OpenEXR to Python.

    The descriptor is the whole process', so only its main thread may take it: threads
    that read training data would swallow what others print, or never give it back.
    """
    lines: list[str] = []
    if threading.current_thread() is not threading.main_thread():
        yield lines
        return
    sys.stderr.flush()
    saved = os.dup(2)
    printed = io.StringIO()
    with tempfile.TemporaryFile() as sink, contextlib.redirect_stdout(printed):
        os.dup2(sink.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            lines += sink.read().decode(errors="replace").splitlines()
            lines += printed.getvalue().splitlines()


def _complaint(lines: list[str]) -> str:
    """The first error among a decoder's lines, in parentheses; "" if none."""
    for line in lines:
        if re.search("error", line, re.IGNORECASE) and not re.search(
            "warn", line, re.IGNORECASE
        ):
            text = re.sub(r"^\[.*?\] global \S+ \S+ ", "", line)
            return f" (the decoder says: {text[:120]})"
    return ""


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields (marker, start, end) of a JPEG's segments, up to the first scan."""
    position = 2 if data.startswith(_JPEG_MAGIC) else len(data)
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # a fill byte
            position += 1
            continue
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        yield marker, position + 4, position + 2 + length
        if marker == 0xDA:
            return
        position += 2 + length


def _jpeg_ends(data: bytes) -> bool:
    """Whether the end marker follows the first scan (thumbnails have their own)."""
    for marker, _, end in _jpeg_segments(data):
        if marker == 0xDA:
            return data.find(_JPEG_END, end) >= 0
    return False


def _tiff_tags(data: bytes) -> dict[int, int]:
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
