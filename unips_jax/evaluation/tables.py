"""Tables as Markdown, CSV, JSON and LaTeX."""

import csv
import io
import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import jinja2
import markupsafe

from unips_jax.evaluation.cells import Table, Value

TEMPLATES = Path(__file__).with_name("templates")

_LATEX = {
    **{c: "\\" + c for c in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"$<$",
    ">": r"$>$",
}


def environment(*, html: bool = False) -> jinja2.Environment:
    """The templates; `html`: what is filled in is escaped."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=html,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["latex"] = _latex
    made.filters["breakable"] = _breakable
    made.filters["markdown"] = lambda text: text.replace("|", r"\|")
    return made


def files_of(tables: Sequence[Table]) -> dict[str, bytes]:
    """Contents by file name: all tables as Markdown, LaTeX and JSON, a CSV for each."""
    templates = environment()
    made = {
        f"tables.{kind}": templates.get_template(f"tables.{kind}.j2").render(
            tables=tables
        )
        for kind in ("md", "tex")
    }
    content = {
        table.name: {
            "name": table.name,
            "title": table.title,
            "columns": table.names,
            "rows": table.values,
        }
        for table in tables
    }
    made["tables.json"] = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    made |= {f"{table.name}.csv": _csv(table) for table in tables}
    return {name: text.encode() for name, text in made.items()}


def _csv(table: Table) -> str:
    return csv_text(
        table.names,
        [
            [f"{v:.4f}" if isinstance(v, float) else v for v in row]
            for row in table.values
        ],
    )


def csv_text(names: Sequence[str], rows: Iterable[Sequence[Value]]) -> str:
    """Rows as CSV; None is an empty field."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(rows)
    return buffer.getvalue()


def _breakable(text: str) -> markupsafe.Markup:
    """A name for HTML, with places to break it where it is too long."""
    escaped = str(markupsafe.escape(text))
    return markupsafe.Markup(re.sub(r"([:,=_/])", r"\1<wbr>", escaped))


def _latex(text: str) -> str:
    return "".join(_LATEX.get(c, c) for c in text).replace("–", "--")
