"""Tables as the report shows them: in parts, with colours and numbered notes."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from unips_jax.evaluation.cells import Cell, Column, Kind, Row, Table, text_of
from unips_jax.evaluation.published import DATA
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.styles import styles


class Shown(NamedTuple):
    """A cell or a heading."""

    text: str
    value: float | None = None  # the number to sort by; None for words
    kinds: str = ""  # its CSS classes
    note: int = 0  # the number of its note; 0 for none
    color: str = ""  # of the method it names; empty for others


class Part(NamedTuple):
    """Rows that belong together and are sorted among themselves, with a line above."""

    kind: Kind
    heading: str
    rows: Sequence[Sequence[Shown]]


class Section(NamedTuple):
    """A table of the report."""

    name: str
    title: str
    columns: Sequence[Shown]  # headings, with their methods' colours
    numeric: set[int]  # places of the columns that hold numbers, set flush right
    parts: Sequence[Part]
    notes: Sequence[str]  # what the cells' notes hold, in order


def sections(results: Results, tables: Sequence[Table]) -> list[Section]:
    """Readies all tables."""
    colors = {name: style.color for name, style in styles(results.labels).items()}
    data = DATA.get(results.benchmark, results.benchmark)
    headings = {
        "published": f"As published, measured on {data}",
        "folded": "Ablations as published",
    }
    return [_section(table, colors, headings) for table in tables]


def _section(
    table: Table, colors: Mapping[str, str], headings: Mapping[str, str]
) -> Section:
    kept = [c for c, column in enumerate(table.columns) if column.in_report]
    heads = [table.columns[c] for c in kept]
    rows = [Row([row.cells[c] for c in kept], row.kind) for row in table.rows]
    numeric = {
        place
        for place in range(len(kept))
        if any(isinstance(row.cells[place].value, int | float) for row in rows)
    }
    notes = list(dict.fromkeys(c.note for row in rows for c in row.cells if c.note))

    def shown(cell: Cell, place: int, column: Column) -> Shown:
        marks = {"number": place in numeric, "best": cell.best, "lacking": cell.note}
        return Shown(
            text_of(cell.value, column.digits),
            cell.value if isinstance(cell.value, int | float) else None,
            " ".join(name for name, there in marks.items() if there),
            notes.index(cell.note) + 1 if cell.note else 0,
            colors.get(cell.method, ""),
        )

    parts: dict[Kind, list[list[Shown]]] = {}
    for row in rows:
        cells = [shown(c, i, heads[i]) for i, c in enumerate(row.cells)]
        parts.setdefault(row.kind, []).append(cells)
    return Section(
        table.name,
        table.title,
        [Shown(column.name, color=colors.get(column.method, "")) for column in heads],
        numeric,
        [Part(kind, headings.get(kind, ""), own) for kind, own in parts.items()],
        notes,
    )
