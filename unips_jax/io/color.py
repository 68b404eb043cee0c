"""How pixel values encode light: transfer functions, in NumPy."""

import dataclasses
import struct
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import DTypeLike

Transfer = Literal["linear", "srgb"]

_SAMPLES = 1024
# Red, green and blue of sRGB as its profiles have them, XYZ under D50 in columns.
_SRGB_XYZ = np.array(
    [
        [0.43607, 0.38515, 0.14307],
        [0.22249, 0.71687, 0.06061],
        [0.01392, 0.09708, 0.7141],
    ]
)
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
_D65 = (0.3127, 0.329)
_SRGB = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, *_D65)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65)
PRIMARIES: dict[int, tuple[float, ...]] = {
    9: (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, *_D65),
    12: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, *_D65),
}
"""Chromaticities x, y of red, green, blue and white, for the codes of wide colours in
ITU-T H.273, table 2: BT.2020 and Display P3."""
_ALIKE = 0.01  # of linear light: sRGB and a gamma of 2.2 differ by 0.009 at most


def as_float(image: np.ndarray) -> np.ndarray:
    """An image's values in float32; integers are divided by their type's largest."""
    if image.dtype.kind == "u":
        return image.astype(np.float32) / np.iinfo(image.dtype).max
    return image.astype(np.float32, copy=False)


@dataclasses.dataclass(frozen=True)
class Encoding:
    """How a file's values encode light, and by which rule that is known.

    `table`: what integers are to be replaced by for the transfer function to hold.
    `to_srgb`: what makes its linear colours sRGB's, `[3, 3]`; None where they are.
    """

    transfer: Transfer
    rule: str
    table: np.ndarray | None = None
    to_srgb: np.ndarray | None = None

    def values(self, pixels: np.ndarray) -> np.ndarray:
        """A file's pixels as values for which the transfer function holds."""
        return pixels if self.table is None else self.table[pixels]

    def has_colors_of(self, other: "Encoding") -> bool:
        """Whether equal linear values are equal colours."""
        if self.to_srgb is None or other.to_srgb is None:
            return self.to_srgb is other.to_srgb
        return bool(np.abs(self.to_srgb - other.to_srgb).max() < 0.02)

    def agrees(self, other: "Encoding") -> bool:
        """Whether equal values encode equal light."""
        if self.table is None or other.table is None:
            return self.transfer == other.transfer and self.table is other.table
        return np.array_equal(self.table, other.table)


def _camera(x: np.ndarray) -> np.ndarray:
    return np.where(x < 0.081, x / 4.5, ((x + 0.099) / 1.099) ** (1 / 0.45))


def _adobe(x: np.ndarray) -> np.ndarray:
    return np.where(x < 0.0913, x / 4, ((x + 0.1115) / 1.1115) ** (1 / 0.45))


def _pq(x: np.ndarray) -> np.ndarray:
    root = x ** (32 / 2523)
    return (np.maximum(root - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * root)) ** (
        8192 / 1305
    )


def _hlg(x: np.ndarray) -> np.ndarray:
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(x <= 0.5, x**2 / 3, (np.exp((x - c) / a) + b) / 12)


CURVES: dict[int, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    **dict.fromkeys((1, 6, 11, 12, 14, 15), ("BT.709", _camera)),
    4: ("gamma 2.2", lambda x: x**2.2),
    5: ("gamma 2.8", lambda x: x**2.8),
    7: ("SMPTE 240M", _adobe),
    8: ("linear", lambda x: x),
    9: ("logarithm", lambda x: np.where(x > 0, 10 ** (2 * (x - 1)), 0)),
    10: ("logarithm", lambda x: np.where(x > 0, 10 ** (2.5 * (x - 1)), 0)),
    13: ("sRGB", lambda x: as_linear(x.astype(np.float32), "srgb")),
    16: ("PQ", _pq),
    17: ("SMPTE 428", lambda x: 52.37 / 48 * x**2.6),
    18: ("HLG", _hlg),
}
"""Light by values in [0, 1], for the transfer codes of ITU-T H.273, table 3: of cameras
the scene's light (BT.709, HLG), of displays theirs (PQ, of 10,000 cd/m2)."""


def encoding_of(
    dtype: DTypeLike,
    *,
    icc: bytes = b"",
    code: int = 0,
    gamma: float = 0,
    srgb: bool = False,
    primaries: Sequence[float] = (),
) -> Encoding:
    """How a file's values encode light: by its colour profile, tags or type, in turn.

    `code` is a key of `CURVES`, `gamma` an exponent such as 1 / 2.2; 0 where unknown. A
    curve other than linear and sRGB, such as ProPhoto's, is made sRGB by a table; one
    of a transfer code has 16 bits, since PQ puts all that papers reflect below 2%.
    Without any tag 8 bit is sRGB, since cameras, phones and programs write it so, and
    16 bit and float linear, since raw converters for measurement, data sets and
    renderers write them so. `primaries`: chromaticities as in `PRIMARIES`; empty where
    unknown.
    """
    curve = icc_curve(icc)
    if curve is not None:
        found = _encoding(np.dtype(dtype), curve, "colour profile in the file")
        return _of_colors(found, icc_to_srgb(icc))
    if icc:  # by tables, as of printers and of sRGB's own fourth version
        return Encoding("srgb", "colour profile in the file, taken as sRGB")
    return _of_colors(
        _encoding_of_tags(np.dtype(dtype), code, gamma, srgb),
        primaries_to_srgb(primaries),
    )


def _encoding_of_tags(dtype: np.dtype, code: int, gamma: float, srgb: bool) -> Encoding:
    if code:
        title, curve_of = CURVES[code]
        curve = np.clip(curve_of(np.linspace(0, 1, _SAMPLES)), 0, 1)
        return _encoding(dtype, curve, f"{title} code in the file", np.uint16)
    if srgb:
        return Encoding("srgb", "sRGB tag in the file")
    if gamma > 0:
        curve = np.linspace(0, 1, _SAMPLES) ** (1 / gamma)
        return _encoding(dtype, curve, f"gamma of {gamma:.3g} in the file")
    name = {1: "8-bit values", 2: "16-bit values"}.get(dtype.itemsize)
    return Encoding(usual_transfer(dtype), name or "floating-point values")


def usual_transfer(dtype: DTypeLike) -> Transfer:
    """How values without any tag are taken to encode light: see `encoding_of`."""
    return "srgb" if dtype == np.uint8 else "linear"


def _of_colors(encoding: Encoding, to_srgb: np.ndarray | None) -> Encoding:
    if to_srgb is None:
        return encoding
    rule = f"{encoding.rule}; colours of its own"
    return dataclasses.replace(encoding, rule=rule, to_srgb=to_srgb)


def icc_curve(profile: bytes) -> np.ndarray | None:
    """Linear light over 1024 values from 0 to 1, by a profile's (green) tone curve.

    None where it has no such curve, or is damaged. Source: ICC.1:2022, 9.2, 10.6,
    10.18.
    """
    try:
        tags = _icc_tags(profile)
        start, length = tags.get(b"gTRC") or tags[b"kTRC"]
        return _tone_curve(profile[start : start + length])
    except (struct.error, KeyError, ValueError, ZeroDivisionError):
        return None


def icc_to_srgb(profile: bytes) -> np.ndarray | None:
    """Linear sRGB by a profile's linear RGB, `[3, 3]`, as of Adobe RGB, Display P3.

    None where it has sRGB's colours or no such three, or is damaged. Source:
    ICC.1:2022, 9.2 (rXYZMatrixColumn), 10.31.
    """
    try:
        tags = _icc_tags(profile)
        columns = [
            struct.unpack_from(">3i", profile, tags[name][0] + 8)
            for name in (b"rXYZ", b"gXYZ", b"bXYZ")
        ]
    except (struct.error, KeyError):
        return None
    return _unless_srgb(np.linalg.solve(_SRGB_XYZ, np.transpose(columns) / 65536))


def primaries_to_srgb(chromaticities: Sequence[float]) -> np.ndarray | None:
    """Linear sRGB by the linear RGB of chromaticities, `[3, 3]`; white stays white.

    None where that is sRGB's own, or they are none.
    """
    if len(chromaticities) != 8:
        return None
    try:
        with np.errstate(all="ignore"):
            matrix = np.linalg.solve(_xyz_of(_SRGB), _xyz_of(chromaticities))
    except np.linalg.LinAlgError:
        return None
    return _unless_srgb(matrix)


def _xyz_of(chromaticities: Sequence[float]) -> np.ndarray:
    """XYZ of red, green and blue in columns, under D65 by Bradford's adaptation."""
    x, y = np.reshape(chromaticities, (4, 2)).astype(float).T
    columns = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    colors, white = columns[:, :3], columns[:, 3]
    colors = colors * np.linalg.solve(colors, white)
    d65 = np.array([_D65[0], _D65[1], 1 - sum(_D65)]) / _D65[1]
    cones = (_BRADFORD @ d65) / (_BRADFORD @ white)
    return np.linalg.solve(_BRADFORD, cones[:, None] * (_BRADFORD @ colors))


def _unless_srgb(matrix: np.ndarray) -> np.ndarray | None:
    alike = np.abs(matrix - np.eye(3)).max() < 0.02
    if alike or not np.abs(matrix).max() <= 4:  # or not finite
        return None
    return matrix.astype(np.float32)


def in_srgb(linear: np.ndarray, to_srgb: np.ndarray | None) -> np.ndarray:
    """Linear colours `[..., 3]` as sRGB's, those beyond them clipped at 0."""
    return linear if to_srgb is None else np.maximum(linear @ to_srgb.T, 0)


def _icc_tags(profile: bytes) -> dict[bytes, tuple[int, int]]:
    """Where a profile's tags are: start and length."""
    (count,) = struct.unpack_from(">I", profile, 128)
    entries = struct.iter_unpack(">4sII", profile[132 : 132 + 12 * count])
    return {name: (start, length) for name, start, length in entries}


def _tone_curve(tag: bytes) -> np.ndarray:
    x = np.linspace(0, 1, _SAMPLES)
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        values = np.frombuffer(tag, ">u2", count, 12) / 65535
        if count == 0:
            return x
        if count == 1:
            return x ** (values[0] * 65535 / 256)
        return np.interp(x, np.linspace(0, 1, count), values)
    if tag[:4] != b"para":
        raise ValueError("no tone curve")
    (kind,) = struct.unpack_from(">H", tag, 8)
    names = ("g", "gab", "gabc", "gabcd", "gabcdef")[kind : kind + 1]
    if not names:
        raise ValueError("no tone curve")
    numbers = struct.unpack_from(f">{len(names[0])}i", tag, 12)
    p = dict.fromkeys("bcdef", 0.0) | {"a": 1.0}
    p |= {name: n / 65536 for name, n in zip(names[0], numbers, strict=True)}
    # The first kinds meet where a x + b = 0, below which c (their e and f) holds.
    low, offset = (p["c"] * x + p["f"], p["e"]) if kind >= 3 else (p["c"], p["c"])
    first = p["d"] if kind >= 3 else -p["b"] / p["a"]
    power = np.maximum(p["a"] * x + p["b"], 0) ** p["g"] + offset
    return np.clip(np.where(x >= first, power, low), 0, 1)


def _encoding(
    dtype: np.dtype, curve: np.ndarray, rule: str, wide: DTypeLike | None = None
) -> Encoding:
    x = np.linspace(0, 1, _SAMPLES, dtype=np.float32)
    if np.abs(curve - x).max() < _ALIKE:
        return Encoding("linear", f"{rule}, linear")
    if np.abs(curve - as_linear(x, "srgb")).max() < _ALIKE:
        return Encoding("srgb", f"{rule}, sRGB")
    if dtype.kind == "f":
        return Encoding("linear", f"floating-point values, in spite of the {rule}")
    top = np.iinfo(dtype).max
    linear = np.interp(np.linspace(0, 1, top + 1), x, curve)
    stored = np.dtype(wide or dtype)
    table = np.rint(srgb_encode(linear) * np.iinfo(stored).max).astype(stored)
    return Encoding("srgb", f"{rule}, of its own, made sRGB", table)


def as_linear(image: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Values of linear light, float32, in [0, 1] for integers."""
    values = as_float(image)
    if transfer == "srgb":
        low = values / 12.92
        high = ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4
        values = np.where(values <= 0.04045, low, high).astype(np.float32)
    return values


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function (IEC 61966-2-1); linear values outside [0, 1] clip."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
