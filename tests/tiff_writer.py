"""TIFF files written by hand, in every layout, independent of any library's."""

import struct
import zlib

import imagecodecs
import numpy as np


def packbits(data: bytes) -> bytes:
    """Literal runs only, which is a valid encoding."""
    runs = (data[i : i + 128] for i in range(0, len(data), 128))
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


COMPRESSIONS = {
    "none": (1, bytes),
    "lzw": (5, imagecodecs.lzw_encode),
    "deflate": (8, zlib.compress),
    "packbits": (32773, packbits),
    "zstd": (50000, imagecodecs.zstd_encode),
}


def directory(order: str, position: int, tags: dict, following: int) -> bytes:
    """A directory that lies at a position, with its longer values behind it."""
    values = position + 2 + 12 * len(tags) + 4
    entries, tail = b"", b""
    for tag, (kind, numbers) in sorted(tags.items()):
        code = {1: "B", 3: "H", 4: "I", 129: "B"}[kind]  # 129: of EXIF 3.0
        body = struct.pack(f"{order}{len(numbers)}{code}", *numbers)
        if len(body) <= 4:
            place = body.ljust(4, b"\0")
        else:
            place = struct.pack(order + "I", values + len(tail))
            tail += body + b"\0" * (len(body) % 2)
        entries += struct.pack(order + "HHI", tag, kind, len(numbers)) + place
    count = struct.pack(order + "H", len(tags))
    return count + entries + struct.pack(order + "I", following) + tail


def segments(pixels, *, planar, tile, rows=7):
    """The pixels in the order they are stored, cut into strips or tiles."""
    planes = np.moveaxis(pixels, -1, 0)[..., None] if planar else pixels[None]
    for plane in planes:
        height, width = plane.shape[:2]
        if not tile:
            for top in range(0, height, rows):
                yield plane[top : top + rows]
            continue
        for top in range(0, height, tile):
            for left in range(0, width, tile):
                part = plane[top : top + tile, left : left + tile]
                pad = [(0, tile - part.shape[0]), (0, tile - part.shape[1]), (0, 0)]
                yield np.pad(part, pad)


def tiff(pages, order="<") -> bytes:
    """A file of pages, each the arguments of `page`."""
    data = struct.pack(order + "2sHI", b"II" if order == "<" else b"MM", 42, 0)
    places = []
    for arguments in pages:
        parts, tags = page(order=order, **arguments)
        offsets = []
        for part in parts:
            offsets.append(len(data))
            data += part + b"\0" * (len(part) % 2)
        tiled = 322 in tags
        tags[324 if tiled else 273] = 4, offsets
        tags[325 if tiled else 279] = 4, [len(part) for part in parts]
        places.append((len(data), tags))
        data += directory(order, len(data), tags, 0)
    for (position, tags), (following, _) in zip(places, places[1:], strict=False):
        at = position + 2 + 12 * len(tags)
        data = data[:at] + struct.pack(order + "I", following) + data[at + 4 :]
    return data[:4] + struct.pack(order + "I", places[0][0]) + data[8:]


def page(
    pixels,
    *,
    order="<",
    planar=False,
    tile=0,
    compression="none",
    predictor=False,
    photometric=None,
    extra=(),
    bits=0,
    form=None,
    tags=None,
):
    """Segments and tags of one page; pixels `[H, W, C]`, of fewer bits packed."""
    height, width, samples = pixels.shape
    dtype = pixels.dtype
    number, encode = COMPRESSIONS.get(compression, (compression, bytes))
    if photometric is None:
        photometric = 2 if samples - len(extra) == 3 else 1
    if form is None:
        form = 3 if dtype.kind == "f" else 1
    parts = []
    for part in segments(pixels, planar=planar, tile=tile):
        if predictor:
            part = np.diff(part, axis=1, prepend=part.dtype.type(0))
        if bits and bits < 8:
            flat = part.reshape(len(part), -1)
            unpacked = np.unpackbits(flat[..., None], axis=-1)[..., 8 - bits :]
            stored = np.packbits(unpacked.reshape(len(part), -1), axis=-1).tobytes()
        else:
            stored = part.astype(dtype.newbyteorder(order)).tobytes()
        parts.append(encode(stored))
    layout = {322: (3, [tile]), 323: (3, [tile])} if tile else {278: (3, [7])}
    return parts, {
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [bits or dtype.itemsize * 8] * samples),
        259: (3, [number]),
        262: (3, [photometric]),
        277: (3, [samples]),
        284: (3, [2 if planar else 1]),
        **({317: (3, [2])} if predictor else {}),
        **({338: (3, list(extra))} if extra else {}),
        339: (3, [form] * samples),
        **layout,
        **(tags or {}),
    }
