"""Arrays of MATLAB files, versions 4 to 7.

SciPy trusts what a file of version 5 to 7 says of the type of its values: a damaged
one is read from anywhere in memory, which can end the process. So types are looked at
before.

Source of the layout: MathWorks, "MAT-File Format", Level 5.
"""

import io
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

_HEADER = 128
_COMPRESSED, _MATRIX = 15, 14
_NUMBERS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}  # types of stored values
_ARRAYS = range(6, 16)  # classes of variables: double, single, and integers
_COMPLEX = 0x800


def read_arrays(data: bytes) -> dict[str, np.ndarray]:
    """The variables of a file that are arrays of numbers.

    Raises:
        ValueError: where the file is damaged; other errors are SciPy's.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    major, _ = matfile_version(io.BytesIO(data))
    names = list(_names_of_arrays(data)) if major == 1 else None
    content = loadmat(io.BytesIO(data), variable_names=names)
    return {key: v for key, v in content.items() if not key.startswith("__")}


class _Element(NamedTuple):
    """A part of a file: its type, where its content lies, and where the next begins."""

    kind: int
    start: int
    end: int
    next: int


def _names_of_arrays(data: bytes) -> Iterator[str]:
    order = "<" if data[126:128] == b"IM" else ">"
    position = _HEADER
    while position < len(data):
        element = _element(data, position, order)
        content, begin, end = data, element.start, element.end
        if element.kind == _COMPRESSED:
            content = zlib.decompress(data[begin:end])
            inner = _element(content, 0, order)
            begin, end = inner.start, inner.end
            if inner.kind != _MATRIX:
                raise ValueError(f"a variable of type {inner.kind}")
        elif element.kind != _MATRIX:
            raise ValueError(f"a variable of type {element.kind}")
        name = _name_if_array(content, begin, end, order)
        if name:
            yield name
        position = element.end if element.kind == _COMPRESSED else element.next


def _name_if_array(data: bytes, position: int, end: int, order: str) -> str | None:
    flags = _element(data, position, order)
    sizes = _element(data, flags.next, order)
    name = _element(data, sizes.next, order)
    (word,) = struct.unpack_from(order + "I", data, flags.start)
    if word & 0xFF not in _ARRAYS:
        return None
    position = name.next
    for _ in range(2 if word & _COMPLEX else 1):
        values = _element(data, position, order)
        if values.kind not in _NUMBERS or values.end > end:
            raise ValueError(f"values of type {values.kind}")
        position = values.next
    return data[name.start : name.end].decode("latin-1")


def _element(data: bytes, position: int, order: str) -> _Element:
    if position + 8 > len(data):
        raise ValueError("cut short")
    kind, size = struct.unpack_from(order + "II", data, position)
    if kind >> 16:  # a small one has its content beside its type
        kind, size = kind & 0xFFFF, kind >> 16
        start, step = position + 4, 8
    else:
        start, step = position + 8, 8 + (size + 7) // 8 * 8
    if start + size > len(data) or (step == 8 and size > 4):
        raise ValueError("cut short")
    return _Element(kind, start, start + size, position + step)
