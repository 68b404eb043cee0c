"""Whether LZW data can be given to its decoder (TIFF 6.0, section 13).

imagecodecs before 2026.10 (there is no newer one for Python 3.11) trusts the first code
after the table is cleared. A damaged one names an entry that is not there yet, by which
the decoder reads anywhere in memory: that can end the process.
"""

import functools

import imagecodecs
import numpy as np

TRUSTING = tuple(map(int, imagecodecs.__version__.split(".")[:2])) < (2026, 10)
"""Whether the decoder needs the data to be looked at before."""

_CLEAR, _END = 256, 257
_TABLE = 5120  # entries, the most that the decoder has
_FIRST = 258  # entries of a cleared table


@functools.cache
def _layout(old: bool) -> tuple[np.ndarray, np.ndarray]:
    """Bits of each code after the table is cleared, until it is full; their places.

    In data of the old kind, whose low bits are first, codes grow late.
    """
    grows = np.array([511, 1023, 2047]) + old
    # The first code adds no entry.
    entries = _FIRST + np.arange(-1, _TABLE - _FIRST).clip(0)
    widths = 9 + np.searchsorted(grows, entries, side="right")
    return widths, np.cumsum(widths) - widths


def begins_soundly(data: bytes) -> bool:
    """Whether a code that every table has follows wherever the table is cleared.

    `data` are the bytes of one strip or tile.
    """
    old = len(data) > 1 and data[0] == 0 and data[1] & 1 == 1
    widths, places = _layout(old)
    values = np.frombuffer(data + b"\0\0", np.uint8)
    place, end = 9, 8 * len(data)  # the first code clears the table
    while place + 9 <= end:
        count = np.searchsorted(place + places + widths, end, side="right")
        codes = _codes(values, place + places[:count], widths[:count], old)
        ends = (codes == _CLEAR) | (codes == _END)
        last = int(ends.argmax()) if ends.any() else len(codes)
        if codes[0] > _END:
            return False
        if last == len(codes) or codes[last] == _END:
            return True
        place += int(places[last] + widths[last])
    return True


def _codes(
    values: np.ndarray, places: np.ndarray, widths: np.ndarray, old: bool
) -> np.ndarray:
    """Codes that begin at bits and are so wide; old ones have the low bits first."""
    byte, bit = places >> 3, places & 7
    three = [values[byte + i].astype(np.uint32) for i in range(3)]
    if old:
        window = three[0] | three[1] << 8 | three[2] << 16
        return (window >> bit) & ((1 << widths) - 1)
    window = three[0] << 16 | three[1] << 8 | three[2]
    return (window >> (24 - bit - widths)) & ((1 << widths) - 1)
