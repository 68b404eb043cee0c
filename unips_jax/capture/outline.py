"""Movement that an object's outline shows.

Shading changes with the light, and so does what it does to edges inside an object; an
outline moves with the object alone. Each photograph's outline is looked for on short
lines across the mask's: where the object is lit, values drop steeply there. How far
that is from where it mostly lies is, for a shift d, the part of d along the line.
"""

from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.capture.shading import light_of

_REACH = 8.0  # pixels to each side of the mask's outline
_STEP = 0.5
_POINTS = 240
_SEEN = 0.25  # of a photograph's clear edges
_FEWEST = 30
_ROUND = 0.08  # of the lines' directions, the less well known component
_STEPS = 10


class OutlineShifts(NamedTuple):
    """Where outlines lie, next to where they mostly do."""

    offsets: np.ndarray  # `[N, 2]`, pixels to the right and down
    agree: np.ndarray  # `[N]`, share of the lines within a pixel of the offset; 0: none
    still: np.ndarray  # `[N]`, the same share without an offset


def outline_shifts(
    images: np.ndarray, mask: np.ndarray, scale: float
) -> OutlineShifts | None:
    """How far the outlines of photographs `[N, H, W, 3]` lie from one another.

    Looked at in `scale`, at most 1; offsets are in pixels of the photographs.
    """
    small = cv2.resize(
        mask.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
    )
    places, outward = _lines(small)
    if len(places) < _FEWEST:
        return None
    found = [_edges(light_of(image, scale), places, outward) for image in images]
    edges = np.array([edge for edge, _ in found])  # [N, K]
    seen = np.array([clear for _, clear in found])
    known = np.where(seen, edges, np.nan)
    enough = seen.sum(axis=0) >= 3
    if enough.sum() < _FEWEST:
        return None
    usual = np.nanmedian(known[:, enough], axis=0)
    offsets = np.zeros((len(images), 2))
    agree, still = np.zeros(len(images)), np.zeros(len(images))
    for index in range(len(images)):
        there = seen[index, enough]
        fit = _fit(edges[index, enough][there] - usual[there], outward[enough][there])
        if fit is not None:
            offsets[index], agree[index], still[index] = fit
    return OutlineShifts(offsets / scale, agree, still)


def _lines(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points `[K, 2]` (x, y) of the outline within the frame; directions outwards."""
    soft = cv2.GaussianBlur(mask, (0, 0), 2.5)
    contours, _ = cv2.findContours(
        (mask > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    if not contours:
        return np.zeros((0, 2)), np.zeros((0, 2))
    points = max(contours, key=len)[:, 0].astype(np.float32)
    points = points[:: max(1, len(points) // _POINTS)]
    down, right = np.gradient(soft)
    x, y = points.astype(int).T
    outward = -np.stack([right[y, x], down[y, x]], axis=-1)
    size = np.linalg.norm(outward, axis=-1, keepdims=True)
    outward = outward / np.maximum(size, 1e-9)
    ends = points + _REACH * outward
    height, width = mask.shape
    inside = (ends >= 0).all(-1) & (ends < [width - 1, height - 1]).all(-1)
    keep = inside & (size[:, 0] > 0.05)
    return points[keep], outward[keep].astype(np.float32)


def _edges(
    grey: np.ndarray, places: np.ndarray, outward: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where on each line values change most, in pixels outwards; whether clearly."""
    count = round(2 * _REACH / _STEP) + 1
    along = np.linspace(-_REACH, _REACH, count, dtype=np.float32)
    points = places[:, None] + along[None, :, None] * outward[:, None]
    x, y = points.astype(np.float32).transpose(2, 0, 1)
    values = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slopes = np.abs(np.gradient(cv2.GaussianBlur(values, (7, 1), 1.5), axis=1))
    top = slopes[:, 2:-2].argmax(axis=1) + 2
    rows = np.arange(len(top))
    height = slopes[rows, top]
    before, after = slopes[rows, top - 1], slopes[rows, top + 1]
    curve = before - 2 * height + after
    part = np.where(curve < 0, 0.5 * (before - after) / np.minimum(curve, -1e-12), 0)
    place = along[top] + _STEP * np.clip(part, -0.5, 0.5)
    clear = height > _SEEN * np.percentile(height, 90)
    clear &= (top > 2) & (top < slopes.shape[1] - 3)
    return place, clear


def _fit(
    rests: np.ndarray, outward: np.ndarray
) -> tuple[np.ndarray, float, float] | None:
    """The offset `[2]` that explains most lines, by least absolute deviations."""
    if len(rests) < _FEWEST:
        return None
    if np.linalg.eigvalsh(outward.T @ outward / len(rests))[0] < _ROUND:
        return None
    weights = np.ones(len(rests))
    for _ in range(_STEPS):
        weighted = outward * weights[:, None]
        normal = outward.T @ weighted + 1e-9 * np.eye(2)
        offset = np.linalg.solve(normal, weighted.T @ rests)
        missed = np.abs(rests - outward @ offset)
        weights = 1 / np.maximum(missed, 0.2)
    return offset, float((missed < 1).mean()), float((np.abs(rests) < 1).mean())
