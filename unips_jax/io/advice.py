"""Warns about photographs from which no method can tell the shape, and of poor masks.

Looks at the mask, at about 20,000 pixels inside it, and compares the images with each
other at 2,000 of these, so it costs little beside an estimate. The thresholds are rules
of thumb; a warning never stops anything.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from unips_jax.io.masks import mask_box

_SAMPLES = 20_000
_COMPARED = 2_000
_FEW_IMAGES = 4
_SMALL_MASK = 2_000
_SATURATED_SHARE = 0.05
_DARK_LEVELS = 32
_SAME_LIGHT = 0.05
_SAME_IMAGE = 0.01
_ISLAND_SHARE = 0.01
_HOLE_SHARE = 0.001
_HOLE = 20


def capture_warnings(
    images: np.ndarray, mask: np.ndarray, names: Sequence[str]
) -> list[str]:
    """Lists what is wrong with a capture, one line each; empty if nothing is.

    Args:
        images: `[N, H, W, 3]`, uint8, uint16 or float32, not black inside the mask.
        mask: `[H, W]`, bool, with at least one pixel.
        names: the N file names.
    """
    inside = int(mask.sum())
    step = math.ceil((inside / _SAMPLES) ** 0.5)
    if not mask[::step, ::step].any():
        step = 1
    samples = images[:, ::step, ::step][:, mask[::step, ::step]]  # [N, P, 3]
    return [
        *_count_warnings(len(images), inside),
        *_mask_warnings(mask),
        *_exposure_warnings(samples, names),
        *_light_warnings(samples, names),
    ]


def _count_warnings(count: int, inside: int) -> list[str]:
    lines = []
    if count < _FEW_IMAGES:
        lines.append(
            f"too few photographs: {count}; take 8 or more, each under another light "
            "(4 still give a rough shape)"
        )
    if inside < _SMALL_MASK:
        lines.append(
            f"tiny mask: {inside} pixels are inside; the object should fill the frame"
        )
    return lines


def _mask_warnings(mask: np.ndarray) -> list[str]:
    """Parts of the mask that are hardly meant: specks, islands, pinholes."""
    mask = mask[mask_box(mask)].astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
    areas = np.sort(stats[1:, cv2.CC_STAT_AREA])[::-1]
    specks = areas[areas < _ISLAND_SHARE * areas[0]]
    islands = areas[: len(areas) - len(specks)]
    lines = []
    if len(specks):
        lines.append(
            f"specks in the mask: {len(specks)} of together {specks.sum()} pixels lie "
            "apart from the object; they get normals too: erase them"
        )
    if len(islands) > 1:
        shares = [f"{area / areas.sum():.0%}" for area in islands]
        lines.append(
            f"mask in {len(islands)} parts ({_some(shares)}): one object is expected; "
            "join the parts, or estimate each with a mask of its own"
        )
    holes = _hole_areas(mask)
    holes = holes[holes <= max(_HOLE, _HOLE_SHARE * areas[0])]
    if len(holes):
        lines.append(
            f"small holes in the mask: {len(holes)} of together {holes.sum()} pixels; "
            "they get no normals: fill them, unless the object has holes there"
        )
    return lines


def _hole_areas(mask: np.ndarray) -> np.ndarray:
    """Pixels of each part of the background that the mask surrounds."""
    outside = np.pad(1 - mask, 1, constant_values=1)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(outside, connectivity=4)
    inner = np.arange(1, len(stats)) != labels[0, 0]
    return stats[1:, cv2.CC_STAT_AREA][inner]


def _exposure_warnings(samples: np.ndarray, names: Sequence[str]) -> list[str]:
    if samples.dtype == np.float32:
        return []  # no largest value, no levels
    full = np.iinfo(samples.dtype).max
    brightest = samples.max(axis=-1)  # [N, P]
    clipped = (brightest >= full).mean(axis=-1)
    reach = np.percentile(brightest, 99, axis=-1)
    lines = []
    bright = [
        f"{name} {share:.0%}"
        for name, share in zip(names, clipped, strict=True)
        if share > _SATURATED_SHARE
    ]
    if bright:
        lines.append(
            f"saturated: {_some(bright)} of the object at the largest value; "
            "expose less"
        )
    dark = [
        f"{name} {level:.0f}"
        for name, level in zip(names, reach, strict=True)
        if level < _DARK_LEVELS
    ]
    if dark:
        lines.append(
            f"underexposed: the brightest of the object reach only level {_some(dark)} "
            f"of {full}; expose more"
        )
    return lines


def _light_warnings(samples: np.ndarray, names: Sequence[str]) -> list[str]:
    """Compares the images' shading, each divided by its mean."""
    if len(samples) < 2:
        return []
    step = math.ceil(samples.shape[1] / _COMPARED)
    scaled = samples[:, ::step].astype(np.float32)
    scaled /= np.maximum(scaled.mean(axis=(1, 2), keepdims=True), 1e-12)
    same = []
    largest = 0.0
    for i in range(1, len(scaled)):
        distances = np.abs(scaled[:i] - scaled[i]).mean(axis=(1, 2))
        largest = max(largest, float(distances.max()))
        if distances.min() < _SAME_IMAGE:
            same.append(f"{names[int(distances.argmin())]} = {names[i]}")
    if largest < _SAME_LIGHT:
        return [
            f"nearly identical photographs: shading differs by {largest:.1%} at most; "
            "move the light between shots"
        ]
    if same:
        return [f"nearly identical photographs: {_some(same)}; they add nothing"]
    return []


def _some(items: list[str], limit: int = 4) -> str:
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(items[:limit]) + more
