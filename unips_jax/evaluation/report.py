"""The report: one HTML file that needs nothing else, not even a network."""

import base64
import json
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.evaluation import charts
from unips_jax.evaluation.protocols import Case
from unips_jax.evaluation.scores import error_map
from unips_jax.evaluation.sheets import Panel
from unips_jax.evaluation.summary import Cell, Results, Table
from unips_jax.evaluation.tables import TEMPLATES, environment
from unips_jax.pictures.maps import error_picture, frame, normals_picture, shrink

_PICTURE_LIMIT = 320
_QUALITY = 88


class Exhibit(NamedTuple):
    """An object's pictures, ready for the page.

    Attributes:
        name: the entry's.
        caption: a line on it.
        sheet: its sheet as a data URI.
        truth: the true normals as a data URI; empty where withheld.
        estimates: per method that ran: label, normals and errors as data URIs (errors
            empty where the truth is withheld), and a line with its scores.
    """

    name: str
    caption: str
    sheet: str
    truth: str
    estimates: Sequence[tuple[str, str, str, str]]


def exhibit(
    name: str,
    caption: str,
    sheet_png: bytes,
    case: Case,
    panels: Sequence[Panel],
) -> Exhibit:
    """Packs an object's pictures.

    Args:
        name: the entry's.
        caption: a line on it.
        sheet_png: its sheet.
        case: what the methods were given.
        panels: the methods.
    """
    window = frame(case.observed.mask)

    def pack(picture: np.ndarray) -> str:
        return _webp(shrink(picture[window], _PICTURE_LIMIT))

    estimates = []
    for panel in panels:
        if panel.normals is None:
            continue
        errors, line = "", "truth withheld"
        if case.normals is not None and panel.mae is not None:
            degrees = error_map(panel.normals, case.normals)
            errors = pack(error_picture(degrees, case.observed.mask))
            median = float(np.median(degrees[case.observed.mask]))
            line = f"mean error {panel.mae:.2f}°, median {median:.2f}°"
        normals = pack(normals_picture(panel.normals, case.observed.mask))
        estimates.append((panel.label, normals, errors, line))
    truth = ""
    if case.normals is not None:
        truth = pack(normals_picture(case.normals, case.observed.mask))
    decoded = cv2.imdecode(np.frombuffer(sheet_png, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None  # written by `sheet`
    return Exhibit(name, caption, _webp(decoded[..., ::-1]), truth, estimates)


def report(
    results: Results, tables: Sequence[Table], exhibits: Sequence[Exhibit]
) -> bytes:
    """Writes the page.

    Args:
        results: of the run.
        tables: as `summary.tables` makes them.
        exhibits: the objects' pictures; may be empty.

    Returns:
        HTML.
    """
    pictures = [
        {
            "name": exhibit.name,
            "truth": exhibit.truth,
            "estimates": [
                dict(zip(("label", "normals", "errors", "line"), estimate, strict=True))
                for estimate in exhibit.estimates
            ],
        }
        for exhibit in exhibits
        if exhibit.truth
    ]
    template = environment(html=True).get_template("report.html.j2")
    text = template.render(
        results=results,
        tables=[(table, _best(table, results), _numeric(table)) for table in tables],
        charts=_charts(results),
        exhibits=exhibits,
        # "<" must not close the script element that holds the JSON.
        pictures=json.dumps(pictures).replace("<", "\\u003c"),
        style=(TEMPLATES / "report.css").read_text(encoding="utf-8"),
        script=(TEMPLATES / "report.js").read_text(encoding="utf-8"),
    )
    return text.encode()


def _charts(results: Results) -> list[tuple[str, str]]:
    """Titles and data URIs of the charts that there is data for."""
    drawn = [("How large are the errors?", charts.error_histogram(results))]
    for lighting in results.lightings or (None,):
        title = "Mean error against the number of images"
        title += f", {lighting}" if lighting else ""
        drawn.append((title, charts.images_chart(results, lighting)))
    return [(title, _uri("image/svg+xml", svg)) for title, svg in drawn if svg]


def _best(table: Table, results: Results) -> set[tuple[int, int]]:
    """Cells to show in bold: the lowest of a row, or of a column in the summary.

    Means over different objects do not compare: methods that lack some are left out.
    """
    best = set()
    if table.name == "summary":
        own = [r for r, row in enumerate(table.rows) if row[2] == "this run"]
        for c, heading in enumerate(table.columns):
            lit = {"lighting": heading} if heading in results.lightings else {}
            complete = _complete(results, lit)
            known = [
                (_number(table.rows[r][c]), r)
                for r in own
                if table.rows[r][0] in complete
            ]
            values = [(v, r) for v, r in known if v is not None]
            if values:
                pick = max if heading.startswith("%") else min
                best |= {(r, c) for v, r in values if v == pick(values)[0]}
    elif table.name in ("objects", "categories", "views", "angles"):
        for r, row in enumerate(table.rows):
            mean = table.name != "objects" or row[0] == "mean"
            picked = _complete(results, _tags(table, row)) if mean else results.labels
            known = [
                (_number(row[c]), c)
                for c, name in enumerate(table.columns)
                if name in picked
            ]
            values = [(v, c) for v, c in known if v is not None]
            if len(values) > 1:
                best |= {(r, c) for v, c in values if v == min(values)[0]}
    return best


def _tags(table: Table, row: Sequence[Cell]) -> dict[str, Cell]:
    """What the objects have in common that a row of means is over."""
    tag = {"categories": "category", "views": "view"}.get(table.name)
    if tag is None:
        return {}
    lit = {"lighting": row[1]} if "Lighting" in table.columns else {}
    return {tag: row[0], **lit}


def _complete(results: Results, tags: Mapping[str, Cell]) -> set[str]:
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


def _webp(picture: np.ndarray) -> str:
    bgr = np.ascontiguousarray(picture[..., ::-1])
    data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1]
    return _uri("image/webp", data.tobytes())


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
