"""Files of ISO's boxes (HEIC, AVIF, MP4): what a few of them say of the pixels."""

import re

from unips_jax.io.color import CURVES
from unips_jax.io.formats.encoded import NotRead

_COLOURS = re.compile(rb"colrncl[xc]..(..)", re.DOTALL)
_AV1 = re.compile(rb"av1C..(.)", re.DOTALL)
_UNSAID = (0, 2)


def transfer_code(boxes: bytes) -> int:
    """The code of the transfer function (ITU-T H.273); 0 where there is none."""
    found = _COLOURS.search(boxes)
    return int.from_bytes(found[1], "big") if found else 0


def known_code(code: int, kind: str) -> int:
    """The code, 0 where it says nothing; `NotRead` if nobody knows what it means."""
    if code not in CURVES and code not in _UNSAID:
        raise NotRead(f"{kind} of the unknown transfer code {code}")
    return code if code in CURVES else 0


def av1_bits(boxes: bytes) -> int:
    """Bits of an AVIF's samples: 8, 10 or 12."""
    found = _AV1.search(boxes)
    deep, deeper = (found[1][0] >> 6 & 1, found[1][0] >> 5 & 1) if found else (0, 0)
    return 8 + 2 * deep + 2 * (deep & deeper)
