"""Movement that a change of light does not explain.

A photograph of a matte object under one light is nearly a sum of the others under
theirs (Shashua, IJCV 1997). What a photograph is beyond such a sum shows shadows and
highlights, and movement: the derivatives along x and y take part in the sum, so that
their weights are the shift (Lucas and Kanade, IJCAI 1981). Parts of the picture decide
whether it is believed: with the shift most must be nearer to the sum.
"""

from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.io.color import Transfer, as_linear

SIDE = 256
"""Pixels of the longer side, where shifts are measured."""

_SUMMANDS = 4  # principal pictures of the others: matte, and a little more
_STEPS = 6
_BORDER = 4  # pixels that no shift brings in
_PARTS = 16  # along the longer side


class Shift(NamedTuple):
    """A shift, and how far it is believed."""

    offset: np.ndarray  # pixels to the right and down
    score: float  # how many spreads of the parts their gain is from 0


def light_of(image: np.ndarray, scale: float) -> np.ndarray:
    """About linear light, grey, smooth: `[h, w]`, float32, at `scale`, at most 1."""
    if scale < 1:
        image = cv2.resize(
            image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
        )
    transfer: Transfer = "srgb" if image.dtype == np.uint8 else "linear"
    return cv2.GaussianBlur(as_linear(image, transfer).mean(axis=-1), (0, 0), 1)


def shift_of(
    picture: np.ndarray, others: np.ndarray, starts: list[np.ndarray]
) -> Shift:
    """How far a photograph (`light_of`) lies from all others, near one of `starts`."""
    basis = _principal(others.reshape(len(others), -1))
    inner = np.zeros(picture.shape, np.float32)
    inner[_BORDER:-_BORDER, _BORDER:-_BORDER] = 1
    found = [_climb(picture, basis, inner.ravel(), start) for start in starts]
    rests = [_rest(_back(picture, d), basis, inner.ravel()) for d in found]
    still, spread = _rest(picture, basis, inner.ravel())
    costs = []
    for rest, own in rests:
        limit = max(spread, own)
        pair = [inner.ravel() * np.log1p((r / limit) ** 2) for r in (still, rest)]
        costs.append(pair)
    best = int(np.argmin([with_it.sum() / before.sum() for before, with_it in costs]))
    before, with_it = costs[best]
    gains = sums_of_parts((before - with_it).reshape(picture.shape))
    return Shift(found[best], _spreads(gains))


def sums_of_parts(values: np.ndarray, least: int = 6) -> np.ndarray:
    """The sums of a picture's parts, squares of a sixteenth of its longer side."""
    side = max(least, max(values.shape) // _PARTS)
    rows, columns = (max(1, n // side) for n in values.shape)
    cut = values[: rows * side, : columns * side]
    return cut.reshape(rows, -1, columns, cut.shape[1] // columns).sum(axis=(1, 3))


def _spreads(gains: np.ndarray) -> float:
    """A sum over parts in units of what it would spread by if signs were random."""
    return float(gains.sum() / max(np.sqrt((gains**2).sum()), 1e-9))


def _principal(others: np.ndarray) -> np.ndarray:
    """Pictures `[k, P]` whose sums the others nearly are, and a constant one."""
    if len(others) > _SUMMANDS:
        _, vectors = np.linalg.eigh(others @ others.T)
        others = vectors[:, -_SUMMANDS:].T @ others
    basis = np.concatenate([others, np.ones((1, others.shape[1]), np.float32)])
    return basis / np.maximum(np.linalg.norm(basis, axis=1, keepdims=True), 1e-9)


def _fitted(
    values: np.ndarray, basis: np.ndarray, inner: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Weights of the sum, what is left, and its spread; shadows count little."""
    weight = inner
    for _ in range(3):
        normal = (basis * weight) @ basis.T
        normal[np.diag_indices_from(normal)] += 1e-6 * np.trace(normal) / len(normal)
        sums = np.linalg.solve(normal + 1e-12, (basis * weight) @ values)
        rest = values - sums @ basis
        spread = 1.4826 * float(np.median(np.abs(rest[inner > 0])))
        spread += 1e-4 * float(values.max()) + 1e-9
        weight = inner / (1 + (rest / (3 * spread)) ** 2)
    return sums, rest, spread


def _rest(
    picture: np.ndarray, basis: np.ndarray, inner: np.ndarray
) -> tuple[np.ndarray, float]:
    _, rest, spread = _fitted(picture.ravel(), basis, inner)
    return rest, spread


def _climb(
    picture: np.ndarray, basis: np.ndarray, inner: np.ndarray, start: np.ndarray
) -> np.ndarray:
    offset = np.array(start, np.float64)
    for _ in range(_STEPS):
        back = _back(picture, offset)
        down, right = np.gradient(back)
        slopes = np.stack([right.ravel(), down.ravel()])
        sizes = np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-9)
        whole = np.concatenate([basis, slopes / sizes])
        step = -_fitted(back.ravel(), whole, inner)[0][-2:] / sizes[:, 0]
        length = float(np.hypot(*step))
        offset += step * min(1.0, 2 / max(length, 1e-9))
        if length < 0.03:
            break
    return offset


def _back(picture: np.ndarray, offset: np.ndarray) -> np.ndarray:
    matrix = np.concatenate([np.eye(2), np.reshape(offset, (2, 1))], axis=1)
    return cv2.warpAffine(
        picture,
        matrix,
        picture.shape[::-1],
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
