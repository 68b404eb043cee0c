"""Reads one image file of any supported format, or says in one line why it cannot.

Formats: PNG, JPEG, TIFF, WebP, BMP and Radiance HDR through OpenCV, OpenEXR through
the `OpenEXR` package, recognised by content, 8 bit, 16 bit or float. Pixels come back
as they are stored: no scaling, no transfer function. Alpha is dropped (`read_opacity`
gives it).

The EXIF orientation is applied, for photographs and masks alike, so that pixels are
where every viewer shows them: a mask drawn over the displayed photograph fits.

A damaged file is not read as a picture with a wrong rest where its decoder notices:
those that only complain (on standard error, which is kept quiet here) are taken at
their word, and JPEG and PNG must have their end markers.
"""

import contextlib
import io
import os
import re
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from unips_jax.errors import InputError
from unips_jax.io.exif import JPEG_START, PNG_START, exif_orientation, jpeg_segments

SUFFIXES = frozenset(".png .jpg .jpeg .jfif .tif .tiff .webp .bmp .exr .hdr".split())

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_TIFF_MAGICS = (b"II*\0", b"MM\0*")
_JPEG_END = b"\xff\xd9"
_PNG_END = b"IEND\xae\x42\x60\x82"


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


def read_opacity(path: Path) -> np.ndarray | None:
    """Reads an image's alpha channel, turned like the image.

    Args:
        path: a file that `read_image` reads.

    Returns:
        `[H, W]`, in the storage type; None where there is none, or in EXR.
    """
    data = path.read_bytes()
    if data.startswith(_EXR_MAGIC):
        return None
    with _quiet_decoders():
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        return None
    alpha = image[..., 3]
    # OpenCV turns TIFFs whatever it is asked for, other formats but not unchanged.
    orientation = 1 if data.startswith(_TIFF_MAGICS) else exif_orientation(path)
    alpha = alpha.T if orientation >= 5 else alpha
    alpha = alpha[:, ::-1] if orientation in (2, 3, 6, 7) else alpha
    return alpha[::-1] if orientation in (3, 4, 7, 8) else alpha


def is_lossy(path: Path) -> bool:
    """Whether a file is a JPEG or a lossy WebP, by its content."""
    data = path.read_bytes()
    webp = data[8:12] == b"WEBP" and b"VP8 " in data
    return data.startswith(JPEG_START) or webp


def require_finite(path: Path, image: np.ndarray) -> None:
    """Raises InputError if an image's values are not all finite.

    Args:
        path: named in the error.
        image: of any shape; integers are finite.
    """
    bad = image.size - np.count_nonzero(np.isfinite(image))
    if bad:
        raise InputError(
            f"{path}: expected finite values, got {bad} NaN or infinite ones; replace "
            "them by 0 or remove the image"
        )


def _checked(path: Path, image: np.ndarray) -> np.ndarray:
    if image.dtype in (np.float16, np.float64):
        image = image.astype(np.float32)
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise InputError(
            f"{path}: expected 8-bit, 16-bit or float pixels, got {image.dtype}; "
            "export it as one of these"
        )
    require_finite(path, image)
    return np.maximum(image, 0) if image.dtype == np.float32 else image


def _decode(data: bytes) -> np.ndarray | None:
    """Decodes with OpenCV; None if the data is damaged or unknown."""
    if data.startswith(PNG_START) and _PNG_END not in data:
        return None
    if data.startswith(JPEG_START) and not _jpeg_ends(data):
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
        file = OpenEXR.File(str(path), separate_channels=True)
        header, channels = file.header(), file.channels()
        planes = {name: channel.pixels for name, channel in channels.items()}
    except Exception:  # the binding raises several kinds for a damaged file
        return None
    for colours in ("RGB", "rgb", "Y"):
        layers = {
            name[:-1] for name in planes if re.search(rf"(^|\.){colours[0]}$", name)
        }
        names = [layer + c for layer in sorted(layers)[:1] for c in colours]
        if len(layers) == 1 and all(name in planes for name in names):
            image = np.stack([planes[name] for name in names], axis=-1)
            return displayed(image, header["dataWindow"], header["displayWindow"])
    raise InputError(
        f"{path}: expected the channels R, G, B or Y in one layer, got "
        f"{', '.join(sorted(planes)) or 'none'}; export one RGB layer"
    )


def displayed(
    image: np.ndarray,
    data: tuple[np.ndarray, np.ndarray],
    display: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """The display window of an EXR image; zeros where it has no data.

    Args:
        image: `[h, w, C]`, the data window.
        data: the window's first and last (x, y).
        display: likewise.
    """
    (left, top), (right, bottom) = data[0] - display[0], data[1] - display[0] + 1
    width, height = display[1] - display[0] + 1
    if (left, top, right, bottom) == (0, 0, width, height):
        return image
    result = np.zeros((height, width, image.shape[-1]), image.dtype)
    rows = slice(max(top, 0), min(bottom, height))
    columns = slice(max(left, 0), min(right, width))
    if rows.start < rows.stop and columns.start < columns.stop:
        result[rows, columns] = image[
            rows.start - top : rows.stop - top,
            columns.start - left : columns.stop - left,
        ]
    return result


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
        # Some cameras leave extraneous bytes between a JPEG's segments: no damage.
        if re.search("error|corrupt|premature end", line, re.IGNORECASE) and not (
            re.search("warn|extraneous bytes", line, re.IGNORECASE)
        ):
            text = re.sub(r"^\[.*?\] global \S+ \S+ ", "", line)
            return f" (the decoder says: {text[:120]})"
    return ""


def _jpeg_ends(data: bytes) -> bool:
    """Whether the end marker follows the first scan (thumbnails have their own)."""
    for marker, _, end in jpeg_segments(data):
        if marker == 0xDA:
            return data.find(_JPEG_END, end) >= 0
    return False
