"""The page: one HTML file that opens from disk and asks for nothing else."""

import dataclasses
import json
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from unips_jax.io.claims import write_whole
from unips_jax.viewer.layers import (
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
_SCRIPTS = ("data", "shaders", "mesh", "stage", "light", "measure", "input", "main")


def write_view(path: Path, result: Result) -> None:
    """Writes a result's page.

    Raises:
        InputError: if a photograph cannot be read any more, or the file system refuses.
    """
    write_whole(path, page(result).encode())


def with_depth(result: Result) -> Result:
    """The result with a depth, integrated from the normals if there is none.

    In the size of the page, which is enough to look at.
    """
    if result.depth is not None:
        return result
    import cv2
    import numpy as np

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


def page(result: Result) -> str:
    """The page's HTML, of at most 6 MB."""
    html = ""
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
        }
        room = BUDGET - len(_render(result.title, data).encode())
        if room < _LEAST_FOR_PHOTOGRAPHS and side != _SIDES[-1]:
            continue
        budget = min(room - 1000 * len(pictures), _PHOTOGRAPHS)
        data["photographs"] = packed_photographs(pictures, budget)
        html = _render(result.title, data)
        break
    return html


def _render(title: str, data: dict[str, Any]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_asset),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    # Within a script element only "<" could end it, or begin a comment.
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    return environment.get_template("page.html.j2").render(
        title=title,
        strings=data["strings"],
        data=text,
        style=_asset("page.css"),
        three=_asset("three.min.js"),
        licence=_licence(),
        scripts=[_asset(f"{name}.js") for name in _SCRIPTS],
    )


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
