"""Image formats: a file's header, and then its pixels.

A format is known by content, never by name, but for raw files of cameras that mark
them in no way. Each has one reader for all its variants:

    tifffile       TIFF
    OpenEXR        EXR
    simplejpeg     JPEG, by libjpeg-turbo; a decoder's warnings are errors
    imagecodecs    PNG, WebP, Radiance HDR
    Pillow         BMP, GIF, PBM, TGA, AVIF
    pillow-heif    HEIC, where it is installed
    rawpy          cameras' raw files, where it is installed

All raise on damaged data, in whatever thread. A kind that is not read is refused by its
name.
"""

import io
import re
from collections.abc import Callable

import numpy as np

from unips_jax.io.formats import camera, exr, raster, tiff
from unips_jax.io.formats.encoded import Damaged, Encoded, NotRead
from unips_jax.io.naming import RAW_SUFFIXES

__all__ = ["Damaged", "Encoded", "NotRead", "decode", "open_encoded"]

_OTHERS = (  # formats that are known but not read
    (rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51", "a JPEG 2000 picture"),
    (rb"\0\0\0\x0cJXL |\xff\x0a", "a JPEG XL picture"),
    (rb"II\xbc", "a JPEG XR picture"),
    (rb"8BPS", "a Photoshop document"),
    (rb"gimp xcf", "a GIMP document"),
    (rb"%PDF", "a PDF document"),
    (rb"P[Ff]\s", "a PFM picture"),
    (rb"P[123]\s", "a PNM picture written as text"),
)

_RAW = (  # cameras' raw files that are no TIFF
    (rb"....ftypcrx", "a camera's raw file (CR3)"),
    (rb"FUJIFILMCCD-RAW", "a camera's raw file (RAF)"),
    (rb"IIU\0", "a camera's raw file (RW2)"),
    (rb"IIR[OS]|MMOR", "a camera's raw file (ORF)"),
    (rb"FOVb", "a camera's raw file (X3F)"),
)


def open_encoded(data: bytes, *, vectors: bool = False, suffix: str = "") -> Encoded:
    """Reads a file's header, or raises `NotRead` (a kind) or `Damaged`.

    `suffix` is its name's, in small letters; `vectors`: of normals.
    """
    for pattern, name in _OTHERS:
        if re.match(pattern, data[:16], re.DOTALL):
            raise NotRead(name)
    try:
        if data.startswith(exr.MAGIC):
            return exr.open_exr(data, vectors=vectors)
        for pattern, name in _RAW:
            if re.match(pattern, data[:16], re.DOTALL):
                return camera.open_raw(data, name)
        opener = _opener(data)
        if opener is None and suffix in RAW_SUFFIXES:
            kind = f"a camera's raw file by its name ({suffix[1:].upper()})"
            return camera.open_raw(data, kind)
        if opener is None:
            raise Damaged("")
        return opener(data)
    except (NotRead, Damaged):
        raise
    except Exception as error:  # the libraries raise many kinds
        raise Damaged(_said(error)) from error


def _opener(data: bytes) -> Callable[[bytes], Encoded] | None:
    if data.startswith(tiff.MAGICS):
        return _open_tiff
    if data[4:8] == b"ftyp":
        return _open_boxed
    if data.startswith(raster.JPEG_MAGIC):
        return raster.open_jpeg
    if data.startswith(raster.PNG_MAGIC):
        return raster.open_png
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return raster.open_webp
    if data.startswith(b"#?"):
        return raster.open_hdr
    if re.match(rb"P[56]\s", data[:3]):
        return raster.open_pnm
    if data.startswith((b"BM", b"GIF8")) or re.match(rb"P4\s", data[:3]):
        return raster.open_by_pillow
    if raster.is_tga(data):
        return raster.open_by_pillow
    return None


def _open_tiff(data: bytes) -> Encoded:
    """A TIFF, or a camera's raw file that is one by its form."""
    tiff.count_pages(io.BytesIO(data), tiff.PAGES)
    if name := tiff.raw_kind(data):
        return camera.open_raw(data, name)
    return tiff.open_tiff(data)


def _open_boxed(data: bytes) -> Encoded:
    """A file of ISO's boxes: the first names the kinds that it may be read as."""
    kinds = data[8 : int.from_bytes(data[:4], "big")]
    if b"avif" in kinds or b"avis" in kinds:
        return camera.open_avif(data)
    if re.search(rb"hei[cxms]|hev[cx]|mif1|msf1", kinds):
        return camera.open_heic(data)
    if re.search(rb"isom|iso\d|mp4\d|qt  |M4V |3gp", kinds):
        raise NotRead("a video", "give the file itself in place of its folder")
    raise Damaged("")


def decode(encoded: Encoded) -> tuple[np.ndarray, np.ndarray | None]:
    """A file's pixels as stored: `[H, W, 1 or 3]`, and alpha `[H, W]` or None."""
    try:
        pixels = np.atleast_3d(encoded.decode())
    except (NotRead, Damaged):
        raise
    except Exception as error:
        if re.search("unsupported|not supported|not implemented", str(error), re.I):
            kind = f"a {encoded.format} of a kind that its decoder does not know"
            raise NotRead(f"{kind} ({_said(error)})") from error
        raise Damaged(_said(error)) from error
    shape = (encoded.height, encoded.width, encoded.channels)
    if pixels.shape != shape or pixels.dtype != encoded.dtype:
        raise Damaged(
            f"its header says {encoded.dtype} of {shape}, its pixels are "
            f"{pixels.dtype} of {pixels.shape}"
        )
    if encoded.has_alpha:
        return pixels[..., :-1], pixels[..., -1]
    return pixels, None


def _said(error: Exception) -> str:
    return f"the decoder says: {' '.join(str(error).split())[:120]}"
