"""ICC profiles and PNG chunks, byte by byte."""

import struct
import zlib

from picture_files import save


def gamma_curve(exponent: float) -> bytes:
    return b"curv" + struct.pack(">IIH", 0, 1, round(exponent * 256))


def parametric(kind: int, *numbers: float) -> bytes:
    fixed = [round(number * 65536) for number in numbers]
    return b"para" + struct.pack(f">IHH{len(fixed)}i", 0, kind, 0, *fixed)


def rgb_profile(curve: bytes, *columns) -> bytes:
    """A matrix profile: red, green and blue as XYZ under D50."""
    bodies = {b"wtpt": (0.9642, 1, 0.8249)}
    bodies |= dict(zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns, strict=True))
    parts = {
        name: b"XYZ " + struct.pack(">I3i", 0, *(round(65536 * x) for x in xyz))
        for name, xyz in bodies.items()
    }
    parts |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    start, tags, data = 132 + 12 * len(parts), b"", b""
    for name, body in parts.items():
        tags += struct.pack(">4sII", name, start + len(data), len(body))
        data += body
    head = bytearray(128)
    head[:4] = struct.pack(">I", start + len(data))
    head[8:12], head[12:24], head[36:40] = b"\2\x20\0\0", b"mntrRGB XYZ ", b"acsp"
    head[68:80] = struct.pack(">3I", 0xF6D6, 0x10000, 0xD32D)
    return bytes(head) + struct.pack(">I", len(parts)) + tags + data


SRGB_CURVE = parametric(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
P3 = rgb_profile(
    SRGB_CURVE,
    (0.51512, 0.2412, -0.00105),
    (0.29198, 0.69225, 0.04189),
    (0.1571, 0.06657, 0.78407),
)
ADOBE = rgb_profile(
    gamma_curve(563 / 256) + bytes(2),
    (0.60974, 0.31111, 0.01947),
    (0.20528, 0.62567, 0.06087),
    (0.14919, 0.06322, 0.74457),
)


def chunk(name: bytes, body: bytes) -> bytes:
    """A chunk of a PNG, with its checksum."""
    checksum = struct.pack(">I", zlib.crc32(name + body))
    return struct.pack(">I", len(body)) + name + body + checksum


def tagged_png(path, pixels, *chunks):
    """A PNG with further chunks behind its header."""
    png = save(path, pixels).read_bytes()
    path.write_bytes(png[:33] + b"".join(chunks) + png[33:])
    return path
