"""The page: one HTML file that opens from disk and asks for nothing else.

With tiles it is a folder: the page as `index.html`, and full resolution in `tiles/`.
"""

import dataclasses
import html
import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np

from unips_jax.io.door import write_whole
from unips_jax.io.results import appearing_at_once, file_hash
from unips_jax.viewer import tiles
from unips_jax.viewer.layers import (
    View,
    color_of,
    layers_of,
    packed_photographs,
    photographs_as_pictures,
    view_of,
)
from unips_jax.viewer.result import Result

BUDGET = 6_000_000
"""Bytes that a page may have."""

_SIDES = (1024, 896, 768, 640, 512)
_PHOTOGRAPHS = 1_800_000
_LEAST_FOR_PHOTOGRAPHS = 400_000
_SCRIPTS = (
    "data shaders detail scale mesh tiles stage light measure notes save input main"
).split()
_TITLE = re.compile("<h1>(.*?)</h1>", re.S)
_NOTES = re.compile('(<script type="application/json" id="notes">)(.*?)</script>', re.S)
FOLDER_RECORD = "tiles.json"
"""By this file a folder of a page and its tiles is known."""


def write_view(path: Path, result: Result, *, earlier: Path | None = None) -> None:
    """Writes a result's page; notes in the one there, or in `earlier`, are kept."""
    notes = _notes_for(result, earlier or path)
    write_whole(path, page(result, notes=notes).encode())


def write_tiled_view(folder: Path, result: Result) -> int:
    """Writes a page and tiles of all pixels; returns how many, 0 if none are needed."""
    notes = _notes_for(result, folder / "index.html")
    with appearing_at_once(folder, record=FOLDER_RECORD) as place:
        text, view = _page(result, notes, tiled=True)
        write_whole(place / "index.html", text.encode())
        (place / "tiles").mkdir()
        count = tiles.write_tiles(place / "tiles", result, view)
        hashes = {"index.html": file_hash(place / "index.html")}
        record = {"files": hashes, "tiles": count}
        write_whole(place / FOLDER_RECORD, json.dumps(record).encode())
    return count


def _notes_for(result: Result, path: Path) -> dict[str, Any] | None:
    notes = notes_in(path)
    if notes and result.pixel_mm is not None:
        notes.pop("scale", None)  # the one that is given now holds
    return notes


def notes_in(path: Path) -> dict[str, Any] | None:
    """Notes, views and scale in a page; None if there is no page, or it has none."""
    try:
        found = _NOTES.search(path.read_text("utf-8"))
        notes = json.loads(found.group(2)) if found else None
    except (OSError, ValueError):
        return None
    return notes if isinstance(notes, dict) and notes else None


def shown_title(title: str) -> str:
    """A title as a page has it: folders' names may be of any encoding."""
    return title.encode(errors="replace").decode()


def title_in(path: Path) -> str | None:
    """The object that a page shows; None if there is no page."""
    try:
        found = _TITLE.search(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return html.unescape(found.group(1)) if found else None


def with_depth(result: Result) -> Result:
    """The result with a depth, integrated in the page's size if there is none."""
    if result.depth is not None:
        return result
    from unips_jax.surface.images import integrate_image

    view = view_of(result.inside, _SIDES[0])
    normals = view.shrink_inside(result.normals, result.inside)
    small = view.shrink(result.inside) > 0.5
    if not small.any():
        return result
    found = integrate_image(normals, small)
    part = (view.rows, view.columns)
    size = result.inside[part].shape[::-1]
    depth = np.full(result.inside.shape, np.nan, np.float32)
    depth[part] = cv2.resize(found.depth, size, interpolation=cv2.INTER_NEAREST)
    depth[~result.inside] = np.nan
    return dataclasses.replace(
        result, depth=depth * np.float32(view.scale), unit="pixels", pixel_size=1.0
    )


def page(result: Result, *, notes: dict[str, Any] | None = None) -> str:
    """The page's HTML, of at most 6 MB, with `notes_in` of an earlier page."""
    return _page(result, notes)[0]


def _page(
    result: Result, notes: dict[str, Any] | None, *, tiled: bool = False
) -> tuple[str, View]:
    for side in _SIDES:  # noisy normals of the first may be too large
        view = view_of(result.inside, side)
        pictures, mean = photographs_as_pictures(
            result.photographs, view, result.inside
        )
        data = {
            **layers_of(result, view),
            "color": color_of(result, view, mean),
            "photographs": [],
            "environments": json.loads(_asset("environments.json")),
            "strings": json.loads(_asset("strings.json")),
            "facts": _facts(result, len(pictures)),
            "tiles": tiles.facts_of(view) if tiled else None,
        }
        room = BUDGET - len(_render(result.title, data, notes).encode())
        if room >= _LEAST_FOR_PHOTOGRAPHS:
            break
    budget = min(room - 1000 * len(pictures), _PHOTOGRAPHS)
    data["photographs"] = packed_photographs(pictures, budget)
    return _render(result.title, data, notes), view


def _render(title: str, data: dict[str, Any], notes: dict[str, Any] | None) -> str:
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_asset),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("page.html.j2").render(
        title=shown_title(title),
        strings=data["strings"],
        data=_json(data),
        notes=_json(notes or {}),
        tiled=data["tiles"] is not None,
        style=_asset("page.css"),
        three=_asset("three.min.js"),
        licence=_licence(),
        scripts=[_asset(f"{name}.js") for name in _SCRIPTS],
    )


def _json(value: Any) -> str:
    """For a script element, which only "<" could end, or begin a comment in."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def _asset(name: str) -> str:
    return (resources.files("unips_jax.viewer") / "assets" / name).read_text("utf-8")


def _licence() -> str:
    return (
        "unips_jax: Apache-2.0\n\n"
        "Environments: Poly Haven, CC0-1.0\n\n"
        f"three.js:\n{_asset('three.LICENSE')}"
    )


def _facts(result: Result, shown: int) -> list[list[Any]]:
    record = result.record
    height, width = result.normals.shape[:2]
    facts: list[list[Any]] = [["size", f"{width} x {height}"]]
    if record.get("images"):
        count = len(record["images"])
        text = str(count) if shown == count else f"{shown} / {count}"
        facts.append(["photographs", text])
    if record.get("weights"):
        weights = record["weights"]
        facts.append(["weights", f"{weights['name']} ({weights['hash'][:8]})"])
    if record.get("transfer"):
        rule = record.get("transfer_rule", "")
        facts.append(["transfer", f"{record['transfer']} ({rule})"])
    if record.get("surface"):
        facts.append(["camera", record["surface"].get("camera", "")])
    for key, name in (("date", "date"), ("version", "unips_jax")):
        if record.get(name):
            facts.append([key, str(record[name])])
    if record.get("warnings"):
        facts.append(["warnings", list(record["warnings"])])
    return facts
