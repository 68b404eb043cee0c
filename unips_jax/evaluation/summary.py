"""From results to tables. Nothing here depends on when or where they were computed."""

from unips_jax.evaluation.axes import find_turned, misfit
from unips_jax.evaluation.cells import (
    Cell,
    Column,
    Kind,
    Row,
    Table,
    Value,
    columns,
    lowest,
    row,
)
from unips_jax.evaluation.published import DATA, PUBLISHED, Published, comparable, mean
from unips_jax.evaluation.results import (
    Results,
    average,
    common,
    complete,
    lit,
    mean_error,
    number,
)
from unips_jax.evaluation.runner import Result
from unips_jax.evaluation.scores import THRESHOLDS_DEG, VIEW_EDGES_DEG
from unips_jax.evaluation.spread import pairs_table, spread_table

TABLES = tuple(
    "summary images spread pairs objects categories views angles measures published "
    "methods remarks".split()
)
"""Names of all tables that a run may have."""

_SOURCE = Column("Source", in_report=False)


def tables(results: Results) -> list[Table]:
    """All tables of a run, those that would be empty left out."""
    made = [
        _summary(results),
        _images(results),
        spread_table(results),
        pairs_table(results),
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


def _summary(results: Results) -> Table:
    shares = [f"% < {threshold:g}" for threshold in THRESHOLDS_DEG]
    scores = [*results.lightings, "Mean", "Median", *shares]
    own: dict[str, list[float | None]] = {}
    objects: dict[str, str] = {}
    for label in results.labels:
        found = results.of(label, results.main_count)
        scored = [result.score for result in found if result.score]
        own[label] = [
            *(mean_error(lit(found, lighting)) for lighting in results.lightings),
            mean_error(found),
            average(score.median for score in scored),
            *(average(s.within[i] for s in scored) for i in range(len(shares))),
        ]
        objects[label] = f"{len(scored)} of {len(found)}"
    best = {label: set[int]() for label in results.labels}
    for c, name in enumerate(scores):
        tags = {"lighting": name} if name in results.lightings else {}
        picked = complete(results, tags)
        column = {k: x for k, v in own.items() if (x := v[c]) is not None}
        compared = {label: x for label, x in column.items() if label in picked}
        pick = max if name in shares else min
        for label, x in compared.items():
            if x == pick(compared.values()):
                best[label].add(3 + c)
    images = number(results.main_count)
    rows = []
    for label in results.labels:
        cells = [label, images, "this run", *own[label], objects[label]]
        rows.append(row(*cells, method=label, best=best[label]))
    for known in _shown(results):
        cells = [known.method, number(known.images), "published"]
        cells += [known.scores.get(lighting) for lighting in results.lightings]
        cells += [mean(known, results.evaluated), *[None] * (len(shares) + 2)]
        rows.append(row(*cells, kind="published"))
    title = f"Mean angular error in degrees over objects, protocol {results.protocol}"
    if len(results.seeds) > 1 and results.main_count is not None:
        title += f", means over {len(results.seeds)} subsets of images"
    if results.benchmark in DATA:
        title += f"; published scores are of {DATA[results.benchmark]}"
    counted = f"{results.entry_name}s".capitalize()
    head = [*columns(["Method", "Images"]), _SOURCE, *columns([*scores, counted])]
    return Table("summary", title, head, rows)


def _shown(results: Results) -> list[Published]:
    """Published rows that compare with the methods of this run."""
    groups = {"method"}
    if any("canonical" in label for label in results.labels):
        groups.add("canonical size")
    if any("uniform contexts" in label for label in results.labels):
        groups.add("contexts")
    rows = comparable(results.benchmark, results.evaluated)
    return [known for known in rows if known.group in groups]


def _images(results: Results) -> Table:
    rows: list[Row] = []
    if len(results.counts) > 1:
        for label in results.labels:
            for count in results.counts:
                own = results.of(label, count)
                errors = [mean_error(lit(own, name)) for name in results.lightings]
                cells = [number(count), "this run", *errors, mean_error(own)]
                rows.append(row(label, *cells, method=label))
        for known in PUBLISHED.get(results.benchmark, ()):
            if known.group == "images":
                scored = [known.scores.get(name) for name in results.lightings]
                cells = [number(known.images), "published", *scored]
                cells.append(mean(known, results.evaluated))
                rows.append(row(known.method, *cells, kind="published"))
    scores = columns([*results.lightings, "Mean"])
    return Table(
        "images",
        "Mean angular error in degrees against the number of images",
        [*columns(["Method", "Images"]), _SOURCE, *scores],
        rows,
    )


def _objects(results: Results) -> Table:
    known = [
        printed
        for printed in PUBLISHED.get(results.benchmark, ())
        if any(result.tags["object"] in printed.scores for result in results.entries)
    ]
    tags = [
        tag
        for tag in ("lighting", "category", "material")
        if any(tag in result.tags for result in results.entries)
    ]
    own = {
        label: {r.entry: r for r in results.of(label, results.main_count)}
        for label in results.labels
    }
    first = 1 + len(tags)
    rows: list[Row] = []
    for entry in results.entries:
        cells = [Cell(entry.entry), *(Cell(entry.tags.get(tag)) for tag in tags)]
        cells += [_error(own[label][entry.entry]) for label in results.labels]
        best = lowest({c: cells[c].value for c in range(first, len(cells))})
        cells = [cell._replace(best=c in best) for c, cell in enumerate(cells)]
        cells += [Cell(p.scores.get(entry.tags["object"])) for p in known]
        rows.append(Row(cells))
    means = [mean_error(own[label].values()) for label in results.labels]
    every = complete(results, {})
    compared = {
        first + i: means[i] for i, label in enumerate(results.labels) if label in every
    }
    printed_means = [mean(printed, results.evaluated) for printed in known]
    figures = [*[None] * len(tags), *means, *printed_means]
    rows.append(row("mean", *figures, kind="mean", best=lowest(compared)))
    head = columns(["Object", *(tag.capitalize() for tag in tags)], results.labels)
    head += columns(f"{printed.method} (published)" for printed in known)
    return Table("objects", "Mean angular error in degrees per object", head, rows)


def _error(result: Result) -> Cell:
    if result.score:
        return Cell(result.score.mae)
    if result.unsupported:
        word = "failed" if result.failed else "unsupported"
        return Cell(word, note=result.reason)
    return Cell("truth withheld")


def _groups(results: Results, tag: str, name: str, words: str) -> Table:
    """Means over the entries that share a tag's value."""
    values = sorted({r.tags[tag] for r in results.results if tag in r.tags})
    rows: list[Row] = []
    for value in values:
        for lighting in results.lightings or (None,):
            tags = (
                {tag: value} if lighting is None else {tag: value, "lighting": lighting}
            )
            picked = [
                [
                    result
                    for result in results.of(label, results.main_count)
                    if tags.items() <= result.tags.items()
                ]
                for label in results.labels
            ]
            if not picked[0]:
                continue
            head: list[Value] = [*tags.values(), len(picked[0])]
            errors = [mean_error(own) for own in picked]
            every = complete(results, tags)
            compared = {
                len(head) + i: errors[i]
                for i, label in enumerate(results.labels)
                if label in every
            }
            rows.append(row(*head, *errors, best=lowest(compared)))
    heading = [words.capitalize(), *(["Lighting"] if results.lightings else [])]
    title = f"Mean angular error in degrees per {words}"
    return Table(name, title, columns([*heading, "Objects"], results.labels), rows)


def _angles(results: Results) -> Table:
    scores = common(results)
    shared = next(iter(scores.values()), [])
    rows: list[Row] = []
    edges = VIEW_EDGES_DEG
    for i, (low, high) in enumerate(zip(edges, edges[1:], strict=False)):
        pixels = sum(score.view_pixels[i] for score in shared)
        if not pixels:
            continue
        sums = [sum(score.view_sums[i] for score in own) for own in scores.values()]
        errors = [total / pixels for total in sums]
        bounds = f"{low}-{high}" if high < edges[-1] else f"{low} and more"
        every = complete(results, {})
        compared = {
            2 + i: error
            for i, (label, error) in enumerate(zip(scores, errors, strict=True))
            if label in every
        }
        rows.append(row(bounds, round(pixels), *errors, best=lowest(compared)))
    entries = f"{len(shared)} {results.entry_name}{'s' * (len(shared) != 1)}"
    return Table(
        "angles",
        "Mean angular error in degrees by the angle between true normal and viewer, "
        f"over the pixels of {entries}, all that these methods share",
        columns(["Angle", "Pixels"], scores),
        rows,
    )


def _measures(results: Results) -> Table:
    """The methods' own figures, such as errors of the lights they found."""
    rows: list[Row] = []
    for label in results.labels:
        own = results.of(label, results.main_count)
        for name in dict.fromkeys(name for r in own for name in r.measures):
            having = [r for r in own if name in r.measures]
            means = [
                average(r.measures[name] for r in lit(having, lighting))
                for lighting in (*results.lightings, None)
            ]
            rows.append(row(label, name, *means, method=label))
    head = columns(["Method", "Measure", *results.lightings, "Mean"])
    return Table("measures", "What the methods say of their results", head, rows)


def _methods(results: Results) -> Table:
    rows = [row(*pair, method=pair[0]) for pair in results.methods.items()]
    head = columns(["Method", "What it is"])
    return Table("methods", "What the methods are", head, rows)


def _published(results: Results) -> Table:
    known = PUBLISHED.get(results.benchmark, ())
    names = list(dict.fromkeys(name for printed in known for name in printed.scores))
    names = [name for name in names if name != "mean"]
    rows = []
    for printed in known:
        cells = [printed.group, printed.method, number(printed.images)]
        cells += [printed.scores.get(name) for name in names]
        kind: Kind = "own" if printed.group == "method" else "folded"
        rows.append(row(*cells, mean(printed), kind=kind))
    head = columns(["Of", "Method", "Images", *names, "Mean"])
    return Table("published", "Scores as published, in degrees", head, rows)


def _remarks(results: Results) -> Table:
    rows = [
        row(entry.entry, None, note)
        for entry in results.entries
        for note in entry.notes
    ]
    for label, line in turned_axes(results).items():
        rows.append(_remark("all", label, line))
    refused: dict[tuple[str, str], list[str]] = {}
    for label in results.labels:
        for result in results.of(label, results.main_count):
            if result.unsupported:
                refused.setdefault((label, result.unsupported), []).append(result.entry)
            elif result.score and result.score.invalid:
                count = f"{result.score.invalid:g} pixels"
                text = f"{count} without an estimate count as 90 degrees"
                rows.append(_remark(result.entry, label, text))
    for (label, reason), names in refused.items():
        which = names[0] if len(names) == 1 else f"{len(names)} objects"
        rows.append(_remark(which, label, reason))
    head = columns(["Object", "Method", "Remark"])
    return Table("remarks", "Remarks", head, rows)


def turned_axes(results: Results) -> dict[str, str]:
    """Methods that are not ours and whose axes seem turned, with a line on it."""
    # Found by their scores; where the truth is withheld, by their slopes alone.
    found: dict[str, str] = {}
    for label in results.labels:
        own = results.of(label, results.main_count)
        pairs = [(r.score.mae, r.turned) for r in own if r.score and r.turned]
        if turned := find_turned(pairs):
            found[label] = turned.remark
        elif line := misfit([result.integrability for result in own]):
            found[label] = line
    return found


def _remark(which: str, label: str, text: str) -> Row:
    return Row([Cell(which), Cell(label, method=label), Cell(text)])
