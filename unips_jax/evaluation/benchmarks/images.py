"""Reading images, with errors that name the file.

A damaged image is never returned half decoded: it raises `InputError`, as do values
that are not finite.
"""

import contextlib
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks.files import read_bytes
from unips_jax.io.images import SUFFIXES, displayed, require_finite

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_NOT_PHOTOGRAPHS = re.compile(
    r"^(normals?|mask|depth|base_?color|roughness|metal(lic)?)([^a-z]|$)"
    r"|^gt([^a-z]|$)|(^|[._-])(gt|normals?|mask)$",
    re.IGNORECASE,
)


class ImageFacts(NamedTuple):
    """What an image file holds.

    Attributes:
        height: rows.
        width: columns.
        channels: 1, 3 or 4 (2: grey with transparency).
        bits: bits per channel: 8, 16, or 32 for floating point.
    """

    height: int
    width: int
    channels: int
    bits: int


def is_photograph(path: Path) -> bool:
    """True for an image file that is neither truth, mask, depth nor material map."""
    return (
        path.suffix.lower() in SUFFIXES
        and not path.name.startswith(".")
        and not _NOT_PHOTOGRAPHS.search(path.stem)
    )


def image_facts(data: bytes, path: Path) -> ImageFacts:
    """Size and type of an encoded image, checked to be whole.

    A PNG is checked by the checksums of its chunks, without decoding; other formats
    are decoded.

    Args:
        data: the file's bytes.
        path: named in errors; its suffix is not trusted.

    Raises:
        InputError: if the image is damaged, cut short, of no known format or, where
            it is decoded, not finite.
    """
    if data.startswith(_PNG):
        return _png_facts(data, path)
    image = _decode(data, path)
    bits = 32 if image.dtype == np.float32 else image.dtype.itemsize * 8
    height, width, channels = image.shape
    return ImageFacts(height, width, channels, bits)


def _png_facts(data: bytes, path: Path) -> ImageFacts:
    position, facts = len(_PNG), None
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            raise InputError(f"{path}: damaged PNG (a checksum does not match)")
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack_from(
                ">IIBB", data, position + 8
            )
            channels = _PNG_CHANNELS.get(colour, 0)
            facts = ImageFacts(height, width, channels, max(depth, 8))
        if kind == b"IEND" and facts is not None:
            return facts
        position = end
    raise InputError(f"{path}: the PNG is cut short; copy it again")


def read_image(path: Path) -> np.ndarray:
    """Decodes an image.

    Returns:
        `[H, W, C]` in the file's own type (uint8, uint16 or float32), channels in the
        order red, green, blue (alpha), C as in the file.

    Raises:
        InputError: if the file is missing, damaged, of no known format or not finite.
    """
    data = read_bytes(path)
    if data.startswith(_PNG):
        _png_facts(data, path)
    return _decode(data, path)


def _decode(data: bytes, path: Path) -> np.ndarray:
    exr = path.suffix.lower() == ".exr"
    image = _decode_exr(path) if exr else _decode_others(data, path)
    require_finite(path, image)
    return image


def _decode_others(data: bytes, path: Path) -> np.ndarray:
    if data.startswith(b"\xff\xd8") and not data.rstrip(b"\0").endswith(b"\xff\xd9"):
        raise InputError(f"{path}: the JPEG is cut short; copy it again")
    with _silent_opencv():
        try:
            buffer = np.frombuffer(data, np.uint8)
            image = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
    if image is None:
        raise InputError(f"{path}: not a readable image (damaged or of another format)")
    image = np.atleast_3d(image)
    if image.dtype not in (np.uint8, np.uint16, np.float32) or image.shape[2] > 4:
        raise InputError(
            f"{path}: expected an image of 8, 16 or 32 (float) bits and at most 4 "
            f"channels, got {image.dtype} with {image.shape[2]} channels"
        )
    if image.shape[2] >= 3:
        image = image[..., [2, 1, 0, 3][: image.shape[2]]]
    return np.ascontiguousarray(image)


def _decode_exr(path: Path) -> np.ndarray:
    import OpenEXR

    try:
        with OpenEXR.File(str(path)) as file:
            header = file.header()
            windows = header["dataWindow"], header["displayWindow"]
            channels = {
                name: displayed(np.atleast_3d(channel.pixels), *windows)
                for name, channel in file.channels().items()
            }
    except Exception as error:  # the library raises bare RuntimeErrors of all kinds
        raise InputError(f"{path}: not a readable EXR ({error})") from error
    for name in ("RGB", "RGBA"):
        if name in channels:
            return np.ascontiguousarray(channels[name][..., :3], np.float32)
    for names in ("RGB", "XYZ"):
        if set(names) <= set(channels):
            return np.concatenate([channels[c] for c in names], -1).astype(np.float32)
    if len(channels) == 1:
        return next(iter(channels.values())).astype(np.float32)
    raise InputError(
        f"{path}: expected EXR channels R, G, B or X, Y, Z, got {sorted(channels)}"
    )


@contextlib.contextmanager
def _silent_opencv() -> Iterator[None]:
    """Keeps OpenCV's own messages off standard error: ours follow."""
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(level)


def read_mask(path: Path) -> np.ndarray:
    """A mask image: `[H, W]`, bool, True where its first channel is above 0."""
    return read_image(path)[..., 0] > 0


def read_normals(path: Path) -> np.ndarray:
    """A normal map: x right, y up, z to the viewer, stored as (n + 1) / 2.

    Args:
        path: an image of 8 or 16 bits (n = 2 v / 255 - 1, n = 2 v / 65535 - 1), or an
            EXR, or a floating-point TIFF, which holds n itself.

    Returns:
        `[H, W, 3]`, float32, as stored: not normalised.

    Raises:
        InputError: if the image cannot be read or has fewer than three channels.
    """
    image = read_image(path)
    if image.shape[2] < 3:
        raise InputError(
            f"{path}: expected a normal map of 3 channels, got {image.shape[2]}"
        )
    image = image[..., :3]
    if image.dtype == np.float32:
        return image
    top = np.iinfo(image.dtype).max
    return (image.astype(np.float64) * (2 / top) - 1).astype(np.float32)


def has_unit_length(normals: np.ndarray) -> np.ndarray:
    """PS-Wild's rule for the object's pixels: | 1 - |n| | < 1e-3.

    Args:
        normals: `[H, W, 3]`.

    Returns:
        `[H, W]`, bool.
    """
    length = np.linalg.norm(normals.astype(np.float64), axis=-1)
    return np.abs(1 - length) < 1e-3
