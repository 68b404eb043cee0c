"""What cameras and phones write: raw files, HEIC and AVIF.

Raw files are read by rawpy, HEIC by pillow-heif, both extras, AVIF by Pillow. Raw files
are developed without anything that would differ from photograph to photograph:
demosaiced, white-balanced as the camera did, in sRGB's primaries, up to the sensor's
white; 16 bit, linear.
"""

import datetime
import io
import re
from typing import Any

import imagecodecs
import numpy as np
from PIL import Image, features

from unips_jax.errors import install_hint
from unips_jax.io.formats.encoded import (
    Encoded,
    NotRead,
    box_primaries,
    box_transfer_code,
    exif_facts,
    exposure_of,
    known_code,
    turned_back,
)
from unips_jax.io.formats.exr import quiet
from unips_jax.io.formats.tiff import raw_facts

_FLIPS = {0: 1, 3: 3, 5: 8, 6: 6}  # LibRaw's and EXIF's orientations
_BOXES = 1 << 20  # bytes at the beginning, in which what describes the picture lies
_TURNS = {3: b"irot\2", 6: b"irot\3", 8: b"irot\1"}  # boxes by EXIF's orientation
_DAY = 86_400  # seconds
_KNOWN_OF_RAW = ("camera", "exposure", "focal_35mm", "taken")
_AV1 = re.compile(rb"av1C..(.)", re.DOTALL)  # bits of an AVIF's samples
_BYTE = np.dtype(np.uint8)


def open_raw(data: bytes, name: str) -> Encoded:
    """Reads a camera's raw file; `NotRead` without rawpy, or of an unknown camera."""
    try:
        import rawpy
    except ImportError:
        raise NotRead(
            name, f"{install_hint('raw')}, or develop it to 16-bit TIFF"
        ) from None
    try:
        with quiet(), rawpy.imread(io.BytesIO(data)) as raw:
            sizes, facts = raw.sizes, _shot(raw)
    except rawpy.LibRawFileUnsupportedError:
        raise NotRead(
            f"{name} that is damaged or that LibRaw does not know",
            "copy it again, develop it to 16-bit TIFF",
        ) from None

    def decode() -> np.ndarray:
        with quiet(), rawpy.imread(io.BytesIO(data)) as raw:
            return raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                use_camera_wb=True,
                output_color=rawpy.ColorSpace.sRGB,
                output_bps=16,
                user_flip=0,
            )

    aspect = sizes.pixel_aspect  # of pixels that are not square, LibRaw makes square
    found = raw_facts(data)
    facts |= {name: found[name] for name in _KNOWN_OF_RAW if found.get(name)}
    return Encoded(
        "raw",
        int(sizes.iheight / min(aspect, 1) + 0.5),
        int(sizes.iwidth * max(aspect, 1) + 0.5),
        3,
        False,
        np.dtype(np.uint16),
        decode,
        orientation=_FLIPS.get(sizes.flip, 1),
        **facts,
    )


def _shot(raw: Any) -> dict[str, Any]:
    """How a raw file was exposed, and when, where LibRaw and its binding tell."""
    other = getattr(raw, "other", None)
    if other is None:
        return {}
    exposure = exposure_of(other.shutter_speed, other.aperture, other.iso_speed)
    taken = other.timestamp.replace(tzinfo=datetime.UTC).timestamp()
    known = taken > _DAY  # 0 in any zone: a camera whose clock was not set
    return {"exposure": exposure, "taken": taken if known else 0}


def open_heic(data: bytes) -> Encoded:
    """Reads a HEIC picture, the primary one of several.

    The decoder turns it, which is undone: photographs of a camera that stood still lie
    alike as they are stored.
    """
    try:
        import pillow_heif
    except ImportError:
        raise NotRead(
            "a HEIC picture", f"{install_hint('heif')}, or export it as PNG or TIFF"
        ) from None
    code = known_code(box_transfer_code(data[:_BOXES]), "a HEIC picture")
    image: Any = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)
    mode, _, deep = image.mode.partition(";")
    channels = {"L": 1, "RGB": 3, "RGBA": 4}.get(mode)
    if channels is None:
        raise NotRead(f"a HEIC picture of {image.mode} pixels")
    facts = exif_facts(image.info.get("exif") or b"")
    turn = facts["orientation"]
    if _TURNS.get(turn, b"imir") not in data[:_BOXES]:
        turn = 1  # by HEIF's rules EXIF data turn nothing
    width, height = image.size if turn < 5 else image.size[::-1]
    return Encoded(
        "HEIC",
        height,
        width,
        channels,
        channels == 4,
        np.dtype(np.uint16) if deep else _BYTE,
        # A copy: before pillow-heif 1.6 the decoder's memory ends with it.
        lambda: turned_back(np.array(image), turn),
        icc=image.info.get("icc_profile") or b"",
        code=code,
        **(facts | _colours(data, facts, bool(deep)) | {"orientation": turn}),
    )


def open_avif(data: bytes) -> Encoded:
    """Reads an AVIF picture."""
    if not features.check("avif"):
        raise NotRead("an AVIF picture (Pillow was built without AVIF)")
    image = Image.open(io.BytesIO(data), formats=("AVIF",))
    if getattr(image, "is_animated", False):
        raise NotRead("an animated AVIF")
    mode = "RGBA" if image.mode == "RGBA" else "RGB"
    found = _AV1.search(data[:_BOXES])
    deep, deeper = (found[1][0] >> 6 & 1, found[1][0] >> 5 & 1) if found else (0, 0)
    bits = 8 + 2 * deep + 2 * (deep & deeper)
    facts = exif_facts(image.info.get("exif") or b"")

    def decode() -> np.ndarray:
        if bits == 8:
            return np.array(image.convert(mode))
        pixels = imagecodecs.avif_decode(data)  # Pillow keeps 8 bits
        if pixels.shape[-1] != len(mode):
            pixels = np.repeat(pixels.reshape(image.height, image.width, -1), 3, -1)
        top = 2**bits - 1
        return ((pixels.astype(np.uint32) * 65535 + top // 2) // top).astype(np.uint16)

    return Encoded(
        "AVIF",
        image.height,
        image.width,
        len(mode),
        mode == "RGBA",
        _BYTE if bits == 8 else np.dtype(np.uint16),
        decode,
        icc=image.info.get("icc_profile") or b"",
        code=known_code(box_transfer_code(data[:_BOXES]), "an AVIF picture"),
        **(facts | _colours(data, facts, bits > 8)),
    )


def _colours(data: bytes, facts: dict[str, Any], deep: bool) -> dict[str, Any]:
    """Fields of `Encoded` by boxes, which come before EXIF data, and by depth."""
    primaries = box_primaries(data[:_BOXES])
    return {"primaries": primaries, "srgb": facts["srgb"] or deep}
