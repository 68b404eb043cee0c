"""A file whose header was read, and why one is not."""

import contextlib
import dataclasses
import datetime
import math
import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from PIL import Image

from unips_jax.io.color import ADOBE_RGB, CURVES, PRIMARIES, Encoding, encoding_of

_ORIENTATION, _EXIF, _FOCAL_35MM, _COLOURS = 0x0112, 0x8769, 0xA405, 0xA001
_MAKER, _MODEL, _TIME, _APERTURE, _SPEED = 0x010F, 0x0110, 0x829A, 0x829D, 0x8827
_TAKEN, _FRACTION = 0x9003, 0x9291
TAGS = (
    *(_ORIENTATION, _FOCAL_35MM, _COLOURS, _MAKER, _MODEL),
    *(_TIME, _APERTURE, _SPEED, _TAKEN, _FRACTION),
)
"""What `facts_by` looks at."""
_INTEROP, _INDEX = 0xA005, 1
_BOX_COLOURS = re.compile(rb"colrncl[xc](..)(..)", re.DOTALL)
_UNSPECIFIED = (0, 2)  # transfer codes


class NotRead(Exception):
    """A sound file of a kind that is not read; `fix` is what to do."""

    def __init__(self, kind: str, fix: str = "export it as PNG or TIFF") -> None:
        super().__init__(kind)
        self.fix = fix


class Damaged(Exception):
    """A file that is cut short or changed; the text is how it shows."""


@dataclasses.dataclass(frozen=True)
class Encoded:
    """A file's header, before its pixels are decoded."""

    format: str
    height: int  # rows, as stored
    width: int  # columns, as stored
    channels: int  # as stored, alpha included
    has_alpha: bool  # whether the last channel is alpha
    dtype: np.dtype  # of the pixels: uint8, uint16 or float32
    decode: Callable[[], np.ndarray]  # gives them, `[H, W]` or `[H, W, channels]`
    allocated: int = 0  # pixels that the decoder will hold; 0 where they are H x W
    # whether checksums have shown already that the pixels are sound
    checked: bool = False
    orientation: int = 1  # by EXIF, 1 (upright) to 8
    focal_35mm: float = 0  # 35 mm equivalent of the focal length in mm; 0 where unknown
    icc: bytes = b""  # the colour profile; empty where there is none
    code: int = 0  # of the transfer function, a key of `color.CURVES`; 0 where unknown
    # exponent by which values encode light, such as 1 / 2.2; 0 where unknown
    gamma: float = 0
    srgb: bool = False  # whether a tag other than the profile is sRGB's
    # of its colours, as in `color.PRIMARIES`; empty where unknown
    primaries: tuple[float, ...] = ()
    camera: str = ""  # its maker and model; empty where unknown
    # seconds times ISO speed over the squared f-number; 0 where unknown
    exposure: float = 0
    taken: float = 0  # when, in seconds of the camera's clock; 0 where unknown

    @property
    def encoding(self) -> Encoding:
        """How its values encode light."""
        return encoding_of(
            self.dtype,
            icc=self.icc,
            code=self.code,
            gamma=self.gamma,
            srgb=self.srgb,
            primaries=self.primaries,
        )


def exif_facts(block: bytes) -> dict[str, Any]:
    """Fields of `Encoded` by EXIF data, with or without `Exif`; none if damaged."""
    tags: dict[int, object] = {}
    if block:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                data = Image.Exif()
                data.load(block)
                tags = {**data, **data.get_ifd(_EXIF)}
                with contextlib.suppress(Exception):
                    tags[_INTEROP] = data.get_ifd(_INTEROP).get(_INDEX)
        except Exception:  # Pillow raises many kinds for damaged data
            tags = {}
    return facts_by(tags)


def facts_by(tags: Mapping[int, object]) -> dict[str, Any]:
    """Fields of `Encoded` by the values of EXIF's tags, by their numbers."""
    facts = facts_of(tags.get(_ORIENTATION), tags.get(_FOCAL_35MM), tags.get(_COLOURS))
    names = (tags.get(_MAKER), tags.get(_MODEL))
    camera = " ".join(n.strip("\0 ") for n in names if isinstance(n, str)).strip()
    taken = time_of(tags.get(_TAKEN), tags.get(_FRACTION))
    facts |= {"camera": camera, "exposure": _exposure(tags), "taken": taken}
    # So cameras mark Adobe RGB (DCF); without that mark colours are unknown.
    adobe = str(tags.get(_INTEROP)).strip("\0 ") == "R03" and not facts["srgb"]
    return facts | {"primaries": ADOBE_RGB if adobe else ()}


def time_of(taken: object, fraction: object = "") -> float:
    """Seconds by EXIF's text of a time and its fraction of a second, or 0."""
    try:
        text = str(taken).strip("\0 ")
        time = datetime.datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return 0
    digits = str(fraction).strip("\0 ")
    part = float(f"0.{digits}") if digits.isdecimal() and digits.isascii() else 0
    return time.replace(tzinfo=datetime.UTC).timestamp() + part


def _exposure(tags: Mapping[int, object]) -> float:
    speed = tags.get(_SPEED)
    values = (
        tags.get(_TIME),
        tags.get(_APERTURE),
        speed[0] if isinstance(speed, tuple) and speed else speed,
    )
    try:
        return exposure_of(*map(_number, values))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 0


def exposure_of(time: float, aperture: float, iso: float) -> float:
    """Seconds times ISO speed over the squared f-number; 0 where one is unknown."""
    try:
        exposure = time * iso / aperture**2
    except (ZeroDivisionError, OverflowError):
        return 0
    return exposure if 0 < exposure < math.inf else 0


def _number(value: Any) -> float:
    """A number, or one that is given as numerator and denominator."""
    if isinstance(value, tuple) and len(value) == 2:
        return value[0] / value[1]
    return float(value)


def facts_of(
    orientation: object, focal_35mm: object, colours: object
) -> dict[str, Any]:
    """The fields of `Encoded` from values of three tags, whatever they are."""
    focal = focal_35mm if isinstance(focal_35mm, int | float) else 0
    focal = focal if 0 < focal < math.inf else 0
    return {
        "orientation": orientation if orientation in range(1, 9) else 1,  # type: ignore[dict-item]
        "focal_35mm": focal,
        "srgb": colours == 1,
    }


def box_transfer_code(boxes: bytes) -> int:
    """A transfer code (ITU-T H.273) in ISO's boxes (HEIC, AVIF, MP4); 0 if none."""
    found = _BOX_COLOURS.search(boxes)
    return int.from_bytes(found[2], "big") if found else 0


def box_primaries(boxes: bytes) -> tuple[float, ...]:
    """Chromaticities by a code in ISO's boxes, as in `color.PRIMARIES`, or empty."""
    found = _BOX_COLOURS.search(boxes)
    return PRIMARIES.get(int.from_bytes(found[1], "big"), ()) if found else ()


def turned_back(image: np.ndarray, orientation: int) -> np.ndarray:
    """An image as viewers show it, as it is stored; orientation: 1 to 8."""
    image = image[::-1] if orientation in (3, 4, 7, 8) else image
    image = image[:, ::-1] if orientation in (2, 3, 6, 7) else image
    return image.swapaxes(0, 1) if orientation >= 5 else image


def known_code(code: int, kind: str) -> int:
    """The code, 0 where it is unspecified; `NotRead` if its meaning is unknown."""
    if code not in CURVES and code not in _UNSPECIFIED:
        raise NotRead(f"{kind} of the unknown transfer code {code}")
    return code if code in CURVES else 0
