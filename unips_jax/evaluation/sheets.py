"""One sheet per object, as in the paper's supplement (Figures 3-52).

First some of the photographs, then the true normals and each method's, and under them
the error maps with their mean, clipped at 80 degrees.
"""

import io
import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from unips_jax.evaluation.protocols import Case
from unips_jax.evaluation.scores import error_map
from unips_jax.pictures.fonts import drawable, shorten, text_width
from unips_jax.pictures.maps import (
    COLOURS,
    ERROR_LIMIT_DEG,
    error_picture,
    frame,
    normals_picture,
    photograph_picture,
    shrink,
)

_CELL = 1.6
_GAP = 0.08
_LABEL = 0.28
_DPI = 160
_LEAST, _MOST = 5, 7
_LETTERS = 10  # of a title, per inch
_INK = "#1c2330"
_SOFT = "#667085"


class Panel(NamedTuple):
    """One method on one object."""

    label: str
    normals: np.ndarray | None  # `[h, w, 3]`; None where the method could not run
    mae: float | None  # in degrees; None where there is no truth
    unsupported: str = ""  # why the method could not run; empty where it did


def sheet(title: str, case: Case, panels: Sequence[Panel]) -> bytes:
    """Draws an object's sheet, with the methods in order, as a PNG."""
    columns = min(max(len(panels) + 1, _LEAST), _MOST)
    blocks = _blocks(panels, columns)
    width = columns * _CELL + (columns + 1) * _GAP
    heights = [0.42, _CELL + _LABEL] + [2 * (_CELL + _LABEL)] * len(blocks)
    figure = Figure(figsize=(width, sum(heights) + _GAP), dpi=_DPI, facecolor="white")
    title, families = drawable(shorten(title, int(width * _LETTERS)))
    figure.text(
        _GAP / width,
        1 - 0.25 / figure.get_figheight(),
        title,
        fontfamily=families,
        fontsize=10,
        fontweight="bold",
        color=_INK,
        va="center",
        parse_math=False,
    )
    canvas = _Canvas(figure, frame(case.observed.mask))
    top = heights[0]
    _inputs(canvas, case, top, columns)
    top += heights[1]
    for block in blocks:
        _block(canvas, case, block, top)
        top += 2 * (_CELL + _LABEL)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


class _Canvas:
    """Places pictures on a figure by column and by inches from the top."""

    def __init__(self, figure: Figure, window: tuple[slice, slice]):
        self.figure = figure
        self.window = window

    def axes(self, column: int, top: float) -> Axes:
        width, height = self.figure.get_size_inches()
        left = _GAP + column * (_CELL + _GAP)
        axes = self.figure.add_axes(
            (
                left / width,
                1 - (top + _LABEL + _CELL) / height,
                _CELL / width,
                _CELL / height,
            )
        )
        axes.set_axis_off()
        return axes

    def show(
        self,
        picture: np.ndarray,
        text: str,
        column: int,
        top: float,
        soft: bool = False,
    ) -> None:
        axes = self.axes(column, top)
        small = shrink(picture[self.window], int(_CELL * _DPI))
        axes.imshow(small, interpolation="nearest")
        self.caption(axes, text, soft)

    @staticmethod
    def caption(axes: Axes, text: str, soft: bool = False) -> None:
        text, families = drawable(shorten(text, 38))
        wide = text_width(text)
        axes.text(
            0.5,
            1.02,
            text,
            transform=axes.transAxes,
            ha="center",
            va="bottom",
            fontfamily=families,
            fontsize=7.5 if wide < 26 else 6 if wide < 32 else 5,
            color=_SOFT if soft else _INK,
            parse_math=False,
        )


def _blocks(panels: Sequence[Panel], columns: int) -> list[list[Panel | None]]:
    """Rows of panels; None stands for the truth, which opens the first."""
    cells: list[Panel | None] = [None, *panels]
    return [cells[i : i + columns] for i in range(0, len(cells), columns)]


def _inputs(canvas: _Canvas, case: Case, top: float, columns: int) -> None:
    count = len(case.observed.images)
    shown = np.unique(
        np.linspace(0, count - 1, min(count, columns)).round().astype(int)
    )
    for column, i in enumerate(shown):
        picture = photograph_picture(case.observed.images[i], case.observed.mask)
        canvas.show(picture, f"image {i + 1} of {count}", column, top, soft=True)


def _block(
    canvas: _Canvas, case: Case, block: Sequence[Panel | None], top: float
) -> None:
    below = top + _CELL + _LABEL
    for column, panel in enumerate(block):
        if panel is None:
            if case.normals is not None:
                picture = normals_picture(case.normals, case.observed.mask)
                canvas.show(picture, "true normals", column, top)
                _scale(canvas, column, below)
            else:
                canvas.caption(canvas.axes(column, top), "truth withheld", soft=True)
            continue
        if panel.normals is None:
            canvas.caption(canvas.axes(column, top), panel.label)
            axes = canvas.axes(column, top)
            reason = textwrap.fill(f"unsupported: {panel.unsupported}", 27)
            axes.text(
                0.5,
                0.5,
                reason,
                ha="center",
                va="center",
                color=_SOFT,
                fontsize=6,
                parse_math=False,
            )
            continue
        canvas.show(
            normals_picture(panel.normals, case.observed.mask), panel.label, column, top
        )
        if case.normals is not None and panel.mae is not None:
            errors = error_map(panel.normals, case.normals)
            picture = error_picture(errors, case.observed.mask)
            canvas.show(picture, f"{panel.mae:.2f}°", column, below)


def _scale(canvas: _Canvas, column: int, top: float) -> None:
    """The colour bar of the error maps, under the truth."""
    axes = canvas.axes(column, top)
    inset = axes.inset_axes((0.42, 0.06, 0.1, 0.86))
    mappable = ScalarMappable(
        Normalize(0, ERROR_LIMIT_DEG), matplotlib.colormaps[COLOURS]
    )
    bar = canvas.figure.colorbar(mappable, cax=inset, ticks=[0, 20, 40, 60, 80])
    bar.set_ticklabels(["0°", "20°", "40°", "60°", "80°+"])
    bar.ax.tick_params(labelsize=7, colors=_SOFT, length=2)
    bar.outline.set_linewidth(0)  # type: ignore[operator]
    axes.text(
        0.3,
        0.49,
        "angular error",
        rotation=90,
        ha="center",
        va="center",
        fontsize=7.5,
        color=_SOFT,
    )
