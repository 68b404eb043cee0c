"""Tables as Markdown, CSV, JSON and LaTeX."""

import csv
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path

import jinja2
import markupsafe

from unips_jax.evaluation.summary import Cell, Table

TEMPLATES = Path(__file__).with_name("templates")

_LATEX = {
    **{c: "\\" + c for c in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"$<$",
    ">": r"$>$",
}


def text_of(cell: Cell) -> str:
    """A cell as shown: two digits after the point, a dash for nothing."""
    if cell is None:
        return "–"
    return f"{cell:.2f}" if isinstance(cell, float) else str(cell)


def environment(*, html: bool = False) -> jinja2.Environment:
    """The templates, with a filter for cells.

    Args:
        html: escape what is filled in.
    """
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=html,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["cell"] = text_of
    made.filters["latex"] = _latex
    made.filters["breakable"] = _breakable
    made.filters["markdown"] = lambda text: text.replace("|", r"\|")
    return made


def files_of(tables: Sequence[Table]) -> dict[str, bytes]:
    """All tables in all formats.

    Returns:
        Contents by file name: `tables.md`, `tables.tex`, `tables.json`, and one CSV per
        table.
    """
    templates = environment()
    made = {
        f"tables.{kind}": templates.get_template(f"tables.{kind}.j2").render(
            tables=tables
        )
        for kind in ("md", "tex")
    }
    content = {table.name: table._asdict() for table in tables}
    made["tables.json"] = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    made |= {f"{table.name}.csv": _csv(table) for table in tables}
    return {name: text.encode() for name, text in made.items()}


def _csv(table: Table) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(table.columns)
    for row in table.rows:
        writer.writerow(
            "" if c is None else f"{c:.4f}" if isinstance(c, float) else c for c in row
        )
    return buffer.getvalue()


def _breakable(text: str) -> markupsafe.Markup:
    """A name for HTML, with places to break it where it is too long."""
    escaped = str(markupsafe.escape(text))
    return markupsafe.Markup(re.sub(r"([:,=_/])", r"\1<wbr>", escaped))


def _latex(text: str) -> str:
    return "".join(_LATEX.get(c, c) for c in text).replace("–", "--")
