"""The report's charts, as SVG that is the same text every time."""

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unips_jax.evaluation.published import PUBLISHED
from unips_jax.evaluation.summary import Results
from unips_jax.pictures.maps import ERROR_LIMIT_DEG

_INK = "#1c2330"
_SOFT = "#667085"
_GRID = "#e4e7ec"
_STYLES = ("-", "--", ":", "-.")


def error_histogram(results: Results) -> bytes:
    """Share of the pixels per degree of error, all objects together.

    Returns:
        An SVG; empty if nothing was scored.
    """
    figure, axes = _figure()
    drawn = False
    for i, label in enumerate(results.labels):
        own = results.of(label, results.main_count)
        counts = [result.score.histogram for result in own if result.score]
        if not counts:
            continue
        drawn = True
        total = np.sum(counts, axis=0)
        # Smooth over 2 degrees: single degrees of few pixels only make noise.
        share = 100 * np.convolve(total, [0.25, 0.5, 0.25], "same") / total.sum()
        degrees = np.arange(len(share)) + 0.5
        shown = degrees < ERROR_LIMIT_DEG
        axes.plot(degrees[shown], share[shown], label=label, **_line(i))
    axes.set_xlim(0, ERROR_LIMIT_DEG)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("angular error (degrees)")
    axes.set_ylabel("pixels (% per degree)")
    return _svg(figure, axes) if drawn else b""


def images_chart(results: Results, lighting: str | None) -> bytes:
    """Mean angular error against the number of images.

    Args:
        results: of a run.
        lighting: one of the run's, or None for all objects.

    Returns:
        An SVG; empty where there are not two numbers of images.
    """
    figure, axes = _figure()
    drawn = False
    for i, label in enumerate(results.labels):
        points = [_point(results, label, count, lighting) for count in results.counts]
        known = sorted(point for point in points if point is not None)
        if len({number for number, _ in known}) < 2:
            continue
        drawn = True
        axes.plot(*zip(*known, strict=True), label=label, marker="o", **_line(i))
    rows = [
        row
        for row in PUBLISHED.get(results.benchmark, ())
        if row.group == "images" and lighting in row.scores
    ]
    if drawn and rows and lighting is not None:
        axes.plot(
            [row.images or 0 for row in rows],
            [row.scores[lighting] for row in rows],
            label="UniPS (published)",
            color="#98a2b3",
            linestyle=(0, (1, 1.5)),
            marker="s",
            markersize=3,
        )
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_formatter(lambda value, position: f"{value:g}")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("images")
    axes.set_ylabel("mean angular error (degrees)")
    return _svg(figure, axes) if drawn else b""


def _point(
    results: Results, label: str, count: int | None, lighting: str | None
) -> tuple[float, float] | None:
    own = [
        result
        for result in results.of(label, count)
        if result.score and lighting in (None, result.tags.get("lighting"))
    ]
    if not own:
        return None
    errors = [result.score.mae for result in own if result.score]
    numbers = [result.images for result in own]
    return sum(numbers) / len(numbers), sum(errors) / len(errors)


def _line(i: int) -> dict[str, Any]:
    colours = matplotlib.color_sequences["tab10"]
    return {
        "color": colours[i % 10],
        "linestyle": _STYLES[i // 10 % len(_STYLES)],
        "linewidth": 1.6,
        "markersize": 4,
    }


def _figure() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_SOFT)
    axes.tick_params(colors=_SOFT, labelsize=8)
    axes.grid(color=_GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=_INK, fontsize=9)
    return figure, axes


def _svg(figure: Figure, axes: Axes) -> bytes:
    axes.legend(
        frameon=False,
        fontsize=8,
        labelcolor=_INK,
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
    )
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "unips_jax"}):
        metadata = {"Date": None, "Creator": None}
        figure.savefig(buffer, format="svg", metadata=metadata, transparent=True)
    return buffer.getvalue()
