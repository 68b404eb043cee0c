"""TIFF, by tifffile: the one photograph of a file, in all its layouts.

Bits per sample 1, 2, 4, 8 and 16 (unsigned) and 16, 32 and 64 (float); chunky and
planar; strips and tiles; both byte orders; BigTIFF; uncompressed, LZW, deflate,
PackBits, LZMA, Zstandard and, for bilevel pictures, CCITT. Grey of either sense, RGB
and palettes, with alpha of either kind, which is not divided out.
"""

import functools
import io
import logging
import re
import struct
import threading
from typing import Any, BinaryIO

import imagecodecs
import numpy as np
import tifffile

from unips_jax.io.formats import lzw
from unips_jax.io.formats.encoded import TAGS, Damaged, Encoded, NotRead, facts_by

_BIG = (b"II+\0", b"MM\0+")
MAGICS = (b"II*\0", b"MM\0*", *_BIG)
PAGES = 64
"""The most directories of a photograph: previews and masks among them."""
_MOST_TAGS = 1 << 16

_COMPRESSIONS = (1, 2, 3, 4, 5, 8, 32773, 32946, 34925, 50000)
_LZW = 5
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE = range(4)
_CAMERA = (32803, 34892)  # colour filter array, linear raw
_FLOAT = 3
_REDUCED, _TRANSPARENCY = 1, 4
_ALPHA = (1, 2)  # associated, unassociated
_UNSPECIFIED = 0
_EXIF, _ICC, _ORIENTATION, _COLOURS = 34665, 34675, 274, 40961
# What pixels follow from, of a photograph's tags.
_NEEDED = {
    *range(254, 267),
    273,
    _ORIENTATION,
    *range(277, 280),
    284,
    292,
    293,
    317,
    320,
}
_NEEDED |= {*range(322, 326), 338, 339, _ICC}
_UNKNOWN_TYPE = re.compile(r"TiffTag (\d+) .*invalid data type|invalid .* tag #(\d+)")
_MAKER, _SUB_FILES, _DNG_VERSION = 271, 330, 50706


class _Complaints(logging.Handler):
    """What tifffile reports, in one thread, of tags and pages that it passes over."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.reported = threading.local()

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.levelno >= logging.ERROR or "TiffPages" in text:
            self.reported.lines = [*self.lines(), text]

    def lines(self) -> list[str]:
        return getattr(self.reported, "lines", [])


@functools.cache
def _complaints() -> _Complaints:
    """What is to be there before tifffile is, which else writes to the terminal."""
    handler = _Complaints()
    logging.getLogger("tifffile").addHandler(handler)
    return handler


def count_pages(file: BinaryIO, most: int) -> int:
    """How many directories a TIFF's chain has, before any library follows it."""
    head = file.read(16)
    order = "<" if head[:1] == b"I" else ">"
    big = head[:4] in _BIG
    number, entry, pointer = ("Q", 20, "Q") if big else ("H", 12, "I")
    size, step = struct.calcsize(order + number), struct.calcsize(order + pointer)
    (place,) = struct.unpack_from(
        order + pointer, head.ljust(16, b"\0"), 8 if big else 4
    )
    seen: set[int] = set()
    while place:
        if place in seen:
            raise Damaged("its pages lead back to one another")
        seen.add(place)
        if len(seen) > most:
            raise NotRead(f"a TIFF of more than {most} pages", "save them as files")
        file.seek(place)
        (entries,) = struct.unpack(order + number, file.read(size).rjust(size, b"\0"))
        file.seek(place + size + entry * min(entries, _MOST_TAGS))
        link = file.read(step)
        place = struct.unpack(order + pointer, link)[0] if len(link) == step else 0
    return len(seen)


def open_tiff(data: bytes) -> Encoded:
    """Reads a TIFF's tags; damaged ones raise `Damaged`, or any kind of exception."""
    complaints = _complaints()
    complaints.reported.lines = []
    tiff = tifffile.TiffFile(io.BytesIO(data))
    page = _photograph(tiff)
    for line in complaints.lines():
        found = _UNKNOWN_TYPE.search(line)
        if not found or int(found[1] or found[2]) in _NEEDED:
            raise Damaged(f"the decoder says: {line[:120]}")
    return open_page(page)


def open_page(page: tifffile.TiffPage) -> Encoded:
    """Reads the tags of one page; see `open_tiff`."""
    _require_known(page)
    if not all(isinstance(n, int) for n in (page.imagelength, page.imagewidth)):
        raise Damaged("its size is no number")
    bits, samples = page.bitspersample, page.samplesperpixel
    colours = 3 if page.photometric == _RGB else 1
    has_alpha = _has_alpha(page, colours)
    if samples != colours + has_alpha:
        raise NotRead(f"a TIFF of {samples} samples per pixel")
    palette = page.photometric == _PALETTE
    floating = page.sampleformat == _FLOAT
    kind = np.float32 if floating else np.uint16 if bits == 16 else np.uint8
    tags = page.tags

    def decode() -> np.ndarray:
        pixels = _channels_last(page)
        if palette:
            return (np.asarray(page.colormap)[:, pixels] >> 8).transpose(1, 2, 0)
        return _scaled(pixels, bits, page.photometric == _WHITE_IS_ZERO, colours)

    return Encoded(
        "TIFF",
        page.imagelength,
        page.imagewidth,
        3 if palette else samples,
        has_alpha,
        np.dtype(np.uint8 if palette else kind),
        lambda: decode().astype(np.uint8 if palette else kind, copy=False),
        allocated=_tiled_size(page),
        icc=bytes(tags.valueof(_ICC) or b""),
        **_facts(page),
    )


def raw_facts(data: bytes) -> dict[str, Any]:
    """Fields of `Encoded` by the EXIF data of a raw file that has a TIFF's form."""
    _complaints()
    try:
        return _facts(tifffile.TiffFile(io.BytesIO(data)).pages.first)
    except Exception:  # other forms, and damaged ones
        return {}


def _facts(page: Any) -> dict[str, Any]:
    """Fields of `Encoded` by a page's EXIF data, and tags of its own."""
    exif = page.tags.valueof(_EXIF)
    named = exif if isinstance(exif, dict) else {}
    found = {}
    for number in TAGS:
        value = None if number == _COLOURS else page.tags.valueof(number)
        if number != _ORIENTATION:
            for name in tifffile.TIFF.EXIF_TAGS.getall(number, []):
                value = named.get(name, value)
        found[number] = value
    return facts_by(found)


def raw_kind(data: bytes) -> str:
    """Names the raw file that has the form of a TIFF; empty where it is none."""
    if data[8:10] == b"CR":
        return "a camera's raw file (CR2)"
    _complaints()
    try:
        tiff = tifffile.TiffFile(io.BytesIO(data))
        page = tiff.pages.first
        tags = page.tags
    except Exception:  # `open_tiff` finds what is wrong
        return ""
    if _DNG_VERSION in tags:
        return "a camera's raw file (DNG)"
    small = isinstance(page, tifffile.TiffPage) and int(page.subfiletype) & _REDUCED
    sensor = page.photometric in _CAMERA or (small and _SUB_FILES in tags)
    if sensor and _MAKER in tags:
        return "a camera's raw file (a TIFF of sensor values)"
    return ""


def _tiled_size(page: tifffile.TiffPage) -> int:
    """Pixels of all tiles, which reach over the edges; 0 without tiles."""
    if not page.is_tiled:
        return 0
    height = -(-page.imagelength // page.tilelength) * page.tilelength
    return height * -(-page.imagewidth // page.tilewidth) * page.tilewidth


def whole_pages(tiff: tifffile.TiffFile) -> list[tifffile.TiffPage]:
    """The pages that are neither previews nor transparency masks."""
    return [
        page
        for page in tiff.pages
        if isinstance(page, tifffile.TiffPage)
        and not int(page.subfiletype) & (_REDUCED | _TRANSPARENCY)
        and not (page.tags.valueof(255) or 0) == 2  # the same, in old files
    ]


def _photograph(tiff: tifffile.TiffFile) -> tifffile.TiffPage:
    """The only whole page."""
    pages = whole_pages(tiff)
    if not len(tiff.pages):
        raise Damaged("without pages")
    if not pages:
        raise NotRead("a TIFF that holds previews only")
    count = len(pages)
    if tiff.is_imagej and tiff.imagej_metadata:
        count = max(count, int(tiff.imagej_metadata.get("images", 1)))
    if count > 1:
        raise NotRead(
            f"a TIFF of {count} pages", "give the file itself in place of its folder"
        )
    return pages[0]


def _require_known(page: tifffile.TiffPage) -> None:
    if page.photometric in _CAMERA:
        raise NotRead("a camera's raw file (a TIFF of sensor values)")
    if page.photometric not in (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE):
        name = getattr(page.photometric, "name", page.photometric)
        raise NotRead(f"a TIFF of {name} colours")
    if page.compression not in _COMPRESSIONS:
        name = getattr(page.compression, "name", page.compression)
        raise NotRead(f"a TIFF with {name} compression")
    bits, form = page.bitspersample, page.sampleformat
    if page.imagedepth > 1:
        raise NotRead("a TIFF of a volume")
    floating = form == _FLOAT and bits in (16, 32, 64)
    if not (floating or (form in (1, 4) and bits in (1, 2, 4, 8, 16))):
        kind = {2: "signed ", 3: "floating-point ", 5: "complex ", 6: "complex "}
        raise NotRead(f"a TIFF of {bits}-bit {kind.get(form, '')}samples")
    if page.photometric == _PALETTE and (page.colormap is None or bits > 8):
        raise NotRead(f"a TIFF of {bits}-bit indices without their colours")


def _has_alpha(page: tifffile.TiffPage, colours: int) -> bool:
    extra = tuple(int(kind) for kind in page.extrasamples)
    if page.samplesperpixel == colours:
        return False
    if colours == 3 and set(extra) <= {_UNSPECIFIED}:
        return True  # as some programs leave it
    return len(extra) == 1 and extra[0] in _ALPHA


def _require_sound_lzw(page: tifffile.TiffPage) -> None:
    file = page.parent.filehandle
    for place, size in zip(page.dataoffsets, page.databytecounts, strict=False):
        file.seek(place)
        data = file.read(size)
        if page.fillorder == 2:
            data = bytes(imagecodecs.bitorder_decode(data))
        if not lzw.begins_soundly(data):
            raise Damaged("a code of its LZW compression stands for nothing")


def _channels_last(page: tifffile.TiffPage) -> np.ndarray:
    height, width = page.imagelength, page.imagewidth
    if page.compression == _LZW and lzw.TRUSTING:
        _require_sound_lzw(page)
    pixels = page.asarray()
    planar = page.samplesperpixel > 1 and page.planarconfig == 2
    if planar:
        pixels = np.moveaxis(pixels, 0, -1)
    if pixels.shape[:2] != (height, width):
        raise ValueError(f"{pixels.shape[:2]} pixels in place of {(height, width)}")
    return pixels


def _scaled(
    pixels: np.ndarray, bits: int, white_is_zero: bool, colours: int
) -> np.ndarray:
    """Few bits as eight, and white at the top."""
    if bits < 8:
        pixels = pixels.astype(np.uint8) * np.uint8(255 // (2**bits - 1))
    if not white_is_zero:
        return pixels
    if pixels.dtype.kind == "f":
        raise NotRead("a floating-point TIFF whose zero is white")
    top = np.iinfo(pixels.dtype).max
    if pixels.ndim == 2:
        return top - pixels
    inverted = pixels.copy()
    inverted[..., :colours] = top - pixels[..., :colours]
    return inverted
