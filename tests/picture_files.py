"""Pictures, and files of them as bytes."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from unips_jax.io.images import read_image_file

SIZE = HEIGHT, WIDTH = 23, 37


def noise(dtype, channels, *, seed=0, top=None):
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return rng.random((*SIZE, channels)).astype(dtype)
    top = np.iinfo(dtype).max if top is None else top
    return rng.integers(0, top + 1, (*SIZE, channels)).astype(dtype)


def read(path, data):
    path.write_bytes(data)
    return read_image_file(path)


def smooth(dtype, seed=0, height=HEIGHT, width=WIDTH):
    """A smooth random RGB picture that uses most of the type's range."""
    coarse = np.random.default_rng(seed).random((4, 5, 3)).astype(np.float32)
    picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    if dtype == np.float32:
        return picture * 3
    return (picture * np.iinfo(dtype).max).astype(dtype)


def save(path: Path, rgb: np.ndarray):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() == ".exr":
        planes = {"RGB": np.ascontiguousarray(rgb)}
        if rgb.ndim == 2:
            planes = {"Y": np.ascontiguousarray(rgb)}
        OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(path))
    else:
        bgr = rgb if rgb.ndim == 2 else rgb[..., [2, 1, 0, 3][: rgb.shape[-1]]]
        best = {
            ".webp": [cv2.IMWRITE_WEBP_QUALITY, 101],
            ".jpg": [
                cv2.IMWRITE_JPEG_QUALITY,
                100,
                cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
                cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
            ],
        }
        suffix = path.suffix.lower().replace("jfif", "jpg")
        _, data = cv2.imencode(suffix, bgr, best.get(suffix, []))
        path.write_bytes(data.tobytes())
    return path


def png(values, kind, bits, chunks):
    height, width = values.shape[:2]
    if bits < 8:
        unpacked = np.unpackbits(values, axis=-1)[..., 8 - bits :]
        rows = np.packbits(unpacked.reshape(height, -1), axis=-1)
    else:
        rows = values.astype(values.dtype.newbyteorder(">")).reshape(height, -1)
    body = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    parts = {b"IHDR": header, **chunks, b"IDAT": zlib.compress(body), b"IEND": b""}
    data = b"\x89PNG\r\n\x1a\n"
    for name, part in parts.items():
        checksum = struct.pack(">I", zlib.crc32(name + part))
        data += struct.pack(">I", len(part)) + name + part + checksum
    return data


def exif(orientation):
    tiff = struct.pack("<2sHIHHHII", b"II", 42, 8, 1, 0x0112, 3, 1, orientation)
    return tiff + b"\0\0\0\0"


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    body = b"Exif\0\0" + exif(orientation)
    segment = b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
    return jpeg[:2] + segment + jpeg[2:]


def tiff_with_orientation(tiff, orientation):
    """With a new first directory, at the end, that has the tag too."""
    (directory,) = struct.unpack_from("<I", tiff, 4)
    (count,) = struct.unpack_from("<H", tiff, directory)
    entries = [
        tiff[directory + 2 + 12 * i : directory + 14 + 12 * i] for i in range(count)
    ]
    entries.append(struct.pack("<HHII", 0x0112, 3, 1, orientation))
    entries.sort(key=lambda entry: struct.unpack_from("<H", entry))
    end = len(tiff) + len(tiff) % 2
    return (
        tiff[:4]
        + struct.pack("<I", end)
        + tiff[8:].ljust(end - 8, b"\0")
        + struct.pack("<H", count + 1)
        + b"".join(entries)
        + b"\0\0\0\0"
    )


def png_with_orientation(png, orientation):
    chunk = b"eXIf" + exif(orientation)
    length, checksum = struct.pack(">I", len(chunk) - 4), zlib.crc32(chunk)
    return png[:33] + length + chunk + struct.pack(">I", checksum) + png[33:]
