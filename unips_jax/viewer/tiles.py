"""A result at full resolution, as tiles in a folder next to its page.

Level 0 has the result's own pixels, each further one half as many a side, down to where
the page's own pictures are as fine. A tile is a script that hands over a picture in a
`data:` address: pages opened from disk may load scripts, but not read pictures' pixels.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.io.door import write_whole
from unips_jax.viewer.layers import (
    View,
    encoded,
    jpeg,
    normals_as_bytes,
    png,
    shown_photographs,
    white_of,
)
from unips_jax.viewer.result import Result

SIZE = 512
BORDER = 1  # pixels of the neighbours, so that filtering shows no seams


def level_views(view: View) -> list[View]:
    """The part that the page shows, at each level; none if the page is as fine."""
    height = view.rows.stop - view.rows.start
    width = view.columns.stop - view.columns.start
    levels: list[View] = []
    while height > 1.2 * view.height or width > 1.2 * view.width:
        levels.append(View(view.rows, view.columns, width, height))
        height, width = -(-height // 2), -(-width // 2)
    return levels


def facts_of(view: View) -> dict[str, Any] | None:
    """What the page must know of the tiles; None if there are none."""
    levels = [
        {"width": level.width, "height": level.height} for level in level_views(view)
    ]
    return {"size": SIZE, "border": BORDER, "levels": levels} if levels else None


def write_tiles(folder: Path, result: Result, view: View) -> int:
    """Writes `LAYER-LEVEL-ROW-COLUMN.js` of all layers; returns their number."""
    count = 0
    levels = level_views(view)

    def write(layer: str, at: Callable[[View], np.ndarray], pack: Callable) -> None:
        nonlocal count
        for number, level in enumerate(levels):
            for place, part in _parts(at(level)):
                name = f"{layer}-{number}-{place}"
                script = f'unipsTile("{name}","{pack(part)}");\n'
                write_whole(folder / f"{name}.js", script.encode(), sync=False)
                count += 1

    write("normals", lambda level: normals_as_bytes(result, level), png)
    mean = _write_photographs(write, result, view)
    if result.base_color is not None:
        color, inside = result.base_color, result.inside
        write("color", lambda at: encoded(at.shrink_inside(color, inside)), jpeg)
    elif mean is not None:
        color = mean / white_of(view.shrink(mean), view.shrink(result.inside) > 0.5)
        write("color", lambda level: encoded(level.shrink(color)), jpeg)
    return count


def _write_photographs(
    write: Callable, result: Result, view: View
) -> np.ndarray | None:
    """Writes those that the page has; the mean of all, linear, if it is needed."""
    shown = shown_photographs(len(result.photographs))
    inside = view.shrink(result.inside) > 0.5
    mean = None
    for index, photograph in enumerate(result.photographs):
        if result.base_color is not None and index not in shown:
            continue
        linear = photograph.read()
        if photograph.bright:
            linear = linear / white_of(view.shrink(linear), inside)
        if result.base_color is None:
            share = linear / len(result.photographs)
            mean = share if mean is None else mean + share
        if index in shown:
            name = f"photograph-{shown.index(index)}"

            def at(level: View, pixels: np.ndarray = linear) -> np.ndarray:
                return encoded(level.shrink(pixels))

            write(name, at, jpeg)
    return mean


def _parts(pixels: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    height, width = pixels.shape[:2]
    for top in range(0, height, SIZE):
        for left in range(0, width, SIZE):
            rows = slice(max(top - BORDER, 0), top + SIZE + BORDER)
            columns = slice(max(left - BORDER, 0), left + SIZE + BORDER)
            yield f"{top // SIZE}-{left // SIZE}", pixels[rows, columns]
