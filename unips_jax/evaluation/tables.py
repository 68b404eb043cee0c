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
from unips_jax.evaluation.figures import COLUMNS
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.scores import numbers_of

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


def figures_csv(results: Results) -> bytes:
    """Every number of a run, a row each; see `figures`."""
    rows: list[list[Value]] = []
    for result in results.results:
        tags = [result.tags.get(tag, "") for tag in ("object", "lighting", "view")]
        seed = -1 if result.seed is None else result.seed
        numbers = numbers_of(result.score) if result.score else {}
        for name, value in [*numbers.items(), *result.measures.items()]:
            head = [results.benchmark, *tags, result.label]
            rows.append([*head, result.images, seed, name, value])
    # All of an object's images may be as many as another number asked for.
    once = {tuple(row[:-1]): row for row in rows}
    return csv_text(COLUMNS, once.values()).encode()


def _breakable(text: str) -> markupsafe.Markup:
    """A name for HTML, with places to break it where it is too long."""
    escaped = str(markupsafe.escape(text))
    return markupsafe.Markup(re.sub(r"([:,=_/])", r"\1<wbr>", escaped))


def _latex(text: str) -> str:
    return "".join(_LATEX.get(c, c) for c in text).replace("–", "--")
