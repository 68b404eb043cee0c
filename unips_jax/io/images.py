"""Reads and writes one image file; errors are one line.

Pixels come back as they are stored: no scaling, no transfer function, no alpha divided
out. The EXIF orientation is applied, for photographs, masks and maps alike, so that
pixels are where every viewer shows them: a mask drawn over the displayed photograph
fits. A file is opened once; the size in its header is believed only after a look at
`MAX_PIXELS`. Which formats: see `io.formats`.
"""

import dataclasses
import io
import math
import os
import stat
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.io.color import Encoding, Transfer, as_linear, in_srgb
from unips_jax.io.door import write_whole
from unips_jax.io.formats import Damaged, Encoded, NotRead, decode, open_encoded

MAX_PIXELS = 200_000_000
"""The largest image that is read by default; sensors have 150 million."""

_DIAGONAL_MM = math.hypot(36, 24)
_WIDEST = 40  # bytes of a pixel: four doubles and room for metadata


@dataclasses.dataclass(frozen=True)
class ImageFile:
    """An image file, read."""

    path: Path
    pixels: np.ndarray  # `[H, W, C]`, C = 3 (RGB) or 1 (grey), uint8, uint16 or float32
    alpha: np.ndarray | None  # `[H, W]`, of the same type; None where there is none
    orientation: int  # by EXIF, 1 (upright) to 8, applied already
    focal: float | None  # focal length in pixels, by EXIF; None where unknown
    header: Encoded  # what else the file holds

    @property
    def encoding(self) -> Encoding:
        """How its values encode light, by its own tags."""
        return self.header.encoding

    @property
    def channels(self) -> int:
        """As stored, alpha included."""
        return self.header.channels


def read_image(path: Path) -> np.ndarray:
    """Reads an image's pixels: `[H, W, 1 or 3]`, as in `ImageFile`, all finite."""
    file = read_image_file(path)
    require_finite(path, file.pixels)
    return file.pixels


def read_image_file(
    path: Path, *, vectors: bool = False, max_pixels: int = MAX_PIXELS
) -> ImageFile:
    """Reads an image file; `vectors`: of normals. Values need not be finite."""
    data = read_bytes(path, max_pixels=max_pixels)
    return decode_image(data, path, vectors=vectors, max_pixels=max_pixels)


def read_bytes(path: Path, *, max_pixels: int = MAX_PIXELS) -> bytes:
    """The contents of an image file, which is regular, not empty and not too large."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(
                f"{path}: expected a regular file, got a folder, pipe or device; "
                "remove it"
            )
        if status.st_size > max_pixels * _WIDEST:
            raise _too_large(path, f"a file of {status.st_size:,} bytes", max_pixels)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise InputError(
            f"{path}: expected an image, got an empty file (0 bytes); copy it again or "
            "remove it"
        )
    return data


def decode_image(
    data: bytes, path: Path, *, vectors: bool = False, max_pixels: int = MAX_PIXELS
) -> ImageFile:
    """Decodes an image file's contents, as `read_image_file` does."""
    header = image_header(data, path, vectors=vectors, max_pixels=max_pixels)
    pixels, alpha = _decoded(header, path)
    diagonal = math.hypot(header.height, header.width)
    return ImageFile(
        path,
        turned(pixels, header.orientation),
        None if alpha is None else turned(alpha, header.orientation),
        header.orientation,
        header.focal_35mm / _DIAGONAL_MM * diagonal or None,
        dataclasses.replace(header, decode=_nothing),
    )


def image_header(
    data: bytes, path: Path, *, vectors: bool = False, max_pixels: int = MAX_PIXELS
) -> Encoded:
    """An image file's header; pixels are not decoded. `vectors`: of normals."""
    try:
        header = open_encoded(data, vectors=vectors, suffix=path.suffix.lower())
    except (NotRead, Damaged) as error:
        raise _unreadable(path, error) from None
    if max(header.height * header.width, header.allocated) > max_pixels:
        size = f"{header.width} x {header.height} = {header.width * header.height:,}"
        raise _too_large(path, size, max_pixels)
    return header


def check_image(data: bytes, path: Path) -> tuple[int, int, int, np.dtype]:
    """Height, width, channels and type of an image, which is checked to be whole.

    A PNG by the checksums of its chunks; others are decoded, their values finite.
    """
    header = image_header(data, path)
    if not header.checked:
        require_finite(path, _decoded(header, path)[0])
    height, width = header.height, header.width
    if header.orientation >= 5:
        height, width = width, height
    return height, width, header.channels, header.dtype


def read_linear(path: Path) -> np.ndarray:
    """An image file's linear light, all finite: `[H, W, 3]`."""
    file = read_image_file(path)
    require_finite(path, file.pixels)
    return linear_of(file, file.encoding.transfer)


def linear_of(file: ImageFile, transfer: Transfer) -> np.ndarray:
    """A file's linear light in sRGB's colours, `[H, W, 3]`; its values encode it so."""
    encoding = file.encoding
    linear = as_linear(encoding.values(file.pixels), transfer)
    if linear.shape[2] == 3:
        linear = in_srgb(linear, encoding.to_srgb)
    return np.broadcast_to(linear, (*linear.shape[:2], 3))


def require_size(
    path: Path, got: tuple[int, ...], normals: tuple[int, ...], fix: str = "resize it"
) -> None:
    """Raises InputError if a map has not the size `[H, W]` of its normals."""
    if tuple(got) != tuple(normals):
        expected, came = (" x ".join(map(str, s[::-1])) for s in (normals, got))
        raise InputError(
            f"{path}: expected the normals' size, {expected}, got {came}; {fix}"
        )


def require_finite(path: Path, values: np.ndarray) -> None:
    """Raises InputError if an image's values are not all finite."""
    bad = values.size - np.count_nonzero(np.isfinite(values))
    if bad:
        raise InputError(
            f"{path}: expected finite values, got {bad} NaN or infinite ones; replace "
            "them by 0 or remove the image"
        )


def encode_image(suffix: str, pixels: np.ndarray) -> bytes:
    """A file's contents by its suffix; pixels are `[H, W, 3]` (RGB) or `[H, W]`."""
    if pixels.ndim == 3:
        pixels = pixels[..., ::-1]
    return cv2.imencode(suffix, np.ascontiguousarray(pixels))[1].tobytes()


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Writes an image in its suffix's format, under any name; makes its folder."""
    write_whole(path, encode_image(path.suffix, pixels), sync=False)


def write_exr(
    path: Path, channels: Mapping[str, np.ndarray], comments: str = ""
) -> None:
    """Writes channels of float32 as a compressed OpenEXR file."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if comments:
        header["comments"] = comments
    pixels = {name: np.ascontiguousarray(c, np.float32) for name, c in channels.items()}
    data = io.BytesIO()  # OpenEXR's own errors lack the file system's reason
    OpenEXR.File(header, pixels).write(data)
    write_whole(path, data.getbuffer(), sync=False)


def check_picture(path: Path, option: str) -> None:
    """Refuses what `write_image` could not write, before there is a picture."""
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif"):
        raise InputError(
            f"{option}: expected a file ending in .png, .jpg or .tif, got {path}"
        )
    if path.is_dir():
        raise InputError(f"{option}: expected a file's name, got a folder's, {path}")
    make_folder(path.parent, option)
    if path.exists() and not os.access(path, os.W_OK):
        raise InputError(
            f"{option} {path}: expected a file that may be written to, got one that "
            "may not; choose another"
        )


def _decoded(header: Encoded, path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        return decode(header)
    except (NotRead, Damaged) as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> InputError:
    if isinstance(error, NotRead):
        return InputError(
            f"{path}: expected an image that can be read, got {error}; {error.fix}, or "
            "remove it"
        )
    reason = f" ({error})" if str(error) else ""
    return InputError(
        f"{path}: expected a readable image, got a damaged, truncated or unknown "
        f"file{reason}; copy or export it again, or remove it"
    )


def _too_large(path: Path, size: str, max_pixels: int) -> InputError:
    return InputError(
        f"{path}: expected at most {max_pixels:,} pixels, got {size}; make it smaller, "
        "or raise --max-pixels of `unips estimate`"
    )


def turned(image: np.ndarray, orientation: int) -> np.ndarray:
    """An image that lies as stored, as viewers show it; orientation: 1 to 8."""
    image = image.swapaxes(0, 1) if orientation >= 5 else image
    image = image[:, ::-1] if orientation in (2, 3, 6, 7) else image
    return image[::-1] if orientation in (3, 4, 7, 8) else image


def _nothing() -> np.ndarray:
    raise RuntimeError("the file's contents are gone")
