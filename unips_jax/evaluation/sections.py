"""Tables as the report shows them: parts, marks and notes instead of bare cells."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from unips_jax.evaluation.published import DATA
from unips_jax.evaluation.styles import styles
from unips_jax.evaluation.summary import Cell, Results, Table
from unips_jax.evaluation.tables import text_of


class Shown(NamedTuple):
    """A cell.

    Attributes:
        text: as shown.
        value: the number to sort by; None for words.
        kinds: its CSS classes.
        note: the number of its note; 0 for none.
        color: of the method it names; empty for others.
    """

    text: str
    value: float | None = None
    kinds: str = ""
    note: int = 0
    color: str = ""


class Part(NamedTuple):
    """Rows that belong together and are sorted among themselves.

    Attributes:
        kind: "own", "published", "mean", or "folded" for what is shown on demand.
        heading: a line above them; empty for none.
        rows: the cells.
    """

    kind: str
    heading: str
    rows: Sequence[Sequence[Shown]]


class Section(NamedTuple):
    """A table of the report.

    Attributes:
        name: of the table.
        title: one line.
        columns: headings, with their methods' colours.
        numeric: columns that hold numbers, set flush right.
        parts: the rows.
        notes: what the cells' notes say, in order.
    """

    name: str
    title: str
    columns: Sequence[Shown]
    numeric: set[int]
    parts: Sequence[Part]
    notes: Sequence[str]


def sections(results: Results, tables: Sequence[Table]) -> list[Section]:
    """Readies all tables.

    Args:
        results: of the run.
        tables: as `summary.tables` makes them.
    """
    return [_section(results, table) for table in tables]


def _section(results: Results, table: Table) -> Section:
    kept = [c for c, name in enumerate(table.columns) if name != "Source"]
    best, reasons = _best(table, results), _reasons(table, results)
    colors = {name: style.color for name, style in styles(results.labels).items()}
    numeric = _numeric(table)
    notes = list(dict.fromkeys(reasons.values()))
    parts: dict[str, list[list[Shown]]] = {}
    for r, row in enumerate(table.rows):
        cells = []
        for c in kept:
            kinds = ["number"] * (c in numeric) + ["best"] * ((r, c) in best)
            reason = reasons.get((r, c))
            cell = row[c]
            cells.append(
                Shown(
                    text_of(cell),
                    cell if isinstance(cell, int | float) else None,
                    " ".join(kinds + ["lacking"] * (reason is not None)),
                    0 if reason is None else notes.index(reason) + 1,
                    colors.get(str(cell), "") if table.columns[c] == "Method" else "",
                )
            )
        parts.setdefault(_kind(table, r), []).append(cells)
    return Section(
        table.name,
        table.title,
        [Shown(name, color=colors.get(name, "")) for name in _picked(table, kept)],
        {place for place, c in enumerate(kept) if c in numeric},
        [Part(kind, _heading(kind, results), rows) for kind, rows in parts.items()],
        notes,
    )


def _picked(table: Table, kept: Sequence[int]) -> list[str]:
    return [table.columns[c] for c in kept]


def _kind(table: Table, r: int) -> str:
    row = table.rows[r]
    if table.name == "objects" and r == len(table.rows) - 1:
        return "mean"
    if "Source" in table.columns and row[table.columns.index("Source")] == "published":
        return "published"
    if table.name == "published" and row[0] != "method":
        return "folded"
    return "own"


def _heading(kind: str, results: Results) -> str:
    if kind == "published":
        data = DATA.get(results.benchmark, results.benchmark)
        return f"As published, measured on {data}"
    return "Ablations as published" if kind == "folded" else ""


def _reasons(table: Table, results: Results) -> dict[tuple[int, int], str]:
    """Why cells of the table of objects say "unsupported"."""
    if table.name != "objects":
        return {}
    by_key = {
        (result.entry, result.label): result.reason
        for result in results.results
        if result.count == results.main_count
    }
    found = {}
    for r, row in enumerate(table.rows):
        for c, name in enumerate(table.columns):
            reason = by_key.get((str(row[0]), name), "")
            if reason and row[c] == "unsupported":
                found[r, c] = reason
    return found


def _best(table: Table, results: Results) -> set[tuple[int, int]]:
    """Cells to show in bold: the lowest of a row, or of a column in the summary.

    Means over different objects do not compare: methods that lack some are left out.
    """
    if table.name == "summary":
        return _best_of_columns(table, results)
    if table.name not in ("objects", "categories", "views", "angles"):
        return set()
    best = set()
    for r, row in enumerate(table.rows):
        mean = table.name != "objects" or _kind(table, r) == "mean"
        picked = complete(results, _tags(table, row)) if mean else results.labels
        known = [
            (_number(row[c]), c)
            for c, name in enumerate(table.columns)
            if name in picked
        ]
        values = [(v, c) for v, c in known if v is not None]
        if len(values) > 1:
            best |= {(r, c) for v, c in values if v == min(values)[0]}
    return best


def _best_of_columns(table: Table, results: Results) -> set[tuple[int, int]]:
    best = set()
    own = [r for r, row in enumerate(table.rows) if row[2] == "this run"]
    for c, heading in enumerate(table.columns):
        lit = {"lighting": heading} if heading in results.lightings else {}
        picked = complete(results, lit)
        known = [
            (_number(table.rows[r][c]), r) for r in own if table.rows[r][0] in picked
        ]
        values = [(v, r) for v, r in known if v is not None]
        if values:
            pick = max if heading.startswith("%") else min
            best |= {(r, c) for v, r in values if v == pick(values)[0]}
    return best


def _tags(table: Table, row: Sequence[Cell]) -> dict[str, Cell]:
    """What the objects have in common that a row of means is over."""
    tag = {"categories": "category", "views": "view"}.get(table.name)
    if tag is None:
        return {}
    lit = {"lighting": row[1]} if "Lighting" in table.columns else {}
    return {tag: row[0], **lit}


def complete(results: Results, tags: Mapping[str, Cell]) -> set[str]:
    """The methods that have scores of the most objects with these tags."""
    scored = {
        label: sum(
            tags.items() <= result.tags.items()
            for result in results.of(label, results.main_count)
            if result.score
        )
        for label in results.labels
    }
    most = max(scored.values())
    return {label for label, count in scored.items() if count == most}


def _numeric(table: Table) -> set[int]:
    """Columns that hold numbers, to be set flush right."""
    columns = range(len(table.columns))
    return {
        c for c in columns if any(isinstance(row[c], int | float) for row in table.rows)
    }


def _number(cell: object) -> float | None:
    return cell if isinstance(cell, float) else None
