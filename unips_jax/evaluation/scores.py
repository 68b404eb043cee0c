"""What is measured of an estimate, in numbers that can be summed over objects."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from unips_jax.metrics import angular_error_deg

THRESHOLDS_DEG = (5.0, 11.25, 22.5, 30.0)
VIEW_EDGES_DEG = (0, 15, 30, 45, 60, 75, 90)
"""Bins of the angle between true normal and viewer; the last one takes all above."""


_BINS = [f"mae_seen_from_{low}_deg" for low in VIEW_EDGES_DEG[:-1]]
NAMES = (
    "mae_deg",
    "median_deg",
    *(f"below_{threshold:g}_deg_percent" for threshold in THRESHOLDS_DEG),
    *_BINS,
    "pixels",
    "pixels_without_truth",
    "pixels_without_estimate",
)
"""What the numbers of a score are called where each is a row."""


class Score(NamedTuple):
    """Errors of one estimate over the object's pixels, in degrees."""

    pixels: int  # how many were compared
    mae: float  # the mean angular error
    median: float
    # percentages of pixels with errors below 5, 11.25, 22.5 and 30 degrees
    within: tuple[float, ...]
    histogram: tuple[int, ...]  # pixels per degree of error, 180 numbers
    # pixels per bin of the angle between true normal and viewer
    view_pixels: tuple[int, ...]
    view_sums: tuple[float, ...]  # sums of errors in the same bins
    zero_truth: int  # pixels whose true normal has zero length, counted as 90 degrees
    invalid: int  # pixels where the estimate is not finite or zero, counted as 90


def numbers_of(score: Score) -> dict[str, float]:
    """A score's numbers by name; bins of angles that are empty have none."""
    bins = zip(score.view_sums, score.view_pixels, strict=True)
    means = [total / pixels if pixels else None for total, pixels in bins]
    counts = (score.pixels, score.zero_truth, score.invalid)
    values = (score.mae, score.median, *score.within, *means, *counts)
    named = zip(NAMES, values, strict=True)
    return {name: value for name, value in named if value is not None}


def error_map(estimate: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Angular errors `[H, W]` in degrees; 90 where either is zero or not finite."""
    finite = np.isfinite(estimate).all(axis=-1, keepdims=True)
    return np.asarray(angular_error_deg(np.where(finite, estimate, 0), true))


def score(estimate: np.ndarray, true: np.ndarray, mask: np.ndarray) -> Score:
    """Compares an estimate `[H, W, 3]`, of any length, with the truth in a mask."""
    errors = error_map(estimate, true)[mask].astype(np.float64)
    true = true[mask].astype(np.float64)
    estimate = estimate[mask]
    length = np.linalg.norm(true, axis=-1)
    cosine = true[:, 2] / np.where(length > 0, length, 1)
    view = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
    bins = np.clip(np.digitize(view, VIEW_EDGES_DEG) - 1, 0, len(VIEW_EDGES_DEG) - 2)
    count = len(VIEW_EDGES_DEG) - 1
    usable = np.isfinite(estimate).all(-1) & estimate.any(-1)
    return Score(
        pixels=len(errors),
        mae=float(errors.mean()),
        median=float(np.median(errors)),
        within=tuple(float(100 * (errors < t).mean()) for t in THRESHOLDS_DEG),
        histogram=_histogram(errors),
        view_pixels=tuple(np.bincount(bins, minlength=count).tolist()),
        view_sums=tuple(np.bincount(bins, errors, count).tolist()),
        zero_truth=int((length == 0).sum()),
        invalid=int((~usable).sum()),
    )


def best_signs(estimate: np.ndarray, true: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The estimate with those signs of x, y and z that come closest to the truth."""
    # Methods for which convex equals concave are compared so in publications; an
    # oracle, to be marked in any table.
    turned = [
        estimate * np.array(s, np.float32) for s in itertools.product((1, -1), repeat=3)
    ]
    return min(turned, key=lambda normals: error_map(normals, true)[mask].mean())


def mean_score(scores: Sequence[Score]) -> Score:
    """Scores of the same pixels as one: the mean of every number."""

    def mean(values: Sequence[Any]) -> Any:
        if isinstance(values[0], tuple):
            return tuple(map(mean, zip(*values, strict=True)))
        return sum(values) / len(values)

    return Score._make(map(mean, zip(*scores, strict=True)))


def from_json(values: dict[str, Any]) -> Score:
    """Reads back what `Score._asdict` became in JSON."""
    lists: dict[str, Any] = {
        name: tuple(value) if isinstance(value, Sequence) else value
        for name, value in values.items()
    }
    return Score(**lists)


def _histogram(errors: np.ndarray) -> tuple[int, ...]:
    degrees = np.minimum(errors.astype(np.int64), 179)
    return tuple(np.bincount(degrees, minlength=180).tolist())
