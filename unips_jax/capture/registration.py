"""Brings photographs that moved back to their place."""

import cv2
import numpy as np

from unips_jax.capture.motion import (
    VOTES,
    Motion,
    edge_field,
    field_back,
    grey_of,
    moved_back,
    shift_between,
)

_SIDE = 1024  # pixels of the longer side, where movement is measured
_FURTHEST = 0.02  # of the longer side, that refining may change
_ROUNDS = 3


def register(
    images: np.ndarray, motion: Motion
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Brings moved photographs back to the reference's place, parts of pixels too.

    Shifts, turns and scales are refined by the shifts of tiles, against all others, and
    applied by cubic interpolation. Returns the images, of the same type; `[H, W]` bool,
    where all of them have content; `[N, 2, 3]`, the affine maps from places of the
    reference to those of each photograph (x, y).
    """
    count, height, width = images.shape[:3]
    scale = min(1.0, _SIDE / max(height, width))
    maps = np.tile(np.eye(2, 3), (count, 1, 1))
    moved = np.flatnonzero((motion.votes >= VOTES) & motion.offsets.any(axis=1))
    maps[moved, :, 2] = motion.offsets[moved]
    fields = [edge_field(grey_of(image, scale)) for image in images]
    for _ in range(_ROUNDS):
        back = [
            field_back(field, _scaled(matrix, scale))
            for field, matrix in zip(fields, maps, strict=True)
        ]
        total = np.sum(back, axis=0)
        for index in moved.tolist():
            start = _scaled(maps[index], scale)
            refined = _refined(total - back[index], fields[index], start)
            maps[index] = _scaled(refined, 1 / scale)
    result = np.empty_like(images)
    valid = np.ones((height, width), bool)
    for index, image in enumerate(images):
        if index not in moved:
            result[index] = image
            continue
        result[index] = moved_back(image, maps[index], cv2.INTER_CUBIC)
        inside = np.ones((height, width), np.uint8)
        valid &= moved_back(inside, maps[index], cv2.INTER_NEAREST, zeros=True) > 0
    if result.dtype == np.float32:
        np.maximum(result, 0, out=result)
    return result, valid, maps


def _refined(rest: np.ndarray, field: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The map from places of the others' field to those of a field, near `start`."""
    # Each of overlapping tiles gives a shift; the similarity (shift, turn, scale) is
    # taken that most of them agree upon, or their shift alone.
    height, width = rest.shape
    back = field_back(field, start)
    size = height // 2, width // 2
    window = np.outer(*(np.hanning(side + 2)[1:-1] for side in size)).astype(np.float32)
    furthest = _FURTHEST * max(height, width)
    places, shifts, trust = [], [], []
    for top in range(0, height - size[0] + 1, max(1, size[0] // 2)):
        for left in range(0, width - size[1] + 1, max(1, size[1] // 2)):
            tile = (slice(top, top + size[0]), slice(left, left + size[1]))
            spectra = [np.fft.fft2(f[tile] * window) for f in (back, rest)]
            shift, sure = shift_between(*spectra, furthest=furthest)
            places.append((left + size[1] / 2, top + size[0] / 2))
            shifts.append(shift)
            trust.append(sure)
    change = _similarity(np.array(places), np.array(shifts), np.array(trust))
    reach = np.hypot(height, width) / 2
    if np.hypot(change[0, 0] - 1, change[1, 0]) * reach < 0.2:
        median = np.median(shifts, axis=0)
        change = np.concatenate([np.eye(2), median[:, None]], axis=1)
    return _after(start, change)


def _similarity(
    places: np.ndarray, shifts: np.ndarray, trust: np.ndarray
) -> np.ndarray:
    """`[2, 3]`: places to places and shifts, by least absolute deviations."""
    x, y = places.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.stack([[x, -y, one, zero], [y, x, zero, one]], axis=0)
    matrix = rows.transpose(2, 0, 1).reshape(-1, 4)
    trust = np.maximum(trust, 0)  # of a photograph without content below it
    weights = trust
    for _ in range(20):
        root = np.repeat(np.sqrt(weights), 2)
        found = np.linalg.lstsq(
            matrix * root[:, None], shifts.ravel() * root, rcond=None
        )[0]
        missed = np.hypot(*(matrix @ found - shifts.ravel()).reshape(-1, 2).T)
        weights = trust / np.maximum(missed, 0.1)
    a, b, right, down = found
    return np.array([[1 + a, -b, right], [b, 1 + a, down]])


def _after(matrix: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The map that does `first` and then `matrix`."""
    return (matrix @ np.concatenate([first, [[0, 0, 1]]], axis=0))[:, :3]


def _scaled(matrix: np.ndarray, scale: float) -> np.ndarray:
    """The same map between pictures `scale` times as large."""
    turn, shift = matrix[:, :2], matrix[:, 2]
    centre = np.full(2, (scale - 1) / 2)  # pixels lie at the middle of their squares
    shift = scale * shift + centre - turn @ centre
    return np.concatenate([turn, shift[:, None]], axis=1)
