"""How far a mean may be trusted: over objects, and in pairs.

Intervals are of the bootstrap: the objects are drawn again 10,000 times, with all
entries (lightings, views) of an object together, since these are no more independent
than one object is; the 2.5th and 97.5th percentiles of the mean are shown. Of a handful
of objects they are too narrow, and of fewer than three there are none. The sign test is
two-sided, over objects; ties are left out.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

LEAST_OBJECTS = 3
_DRAWS = 10_000


class Pair(NamedTuple):
    """Two methods on the objects that both have."""

    objects: int  # how many
    mean: float  # the first one's mean error, in degrees
    other: float  # the second one's
    # of the mean difference, first minus second; None of few objects
    interval: tuple[float, float] | None
    lower: int  # on how many objects the first is lower
    higher: int  # on how many the second is
    p: float  # of the sign test


def interval(values: Mapping[str, Sequence[float]]) -> tuple[float, float] | None:
    """A 95 % interval of the mean over objects' entries; None of fewer than three."""
    if len(values) < LEAST_OBJECTS:
        return None
    sums = np.array([sum(own) for own in values.values()])
    sizes = np.array([len(own) for own in values.values()])
    drawn = np.random.default_rng(0).integers(len(sums), size=(_DRAWS, len(sums)))
    means = sums[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def compare(
    first: Mapping[str, Mapping[str, float]], second: Mapping[str, Mapping[str, float]]
) -> Pair | None:
    """Compares errors, by object and entry, of what both have; None of nothing."""
    from scipy.stats import binomtest

    pairs = {
        name: [(own[e], second[name][e]) for e in own if e in second[name]]
        for name, own in first.items()
        if name in second
    }
    pairs = {name: own for name, own in pairs.items() if own}
    if not pairs:
        return None
    differences = {name: [a - b for a, b in own] for name, own in pairs.items()}
    means = [sum(own) / len(own) for own in differences.values()]
    lower, higher = sum(x < 0 for x in means), sum(x > 0 for x in means)
    every = [pair for own in pairs.values() for pair in own]
    return Pair(
        len(pairs),
        sum(a for a, _ in every) / len(every),
        sum(b for _, b in every) / len(every),
        interval(differences),
        lower,
        higher,
        float(binomtest(lower, lower + higher).pvalue) if lower + higher else 1.0,
    )
