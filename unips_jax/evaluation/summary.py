"""From results to tables. Nothing here depends on when or where they were computed."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from unips_jax.evaluation.published import DATA, PUBLISHED, Published, comparable, mean
from unips_jax.evaluation.runner import Result
from unips_jax.evaluation.scores import THRESHOLDS_DEG, VIEW_EDGES_DEG, Score

Cell = str | int | float | None

TABLES = (
    *("summary", "images", "objects", "categories", "views", "angles"),
    *("measures", "published", "methods", "remarks"),
)
"""Names of all tables that a run may have."""


class Table(NamedTuple):
    """A table.

    Attributes:
        name: of its files.
        title: one line.
        columns: their headings.
        rows: as many cells each; None where there is nothing to say.
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]


@dataclasses.dataclass(frozen=True)
class Results:
    """The results of a run.

    Attributes:
        benchmark: its name.
        protocol: its label.
        methods: what each method is, a line, by label, in order.
        counts: numbers of images; None for all.
        results: in the order of the tasks.
    """

    benchmark: str
    protocol: str
    methods: Mapping[str, str]
    counts: Sequence[int | None]
    results: Sequence[Result]

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
    def lightings(self) -> list[str]:
        """The lightings, in order; empty where the benchmark has none."""
        named = [r.tags["lighting"] for r in self.results if "lighting" in r.tags]
        return list(dict.fromkeys(named))

    @property
    def evaluated(self) -> list[str]:
        """Objects and lightings: what published scores may be named by."""
        return [*self.objects, *self.lightings]

    def of(self, label: str, count: int | None) -> list[Result]:
        """A method's results."""
        return [r for r in self.results if r.label == label and r.count == count]


def tables(results: Results) -> list[Table]:
    """All tables of a run, those that would be empty left out."""
    made = [
        _summary(results),
        _images(results),
        _objects(results),
        _groups(results, "category", "categories", "material category"),
        _groups(results, "view", "views", "view"),
        _angles(results),
        _measures(results),
        _published(results),
        _methods(results),
        _remarks(results),
    ]
    return [table for table in made if table.rows]


def _average(values: Iterable[float]) -> float | None:
    values = list(values)
    return sum(values) / len(values) if values else None


def _mae(results: Iterable[Result]) -> float | None:
    return _average(r.score.mae for r in results if r.score)


def _lit(results: Iterable[Result], lighting: str) -> list[Result]:
    return [r for r in results if r.tags.get("lighting") == lighting]


def _number(count: int | None) -> Cell:
    return "all" if count is None else count


def _summary(results: Results) -> Table:
    lightings = results.lightings
    columns = [
        *("Method", "Images", "Source", *lightings, "Mean", "Median"),
        *(f"% < {threshold:g}" for threshold in THRESHOLDS_DEG),
        "Objects",
    ]
    rows: list[list[Cell]] = []
    for label in results.labels:
        own = results.of(label, results.main_count)
        scored = [r.score for r in own if r.score]
        share = [
            _average(score.within[i] for score in scored)
            for i in range(len(THRESHOLDS_DEG))
        ]
        cells: list[Cell] = [_mae(_lit(own, lighting)) for lighting in lightings]
        cells += [_mae(own), _average(score.median for score in scored), *share]
        rows.append(
            [
                *(label, _number(results.main_count), "this run", *cells),
                f"{len(scored)} of {len(own)}",
            ]
        )
    rows += [
        [
            *(row.method, _number(row.images), "published"),
            *(row.scores.get(lighting) for lighting in lightings),
            *(mean(row, results.evaluated), *[None] * (len(THRESHOLDS_DEG) + 2)),
        ]
        for row in _shown(results)
    ]
    title = f"Mean angular error in degrees over objects, protocol {results.protocol}"
    if results.benchmark in DATA:
        title += f"; published scores are of {DATA[results.benchmark]}"
    return Table("summary", title, columns, rows)


def _shown(results: Results) -> list[Published]:
    """Published rows that belong beside the methods of this run."""
    groups = {"method"}
    if any("canonical" in label for label in results.labels):
        groups.add("canonical size")
    if any("uniform contexts" in label for label in results.labels):
        groups.add("contexts")
    known = [r for r in PUBLISHED.get(results.benchmark, ()) if r.group in groups]
    return comparable(known, results.evaluated)


def _images(results: Results) -> Table:
    lightings = results.lightings
    rows: list[list[Cell]] = []
    if len(results.counts) > 1:
        for label in results.labels:
            for count in results.counts:
                own = results.of(label, count)
                cells = [_mae(_lit(own, lighting)) for lighting in lightings]
                rows.append([label, _number(count), "this run", *cells, _mae(own)])
        rows += [
            [
                *(row.method, _number(row.images), "published"),
                *(row.scores.get(lighting) for lighting in lightings),
                mean(row, results.evaluated),
            ]
            for row in PUBLISHED.get(results.benchmark, ())
            if row.group == "images"
        ]
    return Table(
        "images",
        "Mean angular error in degrees against the number of images",
        ["Method", "Images", "Source", *lightings, "Mean"],
        rows,
    )


def _cell(result: Result) -> Cell:
    if result.score:
        return result.score.mae
    return "unsupported" if result.unsupported else "truth withheld"


def _objects(results: Results) -> Table:
    known = [
        row
        for row in PUBLISHED.get(results.benchmark, ())
        if any(result.tags["object"] in row.scores for result in results.entries)
    ]
    tags = [
        tag
        for tag in ("lighting", "category", "material")
        if any(tag in result.tags for result in results.entries)
    ]
    by_key = {
        (r.entry, r.label): r for r in results.results if r.count == results.main_count
    }
    rows: list[list[Cell]] = []
    for entry in results.entries:
        cells = [_cell(by_key[entry.entry, label]) for label in results.labels]
        published = [row.scores.get(entry.tags["object"]) for row in known]
        described = [entry.tags.get(tag) for tag in tags]
        rows.append([entry.entry, *described, *cells, *published])
    averages = [_mae(results.of(label, results.main_count)) for label in results.labels]
    rows.append(
        [
            "mean",
            *[None] * len(tags),
            *averages,
            *(mean(row, results.evaluated) for row in known),
        ]
    )
    columns = ["Object", *(tag.capitalize() for tag in tags), *results.labels]
    columns += [f"{row.method} (published)" for row in known]
    return Table("objects", "Mean angular error in degrees per object", columns, rows)


def _groups(results: Results, tag: str, name: str, words: str) -> Table:
    values = sorted({r.tags[tag] for r in results.results if tag in r.tags})
    lightings = results.lightings
    rows: list[list[Cell]] = []
    for value in values:
        for lighting in lightings or (None,):
            picked = [
                [
                    r
                    for r in results.of(label, results.main_count)
                    if r.tags.get(tag) == value and r.tags.get("lighting") == lighting
                ]
                for label in results.labels
            ]
            if picked[0]:
                heading = [value] if lighting is None else [value, lighting]
                cells = [_mae(own) for own in picked]
                rows.append([*heading, len(picked[0]), *cells])
    columns = [words.capitalize(), *(["Lighting"] if lightings else []), "Objects"]
    title = f"Mean angular error in degrees per {words}"
    return Table(name, title, [*columns, *results.labels], rows)


def _angles(results: Results) -> Table:
    labels, scores = _common(results)
    rows: list[list[Cell]] = []
    edges = VIEW_EDGES_DEG
    for i, (low, high) in enumerate(zip(edges, edges[1:], strict=False)):
        pixels = (
            sum(score.view_pixels[i] for score in scores[labels[0]]) if labels else 0
        )
        if pixels:
            sums = [sum(s.view_sums[i] for s in scores[label]) for label in labels]
            bounds = f"{low}-{high}" if high < edges[-1] else f"{low} and more"
            rows.append([bounds, pixels, *(total / pixels for total in sums)])
    count = len(scores[labels[0]]) if labels else 0
    objects = "1 object" if count == 1 else f"{count} objects"
    return Table(
        "angles",
        "Mean angular error in degrees by the angle between true normal and viewer, "
        f"over the pixels of {objects}, all that these methods share",
        ["Angle", "Pixels", *labels],
        rows,
    )


def _common(results: Results) -> tuple[list[str], dict[str, list[Score]]]:
    """The methods that share objects, and their scores of these.

    Methods that have more objects come first; one that shares none with those before
    it is left out.
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
    return [label for label in results.labels if label in kept], {
        label: [scored[label][entry] for entry in sorted(shared)] for label in kept
    }


def _measures(results: Results) -> Table:
    """What the methods say of themselves, such as errors of the lights they found."""
    lightings = results.lightings
    rows: list[list[Cell]] = []
    for label in results.labels:
        own = results.of(label, results.main_count)
        for name in dict.fromkeys(name for r in own for name in r.measures):
            having = [r for r in own if name in r.measures]
            split = [
                _average(r.measures[name] for r in _lit(having, lighting))
                for lighting in lightings
            ]
            rows.append(
                [label, name, *split, _average(r.measures[name] for r in having)]
            )
    columns = ["Method", "Measure", *lightings, "Mean"]
    return Table("measures", "What the methods say of their results", columns, rows)


def _methods(results: Results) -> Table:
    rows = [list(pair) for pair in results.methods.items()]
    return Table("methods", "What the methods are", ["Method", "What it is"], rows)


def _published(results: Results) -> Table:
    known = PUBLISHED.get(results.benchmark, ())
    names = list(dict.fromkeys(name for row in known for name in row.scores))
    names = [name for name in names if name != "mean"]
    return Table(
        "published",
        "Scores as published, in degrees",
        ["Of", "Method", "Images", *names, "Mean"],
        [
            [
                *(row.group, row.method, _number(row.images)),
                *(row.scores.get(name) for name in names),
                mean(row),
            ]
            for row in known
        ],
    )


def _remarks(results: Results) -> Table:
    rows: list[list[Cell]] = []
    for entry in results.entries:
        rows += [[entry.entry, None, note] for note in entry.notes]
    refused: dict[tuple[str, str], list[str]] = {}
    for result in results.results:
        if result.count != results.main_count:
            continue
        if result.unsupported:
            key = result.label, result.unsupported
            refused.setdefault(key, []).append(result.entry)
        elif result.score and result.score.invalid:
            text = f"{result.score.invalid} pixels without an estimate count as 90"
            rows.append([result.entry, result.label, f"{text} degrees"])
    for (label, reason), names in refused.items():
        which = names[0] if len(names) == 1 else f"{len(names)} objects"
        rows.append([which, label, reason])
    return Table("remarks", "Remarks", ["Object", "Method", "Remark"], rows)
