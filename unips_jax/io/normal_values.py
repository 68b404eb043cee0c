"""What the values of a normal map stand for: the right reading makes the lengths 1.

Integers hold (n + 1) / 2 of full scale, floats n; but many floats, and bytes in arrays,
hold (n + 1) / 2 too. Some maps went through a display's curve, or had it taken from
them. Maps of two channels have a constant blue one.
"""

import numpy as np

from unips_jax.io.color import as_linear, srgb_encode

OVERRULE = "--as-stored"
"""The option of commands that takes values as they are."""

UNIT = 0.05
"""What a length may be off: rounding to bytes leaves 0.01."""

LEAST = 200
"""Pixels that a decision needs."""

_EXACT = 0.015  # the same of floats
_NOISE = 0.15  # of a colour, by JPEG
_SAMPLE = 200_000  # pixels that are looked at
_CURVES = (
    (
        "as a display's values (sRGB)",
        lambda values: as_linear(np.asarray(values, np.float32), "srgb"),
    ),
    ("with a display's curve taken from them (as if they were colours)", srgb_encode),
)


def decode_values(
    values: np.ndarray, there: np.ndarray, mended: list[str]
) -> np.ndarray:
    """Normals of any length: `[H, W, 3]`, float32, 0 where values stand for none.

    `there` says which values count; `mended` receives a line for each departure from
    the usual reading.
    """
    integers = values.dtype.kind == "u"
    top = int(np.iinfo(values.dtype).max) if integers else 1
    share = np.where(there[..., None], values, 0).astype(np.float32) / np.float32(top)
    none = ~there | (share == 0).all(-1) if not integers else ~there
    if integers:
        none |= ((values == top // 2) | (values == top // 2 + 1)).all(-1)
    seen = foreground(share, ~none)
    pixels = _some(share, seen)
    if not integers:
        full = _full_scale(pixels)
        if full is None:
            slopes = np.median(pixels[:, 2]) > 0.5 if len(pixels) else False
            share = np.where(none[..., None], 0, share)
            # (-p, -q, 1) is a normal too.
            return share if slopes else _with_blue(share, none, seen, mended)
        mended.append(
            f"values lie between 0 and {full:g}: read as (n + 1) / 2 of that; "
            f"{OVERRULE} takes them as normals"
        )
        share, pixels = share / np.float32(full), pixels / np.float32(full)
    if not _blue_is_missing(2 * pixels - 1):
        share = _without_curve(share, pixels, mended)
    return _with_blue(2 * share - 1, none, seen, mended)


def foreground(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The pixels but for those of the one colour that most of the border has.

    `there` itself where little else would be left. Values are of the order of 1. The
    colour is as wide as JPEG made it on the border.
    """
    ring = np.concatenate([values[0], values[-1], values[:, 0], values[:, -1]])
    colors, counts = np.unique(np.round(ring, 2), axis=0, return_counts=True)
    color = colors[counts.argmax()]
    away = np.abs(ring - color).max(-1)
    like = away[away < _NOISE]
    if len(like) < 0.4 * len(ring):
        return there
    other = np.abs(values - color).max(-1) > max(0.02, float(np.quantile(like, 0.95)))
    return there & other if np.count_nonzero(there & other) >= LEAST else there


def _some(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    pixels = values[seen]
    return pixels[:: max(1, len(pixels) // _SAMPLE)]


def _unit_share(normals: np.ndarray, tolerance: float) -> float:
    """How many of `[P, 3]` have length 1, from 0 to 1."""
    return float((np.abs(np.linalg.norm(normals, axis=-1) - 1) < tolerance).mean())


def _full_scale(pixels: np.ndarray) -> float | None:
    """The largest value of floats that hold (n + 1) / 2; None where they hold n."""
    if len(pixels) < LEAST or pixels.min() < 0:
        return None
    highest = pixels.max()
    full = next((x for x in (1.0, 255.0, 65535.0) if highest <= 1.001 * x), None)
    if full is None:
        return None
    if _unit_share(pixels, _EXACT) > 0.9:
        return None  # unit already, whatever their signs
    share = pixels / np.float32(full)
    encoded = 2 * share - 1
    if _blue_is_missing(encoded) and np.abs(np.median(encoded[:, :2])) < 0.3:
        return full
    readings = [encoded, *(2 * curve(share) - 1 for _, curve in _CURVES)]
    best = max(_unit_share(reading, UNIT) for reading in readings)
    return full if best > 0.3 and best > 2 * _unit_share(pixels, _EXACT) else None


def _without_curve(
    share: np.ndarray, pixels: np.ndarray, mended: list[str]
) -> np.ndarray:
    """Values from 0 to 1 as they were before a display's curve was put on them."""
    if len(pixels) < LEAST:
        return share
    plain = _unit_share(2 * pixels - 1, UNIT)
    fits = [_unit_share(2 * curve(pixels) - 1, UNIT) for _, curve in _CURVES]
    best = int(np.argmax(fits))
    if fits[best] <= max(0.6, 3 * plain):
        return share
    how, curve = _CURVES[best]
    mended.append(
        f"values are stored {how}, the lengths show it: undone; {OVERRULE} leaves them"
    )
    return curve(share).astype(np.float32)


def _blue_is_missing(normals: np.ndarray) -> bool:
    """Whether z of `[P, 3]` is constant, and not because lengths are 1."""
    if len(normals) < LEAST:
        return False
    low, high = np.quantile(normals[:, 2], (0.02, 0.98))
    flat = high - low < 0.02 and normals[:, :2].std(0).max() > 0.02
    within = (np.square(normals[:, :2]).sum(-1) < 1.05).mean() > 0.98
    return bool(flat and within and _unit_share(normals, UNIT) < 0.5)


def _with_blue(
    normals: np.ndarray, none: np.ndarray, seen: np.ndarray, mended: list[str]
) -> np.ndarray:
    """The normals, z worked out where its channel is missing; 0 where there is none."""
    normals = np.where(none[..., None], 0, normals)
    pixels = _some(normals, seen)
    if not _blue_is_missing(pixels):
        return normals
    squared = 1 - np.square(normals[..., :2]).sum(-1)
    mended.append(
        "the blue channel is constant: z is worked out from red and green; "
        f"{OVERRULE} takes it as it is"
    )
    normals[..., 2] = np.sqrt(np.maximum(squared, 0))
    return np.where((none | (squared < -0.1))[..., None], 0, normals)
