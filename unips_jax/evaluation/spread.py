"""Tables of how far the means may be trusted; see `statistics`.

Deviations over subsets of images are those of the mean over objects, from one seed to
the next.
"""

import numpy as np

from unips_jax.evaluation.cells import Column, Table, columns, row
from unips_jax.evaluation.results import Results, average, lit, mean_error, number
from unips_jax.evaluation.statistics import LEAST_OBJECTS, compare, interval


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
