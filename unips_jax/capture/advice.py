"""Warns about photographs that show no method the shape, and of poor masks.

Looks at the mask, at about 20,000 pixels inside it, and compares the images with each
other at 2,000 of these, so it costs little next to an estimate. The thresholds are
rules of thumb; a warning never stops anything.
"""

import math
from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from unips_jax.capture.findings import Finding, by_file, some
from unips_jax.io.masks import mask_box

_SAMPLES = 20_000
_COMPARED = 2_000
_FEW_IMAGES = 4
_SMALL_MASK = 2_000
_SATURATED_SHARE = 0.05
_DARK_LEVELS = {1: 32, 2: 328}  # by bytes: of sRGB, and half a percent of light
_SAME_LIGHT = 0.05
_SAME_IMAGE = 0.01
_ISLAND_SHARE = 0.01
_SPECKS = 4  # pixels
_HOLE_SHARE = 0.0005
_HOLE = 20
_AROUND = 4  # pixels around a hole
_DARKER = 0.5  # of the stored values around
_LOOKED_AT = 200  # holes
_UNLIT = 0.06  # of the others' reach, in stored values


def look_at_values(
    images: np.ndarray,
    mask: np.ndarray,
    names: Sequence[str],
    *,
    taken: np.ndarray | None = None,
) -> list[Finding]:
    """Lists what is wrong with a mask, with exposure and with the lights' variety.

    Images are not black inside the mask, which has a pixel or more; `taken` are the
    same as they were exposed, where a dark frame was subtracted.
    """
    inside = int(mask.sum())
    step = math.ceil((inside / _SAMPLES) ** 0.5)
    if not mask[::step, ::step].any():
        step = 1
    few = (slice(None), slice(None, None, step), slice(None, None, step))
    samples = images[few][:, mask[few[1:]]]  # [N, P, 3]
    exposed = samples if taken is None else taken[few][:, mask[few[1:]]]
    return [
        *_count_findings(len(images), inside),
        *_mask_findings(mask, images),
        *_exposure_findings(exposed, names, _unlit(samples, names)),
        *_light_findings(samples, names),
    ]


def _count_findings(count: int, inside: int) -> Iterator[Finding]:
    if count < _FEW_IMAGES:
        yield Finding(
            "few photographs",
            f"too few photographs: {count}; take six to twenty, each under another "
            "light (four still give a rough shape)",
        )
    if inside < _SMALL_MASK:
        yield Finding(
            "tiny mask",
            f"tiny mask: {inside} pixels are inside; the object should fill the frame",
        )


def _mask_findings(mask: np.ndarray, images: np.ndarray) -> Iterator[Finding]:
    """Parts of the mask that are hardly meant: specks, islands, pinholes."""
    rows, columns = mask_box(mask)
    images, mask = images[:, rows, columns], mask[rows, columns]
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = np.sort(stats[1:, cv2.CC_STAT_AREA])[::-1]
    specks = areas[areas < _ISLAND_SHARE * areas[0]]
    islands = areas[: len(areas) - len(specks)]
    if specks.sum() >= _SPECKS:
        yield Finding(
            "specks in the mask",
            f"specks in the mask: {len(specks)} of together {specks.sum()} pixels "
            "lie apart from the object; they get normals too: erase them",
        )
    if len(islands) > 1:
        shares = [f"{area / areas.sum():.0%}" for area in islands]
        yield Finding(
            "mask in parts",
            f"mask in {len(islands)} parts ({some(shares)}): one object is "
            "expected; join the parts, or estimate each with a mask of its own",
        )
    holes = filled_holes(mask, images)[1]
    if len(holes):
        yield Finding(
            "holes in the mask",
            f"small holes in the mask: {len(holes)} of together {holes.sum()} "
            "pixels; they get no normals: fill them, unless the object has holes "
            "there",
        )


def small_holes(mask: np.ndarray) -> np.ndarray:
    """Small parts of the background that a mask surrounds: `[H, W]`, bool."""
    labels, numbers, _ = _holes(mask)
    return np.isin(labels, numbers)


def _holes(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels `[H, W]` of the background's parts; the small holes' numbers, boxes."""
    outside = np.pad((~mask).astype(np.uint8), 1, constant_values=1)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(outside, connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA]
    small = areas <= max(_HOLE, _HOLE_SHARE * np.count_nonzero(mask))
    small[[0, labels[0, 0]]] = False
    numbers = np.flatnonzero(small)
    return labels[1:-1, 1:-1], numbers, stats[numbers]


def filled_holes(mask: np.ndarray, images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Small holes in which the object is seen, about as bright as around, and areas."""
    labels, numbers, stats = _holes(mask)
    areas = stats[:, cv2.CC_STAT_AREA]
    if not len(numbers):
        return np.zeros_like(mask), areas
    brightest = images[0].max(axis=-1)
    for image in images[1:]:
        brightest = np.maximum(brightest, image.max(axis=-1))
    seen = np.ones(len(numbers), bool)
    for index in range(min(len(numbers), _LOOKED_AT)):
        left, top, width, height = stats[index, :4]  # of a frame of one pixel more
        rows = slice(max(top - 1 - _AROUND, 0), top - 1 + height + _AROUND)
        columns = slice(max(left - 1 - _AROUND, 0), left - 1 + width + _AROUND)
        hole, near = labels[rows, columns] == numbers[index], mask[rows, columns]
        values = brightest[rows, columns]
        seen[index] = np.median(values[hole]) > _DARKER * np.median(values[near])
    return np.isin(labels, numbers[seen]), areas[seen]


def _exposure_findings(
    samples: np.ndarray, names: Sequence[str], unlit: list[Finding]
) -> list[Finding]:
    brightest = samples.max(axis=-1)  # [N, P]
    # A camera's white may lie below the type's largest value; floats have none.
    white = brightest.max(axis=-1, keepdims=True)
    clipped = (brightest >= white).mean(axis=-1)
    clipped[white[:, 0] <= 0] = 0  # light beside the object alone
    if samples.dtype != np.float32:
        full = np.iinfo(samples.dtype).max
        few = 2 * _DARK_LEVELS[1]  # levels, of which many share the last
        clipped[white[:, 0] < few] = 0
    shares = {
        name: float(share)
        for name, share in zip(names, clipped, strict=True)
        if share > _SATURATED_SHARE
    }
    found = by_file(
        "saturated",
        shares,
        "{:.0%}",
        "saturated: {} of the object at the largest value; expose less",
    )
    reach = _reach(samples)
    if samples.dtype != np.float32:
        levels = {
            name: level
            for name, level in zip(names, reach, strict=True)
            if level < _DARK_LEVELS[samples.dtype.itemsize]
            and not any(name in f.files for f in unlit)
        }
        found += by_file(
            "underexposed",
            levels,
            "{:.0f}",
            "underexposed: the brightest of the object reach only level {} of "
            f"{full}; expose more",
        )
    return found + unlit


def _reach(samples: np.ndarray) -> np.ndarray:
    """How bright each photograph becomes, but for its last percent: `[N]`."""
    return np.percentile(samples.max(axis=-1), 99, axis=-1).astype(np.float64)


def _unlit(samples: np.ndarray, names: Sequence[str]) -> list[Finding]:
    """One photograph without its lamp, among others."""
    reach = _reach(samples)
    dark = np.flatnonzero(reach < _UNLIT * np.median(reach))
    if len(dark) != 1 or len(reach) < _FEW_IMAGES:
        return []
    name, level = names[dark[0]], reach[dark[0]] / np.median(reach)
    return [
        Finding(
            "unlit",
            f"hardly any light: {name} reaches {level:.1%} of what the others do; if "
            f"it was taken without the lamp, --dark {name} subtracts it from them, "
            "else --exclude it",
            (name,),
            {name: level},
        )
    ]


def _light_findings(samples: np.ndarray, names: Sequence[str]) -> list[Finding]:
    """Compares the images' shading, each divided by its mean."""
    if len(samples) < 2:
        return []
    step = math.ceil(samples.shape[1] / _COMPARED)
    scaled = samples[:, ::step].astype(np.float32)
    scaled /= np.maximum(scaled.mean(axis=(1, 2), keepdims=True), 1e-12)
    same, files = [], []
    largest = 0.0
    for i in range(1, len(scaled)):
        distances = np.abs(scaled[:i] - scaled[i]).mean(axis=(1, 2))
        largest = max(largest, float(distances.max()))
        if distances.min() < _SAME_IMAGE:
            same.append(f"{names[int(distances.argmin())]} = {names[i]}")
            files.append(names[i])
    if largest < _SAME_LIGHT:
        return [
            Finding(
                "same light",
                "nearly identical photographs: shading differs by "
                f"{largest:.1%} at most; move the light between shots",
                figures={"largest difference": largest},
            )
        ]
    if same:
        return [
            Finding(
                "duplicates",
                f"nearly identical photographs: {some(same)}; they add nothing",
                tuple(files),
            )
        ]
    return []
