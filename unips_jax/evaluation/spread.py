"""How far a mean may be trusted: over objects, over subsets of images, in pairs.

Intervals are of the bootstrap: the objects are drawn again 10,000 times, with all
entries (lightings, views) of an object together, since these are no more independent
than one object is; the 2.5th and 97.5th percentiles of the mean are shown. Of a handful
of objects they are too narrow, and of fewer than three there are none. Deviations over
subsets are those of the mean over objects, from one seed to the next. The sign test is
two-sided, over objects; ties are left out.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from unips_jax.evaluation.cells import Column, Table, columns, row
from unips_jax.evaluation.results import Results, average, lit, mean_error, number

LEAST_OBJECTS = 3
_DRAWS = 10_000


class Pair(NamedTuple):
    """Two methods on the objects that both have.

    Attributes:
        objects: how many.
        mean: the first one's mean error, in degrees.
        other: the second one's.
        interval: of the mean difference, first minus second; None of few objects.
        lower: on how many objects the first is lower.
        higher: on how many the second is.
        p: of the sign test.
    """

    objects: int
    mean: float
    other: float
    interval: tuple[float, float] | None
    lower: int
    higher: int
    p: float


def interval(values: Mapping[str, Sequence[float]]) -> tuple[float, float] | None:
    """A 95 % interval of the mean over entries.

    Args:
        values: of each object's entries.

    Returns:
        Its ends; None of fewer than three objects.
    """
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
    """Compares two methods on the entries that both have.

    Args:
        first: errors by object and entry.
        second: the other's.

    Returns:
        None where they share nothing.
    """
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


def errors_by_object(
    results: Results, label: str, count: int | None
) -> dict[str, dict[str, float]]:
    """A method's mean angular errors by object and entry."""
    found: dict[str, dict[str, float]] = {}
    for result in results.of(label, count):
        if result.score:
            own = found.setdefault(result.tags["object"], {})
            own[result.entry] = result.score.mae
    return found


def deviation(
    results: Results, label: str, count: int | None, lighting: str | None = None
) -> float | None:
    """Standard deviation of the mean error over the seeds; None of fewer than two."""
    every = [lit(results.each(label, count, seed), lighting) for seed in results.seeds]
    drawn = any(result.seed is not None for own in every for result in own)
    scored = {result.entry for result in results.of(label, count) if result.score}
    means = [mean_error(r for r in own if r.entry in scored) for own in every]
    known = [mean for mean in means if mean is not None]
    if not drawn or len(known) < 2:
        return None
    return float(np.std(known, ddof=1))


def spread_table(results: Results) -> Table:
    """Every method's mean, its interval over objects, and deviation over seeds."""
    several = len(results.seeds) > 1
    rows = []
    for label in results.labels:
        for count in results.counts:
            errors = errors_by_object(results, label, count)
            if not errors:
                continue
            entries = {name: list(own.values()) for name, own in errors.items()}
            mean = average(x for own in entries.values() for x in own)
            low, high = interval(entries) or (None, None)
            cells = [mean, low, high, len(entries)]
            if several:
                cells.append(deviation(results, label, count))
            rows.append(row(label, number(count), *cells, method=label))
    title = "Mean angular error in degrees, with its 95 % interval over objects"
    names = ["Method", "Images", "Mean", "From", "To", "Objects"]
    if several:
        title += f" and its standard deviation over {len(results.seeds)} subsets"
        names.append("Over subsets")
    return Table("spread", title, columns(names), rows)


def pairs_table(results: Results) -> Table:
    """Every method against the first, on the objects that both have."""
    rows = []
    if results.labels:
        first, *others = results.labels
        own = errors_by_object(results, first, results.main_count)
        for label in others:
            pair = compare(errors_by_object(results, label, results.main_count), own)
            if pair and pair.objects >= LEAST_OBJECTS and pair.interval:
                cells = [pair.objects, pair.mean, pair.other, pair.mean - pair.other]
                lower = f"{pair.lower} of {pair.objects}"
                rows.append(
                    row(label, *cells, *pair.interval, lower, pair.p, method=label)
                )
        names = ["Method", "Objects", "Mean", first, "Difference", "From", "To"]
    else:
        names = ["Method"]
    return Table(
        "pairs",
        "Each method against the first, on the objects that both have: mean angular "
        "errors, the mean difference with its 95 % interval over objects, and a sign "
        "test",
        [*columns([*names, "Lower on"]), Column("Sign test p", digits=4)],
        rows,
    )
