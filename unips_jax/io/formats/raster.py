"""JPEG, PNG, WebP, Radiance HDR, BMP, GIF and PNM."""

import io
import logging
import re
import struct
import warnings
import zlib
from collections.abc import Iterator
from typing import Any

import imagecodecs
import numpy as np
import simplejpeg
from PIL import Image

from unips_jax.io.color import PRIMARIES
from unips_jax.io.formats.encoded import (
    Damaged,
    Encoded,
    NotRead,
    exif_facts,
    known_code,
)

# Its warnings, of chunks that are not needed, do not belong on a user's terminal.
logging.getLogger("imagecodecs").addHandler(logging.NullHandler())

_MARKER = re.compile(rb"\xff([^\0\xff])", re.DOTALL)
JPEG_MAGIC = b"\xff\xd8\xff"
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"

_SEQUENTIAL = {0xC0, 0xC1, 0xC9}  # baseline, extended
_FRAMES = {*_SEQUENTIAL, 0xC2, 0xCA}  # progressive ones too
_SCAN = 0xDA
_OTHER_FRAMES = {0xC3, 0xC5, 0xC6, 0xC7, 0xCB, 0xCD, 0xCE, 0xCF}
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_PROFILE_LIMIT = 4 << 20  # bytes of a colour profile
_PARTS = 4096  # segments or chunks of one file, of which some dozens are usual
_BYTE = np.dtype(np.uint8)


def open_jpeg(data: bytes) -> Encoded:
    """Reads a JPEG's segments; see `formats.open_encoded`."""
    frame, exif, icc, kept, sequential = None, b"", [], [data[:2]], False
    for marker, start, end in jpeg_segments(data):
        kept.append(data[start - 4 : end])
        if marker in _OTHER_FRAMES:
            raise NotRead("a lossless or hierarchical JPEG")
        if marker in _FRAMES:
            frame = struct.unpack_from(">BHHB", data, start)
            sequential = marker in _SEQUENTIAL
        if marker == _SCAN and sequential:
            # All coefficients, which some phones state as none: decoders complain.
            kept[-1] = kept[-1][:-3] + b"\0\x3f\0"
        if marker == 0xE1 and data[start : start + 6] == b"Exif\0\0":
            exif = exif or data[start:end]
        if marker == 0xE2 and data[start : start + 12] == b"ICC_PROFILE\0":
            icc.append(data[start + 14 : end])
    if frame is None:
        raise Damaged("without a frame")
    bits, height, width, channels = frame
    if bits != 8:
        raise NotRead(f"a {bits}-bit JPEG")
    if channels not in (1, 3):
        raise NotRead("a CMYK JPEG" if channels == 4 else f"a JPEG of {channels} inks")
    # Some cameras leave bytes between the segments. Any other complaint is damage.
    clean = b"".join(kept) + data[end:]
    colours = "GRAY" if channels == 1 else "RGB"
    return Encoded(
        "JPEG",
        height,
        width,
        channels,
        False,
        _BYTE,
        lambda: (
            np.squeeze(simplejpeg.decode_jpeg(clean, colours, strict=True), 2)
            if channels == 1
            else simplejpeg.decode_jpeg(clean, colours, strict=True)
        ),
        icc=b"".join(icc),
        **exif_facts(exif),  # type: ignore[arg-type]
    )


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """A JPEG's segments, (marker, start behind its length, end), up to a scan."""
    position = 2
    for _ in range(_PARTS):
        # Decoders pass over what lies between segments.
        found = _MARKER.search(data, position)
        if found is None or found.end() + 2 > len(data):
            return
        start = found.end() + 2
        position = found.end() + int.from_bytes(data[found.end() : start], "big")
        yield found[1][0], start, position
        if found[1][0] == _SCAN:
            return
    raise Damaged(f"more than {_PARTS} segments")


def open_png(data: bytes) -> Encoded:
    """Reads a PNG's chunks, checksums included; see `formats.open_encoded`."""
    chunks: dict[bytes, bytes] = {}
    position, others = len(PNG_MAGIC), 0
    while b"IEND" not in chunks:
        if position + 12 > len(data):
            raise Damaged("cut short")
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            raise Damaged("cut short")
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            raise Damaged("a checksum does not match")
        if kind != b"IDAT":
            others += 1
            chunks.setdefault(kind, data[position + 8 : end - 4])
        if others > _PARTS:
            raise Damaged(f"more than {_PARTS} chunks without pixels")
        position = end
    if b"acTL" in chunks:
        raise NotRead("an animated PNG")
    width, height, bits, colour = struct.unpack_from(">IIBB", chunks[b"IHDR"])
    transparent = b"tRNS" in chunks
    facts = exif_facts(chunks.get(b"eXIf", b""))
    return Encoded(
        "PNG",
        height,
        width,
        _PNG_CHANNELS[colour] + transparent,
        colour in (4, 6) or transparent,
        np.dtype(np.uint16 if bits == 16 else np.uint8),
        lambda: imagecodecs.png_decode(data),
        checked=True,
        **{**facts, **_png_colours(chunks)},  # type: ignore[arg-type]
    )


def _png_colours(chunks: dict[bytes, bytes]) -> dict[str, Any]:
    """Fields of `Encoded` by the first of cICP, iCCP, sRGB and gAMA."""
    primaries, transfer = chunks.get(b"cICP", b"").ljust(2, b"\0")[:2]
    if code := known_code(transfer, "a PNG"):
        return {"code": code, "primaries": PRIMARIES.get(primaries, ())}
    if icc := _unpacked_profile(chunks.get(b"iCCP", b"")):
        return {"icc": icc}
    if b"sRGB" in chunks:
        return {"srgb": True, "primaries": ()}
    if len(gamma := chunks.get(b"gAMA", b"")) == 4:
        return {"gamma": int.from_bytes(gamma, "big") / 100_000}
    return {}


def marked_srgb(png: bytes) -> bytes:
    """A PNG without tags, with one that its values are sRGB, whatever their bits."""
    body = b"sRGB\0"
    chunk = struct.pack(">I", 1) + body + struct.pack(">I", zlib.crc32(body))
    return png[:33] + chunk + png[33:]  # behind signature and header


def _unpacked_profile(chunk: bytes) -> bytes:
    """The profile in a PNG's chunk; one that is damaged counts as none."""
    _, _, packed = chunk.partition(b"\0")
    try:
        return zlib.decompressobj().decompress(packed[1:], _PROFILE_LIMIT)
    except zlib.error:
        return b""


def open_webp(data: bytes) -> Encoded:
    """Reads a WebP's chunks; see `formats.open_encoded`."""
    chunks: dict[bytes, bytes] = {}
    position, parts = 12, 0
    while position + 8 <= len(data):
        parts += 1
        if parts > _PARTS:
            raise NotRead(f"a WebP of more than {_PARTS} chunks")
        name, length = struct.unpack_from("<4sI", data, position)
        chunks.setdefault(name, data[position + 8 : position + 8 + length])
        position += 8 + length + length % 2
    if b"ANIM" in chunks:
        raise NotRead("an animated WebP")
    lossless, lossy = chunks.get(b"VP8L"), chunks.get(b"VP8 ")
    if lossless is not None:
        packed = int.from_bytes(lossless[1:5], "little")
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
        alpha = bool(packed >> 28 & 1)
    elif lossy is not None:
        width, height = (n & 0x3FFF for n in struct.unpack_from("<HH", lossy, 6))
        alpha = b"ALPH" in chunks
    else:
        raise Damaged("without pixels")
    return Encoded(
        "WebP",
        height,
        width,
        3 + alpha,
        alpha,
        _BYTE,
        lambda: imagecodecs.webp_decode(data, hasalpha=alpha),
        icc=chunks.get(b"ICCP", b""),
        **exif_facts(chunks.get(b"EXIF", b"")),  # type: ignore[arg-type]
    )


def open_hdr(data: bytes) -> Encoded:
    """Reads a Radiance picture's header; see `formats.open_encoded`."""
    header, _, rest = data.partition(b"\n\n")
    size = re.match(rb"-Y (\d{1,9}) \+X (\d{1,9})\n", rest)
    if b"FORMAT=32-bit_rle_xyze" in header:
        raise NotRead("a Radiance picture of XYZ colours")
    if not size:
        if re.match(rb"[-+][XY] \d+ [-+][XY] \d+\n", rest):
            raise NotRead("a Radiance picture that lies on its side or head")
        raise Damaged("without a size")
    return Encoded(
        "Radiance HDR",
        int(size[1]),
        int(size[2]),
        3,
        False,
        np.dtype(np.float32),
        lambda: imagecodecs.rgbe_decode(data),
    )


def open_pnm(data: bytes) -> Encoded:
    """Reads the header of a binary PGM or PPM; see `formats.open_encoded`."""
    gap = rb"(?:\s|#[^\n]*\n)+"
    number = rb"(\d{1,9})"
    found = re.match(
        rb"P([56])" + gap + number + gap + number + gap + number + rb"\s", data
    )
    if not found:
        raise Damaged("without a size")
    width, height, top = (int(found[i]) for i in (2, 3, 4))
    if not 0 < top < 65536:
        raise Damaged(f"with a largest value of {top}")
    channels = 1 if found[1] == b"5" else 3
    stored, full = (">u1", 255) if top < 256 else (">u2", 65535)

    def decode() -> np.ndarray:
        count = height * width * channels
        values = np.frombuffer(data, stored, count, found.end()).astype(np.uint32)
        values = np.minimum((values * full + top // 2) // top, full)
        shape = (height, width) if channels == 1 else (height, width, 3)
        return values.reshape(shape).astype(np.uint8 if full == 255 else np.uint16)

    dtype = np.dtype(np.uint8 if full == 255 else np.uint16)
    return Encoded("PNM", height, width, channels, False, dtype, decode)


def is_tga(data: bytes) -> bool:
    """Whether a file is a TGA, which has no mark at its beginning."""
    if len(data) < 18 or data[17] & 0xC0:
        return False
    colours, width, height, bits = struct.unpack_from("<5xHx4xHHB", data)
    if bits not in (8, 15, 16, 24, 32) or not width * height:
        return False
    if data.rstrip(b"\0").endswith(b"TRUEVISION-XFILE."):
        return True
    size = 18 + data[0] + colours * (data[7] // 8) + height * width * -(-bits // 8)
    return (data[1], data[2]) in ((1, 1), (0, 2), (0, 3)) and len(data) == size


def open_by_pillow(data: bytes) -> Encoded:
    """Reads the header of a BMP, GIF, PBM or TGA; see `formats.open_encoded`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its own limit of pixels: ours follows
            image = Image.open(io.BytesIO(data), formats=("BMP", "GIF", "PPM", "TGA"))
    except Image.DecompressionBombError:
        return _beyond_pillow(data)
    name = image.format or "BMP"
    if getattr(image, "is_animated", False):  # counting frames would read them all
        raise NotRead(f"an animated {name}")
    transparent = "transparency" in image.info
    modes = {"1": "L", "L": "L", "P": "RGB", "RGB": "RGB", "RGBA": "RGBA"}
    mode = modes.get(image.mode)
    if mode is None:
        raise NotRead(f"a {name} of {image.mode} pixels")
    mode = "RGBA" if transparent else mode
    return Encoded(
        name,
        image.height,
        image.width,
        len(mode),
        mode == "RGBA",
        _BYTE,
        lambda: np.array(image.convert(mode)),
    )


def _beyond_pillow(data: bytes) -> Encoded:
    """The header of a file with more pixels than Pillow opens."""
    if data.startswith(b"BM"):
        name, (width, height) = "BMP", struct.unpack_from("<ii", data, 18)
    elif data.startswith(b"GIF"):
        name, (width, height) = "GIF", struct.unpack_from("<HH", data, 6)
    else:
        name, (width, height) = "PBM", map(int, re.findall(rb"\d+", data[2:99])[:2])

    def decode() -> np.ndarray:
        raise NotRead(f"a {name} of more than 178 million pixels")

    return Encoded(name, abs(height), abs(width), 1, False, _BYTE, decode)
