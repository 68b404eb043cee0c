"""The report: one HTML file that needs nothing else, not even a network."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.evaluation.cells import Table
from unips_jax.evaluation.charts import charts
from unips_jax.evaluation.protocols import Case
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.scores import error_map
from unips_jax.evaluation.sections import sections
from unips_jax.evaluation.sheets import Panel
from unips_jax.evaluation.summary import turned_axes
from unips_jax.evaluation.tables import TEMPLATES, environment
from unips_jax.pictures.maps import error_picture, frame, normals_picture, shrink

_PICTURE_LIMIT = 320
_QUALITY = 88


class Header(NamedTuple):
    """Where a report comes from."""

    date: str
    data: str  # what was evaluated on, with a hash
    command: str  # what was typed
    version: str  # this program's, with a hash of its code
    weights: Mapping[str, str]  # hashes of the weights, by method


class Exhibit(NamedTuple):
    """An object's pictures, ready for the page; empty where the truth is withheld."""

    name: str
    caption: str  # a line on it
    sheet: str  # a data URI, as all pictures here
    truth: str  # the true normals
    # of each method that ran: label, normals, errors, and a line with its scores
    estimates: Sequence[tuple[str, str, str, str]]


def exhibit(
    name: str, caption: str, sheet_png: bytes, case: Case, panels: Sequence[Panel]
) -> Exhibit:
    """Packs an object's pictures."""
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
    header: Header,
    results: Results,
    tables: Sequence[Table],
    exhibits: Sequence[Exhibit],
) -> bytes:
    """Writes the page: HTML, with the tables that `summary.tables` makes."""
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
        if exhibit.truth and exhibit.estimates
    ]
    template = environment(html=True).get_template("report.html.j2")
    text = template.render(
        header=header,
        results=results,
        sections=sections(results, tables),
        charts=[
            (chart.title, _inline(chart.svg, f"chart-{i}"), chart.legend)
            for i, chart in enumerate(charts(results))
        ],
        exhibits=exhibits,
        warnings=[f"{k}: {line}" for k, line in turned_axes(results).items()],
        # "<" must not close the script element that holds the JSON.
        pictures=json.dumps(pictures).replace("<", "\\u003c"),
        style=(TEMPLATES / "report.css").read_text(encoding="utf-8"),
        script=(TEMPLATES / "report.js").read_text(encoding="utf-8"),
    )
    return text.encode()


def _inline(svg: bytes, name: str) -> str:
    """A drawing for the page's own text, with names that no other drawing has."""
    text = svg.decode()
    text = text[text.index("<svg") :]
    text = re.sub("<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    return re.sub(r'(url\(#|href="#)', rf"\g<1>{name}-", text)


def _webp(picture: np.ndarray) -> str:
    bgr = np.ascontiguousarray(picture[..., ::-1])
    data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1]
    return _uri("image/webp", data.tobytes())


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
