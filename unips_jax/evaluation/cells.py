"""What tables are made of, before they are Markdown, CSV, JSON, LaTeX or HTML."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

Value = str | int | float | None
Kind = Literal["own", "published", "mean", "folded"]


class Cell(NamedTuple):
    """A value, and what the report shows with it."""

    value: Value  # None where there is nothing
    best: bool = False  # whether to set it in bold
    note: str = ""  # why there is no number
    method: str = ""  # the label of the method that it names; its colour marks it


class Row(NamedTuple):
    """A row; rows of a kind are sorted among themselves."""

    cells: Sequence[Cell]  # one for each column
    # of this run, published by others, the mean of the rows above, or folded: shown on
    # demand
    kind: Kind = "own"


class Column(NamedTuple):
    """A column."""

    name: str  # its heading
    method: str = ""  # the label of the method that it belongs to
    # False for what the report shows by headings between the rows
    in_report: bool = True
    digits: int = 2  # of its numbers, after the point, where people read them


class Table(NamedTuple):
    """A table."""

    name: str  # of its files
    title: str  # one line
    columns: Sequence[Column]  # from left to right
    rows: Sequence[Row]  # from top to bottom

    @property
    def names(self) -> list[str]:
        """The headings."""
        return [column.name for column in self.columns]

    @property
    def shown(self) -> list[list[str]]:
        """The values as people read them, row by row."""
        digits = [column.digits for column in self.columns]
        return [
            [text_of(cell.value, n) for cell, n in zip(row.cells, digits, strict=True)]
            for row in self.rows
        ]

    @property
    def values(self) -> list[list[Value]]:
        """The bare values, row by row."""
        return [[cell.value for cell in row.cells] for row in self.rows]


def text_of(value: Value, digits: int = 2) -> str:
    """A value as people read it: a dash for nothing."""
    if value is None:
        return "\N{EN DASH}"
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)


def columns(names: Iterable[str], labels: Iterable[str] = ()) -> list[Column]:
    """Columns of these names, and after them one for each method."""
    return [*map(Column, names), *(Column(label, method=label) for label in labels)]


def row(
    *values: Value, kind: Kind = "own", method: str = "", best: Iterable[int] = ()
) -> Row:
    """A row of bare values, one for each column.

    Cells of `best` are bold; `method` is the label of the method that the first one
    names.
    """
    best = set(best)
    cells = [Cell(value, i in best) for i, value in enumerate(values)]
    if method:
        cells[0] = cells[0]._replace(method=method)
    return Row(cells, kind)


def lowest(values: Mapping[int, Value]) -> set[int]:
    """Places of the lowest numbers; of none where there is nothing to compare."""
    known = {place: v for place, v in values.items() if isinstance(v, float)}
    least = min(known.values(), default=None)
    return {place for place, v in known.items() if len(known) > 1 and v == least}
