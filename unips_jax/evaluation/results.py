"""The results of a run: one for each method, object, number of images and seed."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence

from unips_jax.evaluation.cells import Value
from unips_jax.evaluation.runner import Result
from unips_jax.evaluation.scores import Score, mean_score


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of a run, in the order of the tasks."""

    benchmark: str
    protocol: str  # its label
    methods: Mapping[str, str]  # what each method is, a line, by label, in order
    counts: Sequence[int | None]  # numbers of images; None for all
    results: Sequence[Result]
    seeds: Sequence[int] = (0,)  # of the subsets of images

    @property
    def labels(self) -> list[str]:
        """The methods' names, in order."""
        return list(self.methods)

    @property
    def main_count(self) -> int | None:
        """The number of images that tables other than the sweep show."""
        numbers = [count for count in self.counts if count is not None]
        return None if None in self.counts else max(numbers)

    @property
    def entries(self) -> list[Result]:
        """One result per object and lighting, in order, for names and tags."""
        return list({result.entry: result for result in self.results}.values())

    @property
    def objects(self) -> list[str]:
        """Names of the objects evaluated."""
        return list(dict.fromkeys(result.tags["object"] for result in self.results))

    @property
    def entry_name(self) -> str:
        """What an entry is: an object, or a set where an object has several."""
        return "object" if len(self.entries) == len(self.objects) else "set"

    @property
    def lightings(self) -> list[str]:
        """The lightings, in order; empty where the benchmark has none."""
        named = [r.tags["lighting"] for r in self.results if "lighting" in r.tags]
        return list(dict.fromkeys(named))

    @property
    def evaluated(self) -> list[str]:
        """Objects and lightings: what published scores may be named by."""
        return [*self.objects, *self.lightings]

    def each(self, label: str, count: int | None, seed: int) -> list[Result]:
        """A method's results with one seed; all images are the same for every seed."""
        found = self._of.get((label, count), ())
        return [result for result in found if result.seed in (None, seed)]

    def of(self, label: str, count: int | None) -> list[Result]:
        """A method's results, one for each entry: the mean over seeds."""
        return self._means.get((label, count), [])

    @functools.cached_property
    def _of(self) -> dict[tuple[str, int | None], list[Result]]:
        found: dict[tuple[str, int | None], list[Result]] = {}
        for result in self.results:
            found.setdefault((result.label, result.count), []).append(result)
        return found

    @functools.cached_property
    def _means(self) -> dict[tuple[str, int | None], list[Result]]:
        return {key: _over_seeds(own) for key, own in self._of.items()}


def _over_seeds(results: Sequence[Result]) -> list[Result]:
    by_entry: dict[str, list[Result]] = {}
    for result in results:
        by_entry.setdefault(result.entry, []).append(result)
    return [own[0] if len(own) == 1 else _mean(own) for own in by_entry.values()]


def _mean(results: Sequence[Result]) -> Result:
    """One entry's results with several seeds as one; no score if one lacks it."""
    scores = [result.score for result in results if result.score]
    every = len(scores) == len(results)
    names = set.intersection(*(set(result.measures) for result in results))
    return dataclasses.replace(
        results[0],
        turned={
            name: sum(result.turned.get(name, 180) for result in results) / len(results)
            for name in results[0].turned
        },
        seed=None,
        score=mean_score(scores) if every else None,
        measures={
            name: sum(result.measures[name] for result in results) / len(results)
            for name in results[0].measures
            if name in names
        },
        unsupported=next((r.unsupported for r in results if r.unsupported), ""),
    )


def average(values: Iterable[float]) -> float | None:
    """The mean; None of nothing."""
    values = list(values)
    return sum(values) / len(values) if values else None


def mean_error(results: Iterable[Result]) -> float | None:
    """The mean over entries of the mean angular errors that there are."""
    return average(result.score.mae for result in results if result.score)


def lit(results: Iterable[Result], lighting: str | None) -> list[Result]:
    """The results under a lighting; None: all."""
    return [r for r in results if lighting in (None, r.tags.get("lighting"))]


def number(count: int | None) -> Value:
    """A number of images as tables show it."""
    return "all" if count is None else count


def complete(results: Results, tags: Mapping[str, str]) -> set[str]:
    """The methods that have scores of the most entries with these tags, all the same.

    Of those that have as many of others, the ones that are alike to the first.
    """
    # Means over different objects do not compare.
    scored = {
        label: {
            result.entry
            for result in results.of(label, results.main_count)
            if result.score and tags.items() <= result.tags.items()
        }
        for label in results.labels
    }
    most = max(scored.values(), key=len)
    return {label for label, entries in scored.items() if entries == most}


def common(results: Results) -> dict[str, list[Score]]:
    """The methods that share entries, and their scores of these.

    Methods that have more entries come first; one that shares none with those before it
    is left out.
    """
    scored = {
        label: {
            result.entry: result.score
            for result in results.of(label, results.main_count)
            if result.score
        }
        for label in results.labels
    }
    shared: set[str] = set()
    kept: set[str] = set()
    for label in sorted(scored, key=lambda label: -len(scored[label])):
        both = shared & set(scored[label]) if kept else set(scored[label])
        if both:
            shared = both
            kept.add(label)
    return {
        label: [scored[label][entry] for entry in sorted(shared)]
        for label in results.labels
        if label in kept
    }
