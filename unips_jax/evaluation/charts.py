"""The report's charts, as SVG that is the same text every time.

They hold no names: the page's legend finds the lines by `line-0`, `line-1`, ...
"""

import io
from collections.abc import Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from unips_jax.evaluation import published
from unips_jax.evaluation.results import Results, average, lit, mean_error
from unips_jax.evaluation.spread import deviation, errors_by_object
from unips_jax.evaluation.statistics import interval
from unips_jax.evaluation.styles import PUBLISHED, Style, styles
from unips_jax.pictures.maps import ERROR_LIMIT_DEG

_INK = "#1c2330"
_SOFT = "#667085"
_GRID = "#e4e7ec"


class Chart(NamedTuple):
    """A drawing, with the name and style of each line, in order."""

    title: str
    svg: bytes
    legend: Sequence[tuple[str, Style]]


def charts(results: Results) -> list[Chart]:
    """All charts that a run has data for."""
    drawn = [_error_chart(results), _interval_chart(results)]
    drawn += [_images_chart(results, name) for name in results.lightings or (None,)]
    return [chart for chart in drawn if chart.legend]


def _error_chart(results: Results) -> Chart:
    """Share of the pixels below an error; rising curves cover each other least."""
    figure, axes = _figure()
    legend: list[tuple[str, Style]] = []
    for label, style in styles(results.labels).items():
        own = results.of(label, results.main_count)
        counts = [result.score.histogram for result in own if result.score]
        if not counts:
            continue
        total = np.sum(counts, axis=0)
        share = 100 * np.cumsum(total) / total.sum()
        shown = np.append(0, share[: int(ERROR_LIMIT_DEG)])
        _draw(axes, range(len(shown)), shown, style, len(legend))
        some = "" if len(counts) == len(own) else f" ({len(counts)} of {len(own)})"
        legend.append((label + some, style))
    axes.set_xlim(0, ERROR_LIMIT_DEG)
    axes.set_ylim(0, 100)
    axes.set_xlabel("angular error (degrees)")
    axes.set_ylabel("pixels below it (%)")
    return Chart("How many pixels are below an error?", _svg(figure), legend)


def _interval_chart(results: Results) -> Chart:
    """A row for each method: its objects, their mean, and its 95 % interval."""
    figure, axes = _figure()
    legend: list[tuple[str, Style]] = []
    for label, style in styles(results.labels).items():
        errors = errors_by_object(results, label, results.main_count)
        objects = {name: list(own.values()) for name, own in errors.items()}
        ends = interval(objects)
        if ends is None:
            continue
        entries = [x for own in objects.values() for x in own]
        mean, row = sum(entries) / len(entries), -len(legend)
        means = [sum(own) / len(own) for own in objects.values()]
        # One path, so that the legend hides all of it: dots, interval, mean.
        x = [v for dot in means for v in (dot, np.nan)]
        x += [*ends, np.nan, mean, mean]
        y = [row] * (len(x) - 2) + [row - 0.28, row + 0.28]
        plain = style._replace(dashes="", width=2.0)
        dots = slice(0, 2 * len(means), 2)
        _draw(axes, x, y, plain, len(legend), marker="o", markevery=dots)
        legend.append((label, plain))
    axes.set_ylim(0.6 - max(len(legend), 1), 0.6)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.set_xlim(left=0)
    axes.set_xlabel("mean angular error (degrees)")
    title = "Every object, their mean, and its 95 % interval, method by method"
    return Chart(title, _svg(figure) if legend else b"", legend)


def _images_chart(results: Results, lighting: str | None) -> Chart:
    """Mean angular error against the number of images, under one lighting or all."""
    figure, axes = _figure()
    legend: list[tuple[str, Style]] = []
    ticks: set[float] = set()
    for label, style in styles(results.labels).items():
        points = [_point(results, label, count, lighting) for count in results.counts]
        known = sorted(point for point in points if point is not None)
        if len({images for images, *_ in known}) < 2:
            continue
        ticks |= {images for images, *_ in known}
        x, y, bars = zip(*known, strict=True)
        _draw(axes, x, y, style, len(legend), marker="o", bars=bars)
        legend.append((label, style))
    rows = [
        row
        for row in published.PUBLISHED.get(results.benchmark, ())
        if row.group == "images" and lighting in row.scores
    ]
    if legend and rows and lighting is not None:
        numbers = [row.images or 0 for row in rows]
        scores = [row.scores[lighting] for row in rows]
        style = Style(PUBLISHED, "1 1.5", 1.3)
        _draw(axes, numbers, scores, style, len(legend), marker="s")
        legend.append(("UniPS (published, other objects)", style))
        ticks |= set(numbers)
    axes.set_xscale("log", base=2)
    axes.set_xticks(sorted(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda value, position: f"{value:.4g}")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("images")
    axes.set_ylabel("mean angular error (degrees)")
    title = "Mean error against the number of images"
    title += f", {lighting}" if lighting else ""
    return Chart(title, _svg(figure) if legend else b"", legend)


def _point(
    results: Results, label: str, count: int | None, lighting: str | None
) -> tuple[float, float, float] | None:
    """Mean number of images, mean error, and its deviation over seeds."""
    own = [result for result in lit(results.of(label, count), lighting) if result.score]
    images = average(result.images for result in own)
    error = mean_error(own)
    if images is None or error is None:
        return None
    return images, error, deviation(results, label, count, lighting) or 0.0


def _draw(
    axes: Axes,
    x: Sequence[float],
    y: Sequence[float] | np.ndarray,
    style: Style,
    i: int,
    marker: str = "",
    bars: Sequence[float] = (),
    markevery: slice | None = None,
) -> None:
    """A line, and bars of half these lengths in the same path: one name, one switch."""
    points = len(x)
    x, y = list(x), list(y)
    for place, middle, half in zip(x[:points], y[:points], bars, strict=False):
        x += [np.nan, place, place] if half else []
        y += [np.nan, middle - half, middle + half] if half else []
    (line,) = axes.plot(
        x,
        y,
        color=style.color,
        linewidth=style.width,
        marker=marker,
        markersize=4,
        markevery=markevery or slice(0, points),
    )
    if style.dashes:
        line.set_dashes([float(length) for length in style.dashes.split()])
    line.set_gid(f"line-{i}")


def _figure() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(5.4, 3.4), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_SOFT)
    axes.tick_params(colors=_SOFT, labelsize=9)
    axes.grid(color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=_INK, fontsize=10)
    return figure, axes


def _svg(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "unips_jax"}):
        metadata = {"Date": None, "Creator": None}
        figure.savefig(buffer, format="svg", metadata=metadata, transparent=True)
    return buffer.getvalue()
