"""How each method is drawn: one colour wherever and whenever it appears."""

import zlib
from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.colors import to_hex, to_rgb

PUBLISHED = "#98a2b3"

COLORS = {
    "unips": "#1f5fd6",
    "gcnet": "#1e8f3e",
    "lcnet": "#0d7a6b",
    "ps-fcn": "#00a5c4",
    "mpm": "#7a4a2b",
    "variational": "#f06aa8",
    "woodham": "#f5820b",
    "least-squares": "#d6a400",
    "l1": "#a65300",
    "sbl": "#d92626",
    "rpca": "#7d0b33",
    "diffuse-maxima": "#9b6ddb",
    "entropy": "#54219e",
    "sh1": "#c21bb0",
    "hemisphere": "#6b7280",
    "constant": "#1c2330",
}
"""By the names of `registry.NAMES`."""

_DASHES = ("", "7 2", "2 1.5", "6 1.5 1.5 1.5", "10 2 2 2 2 2")
_SHADES = ((0, 0.0), (0, 0.5), (1, 0.5), (0, 0.7))  # towards black or white
_WIDEST, _THINNEST = 3.4, 1.3


class Style(NamedTuple):
    """A method's line."""

    # `#rrggbb`, for a name always the same; its variants are darker or lighter
    color: str
    dashes: str  # lengths of strokes and gaps in points, as in SVG; empty for none
    width: float  # in points. Later lines are thinner, so that they hide none below.


def styles(labels: Sequence[str]) -> dict[str, Style]:
    """The styles of a run's methods, in the order of drawing."""
    made: dict[str, Style] = {}
    seen: dict[str, int] = {}
    step = (_WIDEST - _THINNEST) / max(len(labels) - 1, 1)
    for i, label in enumerate(labels):
        name = _name(label)
        variant = seen.get(name, 0)
        seen[name] = variant + 1
        target, share = _SHADES[variant % len(_SHADES)]
        r, g, b = (x + share * (target - x) for x in to_rgb(_color(name)))
        dashes = _DASHES[variant % len(_DASHES)]
        made[label] = Style(to_hex((r, g, b)), dashes, _WIDEST - i * step)
    return made


def _name(label: str) -> str:
    """The method's name in its label: before weights, options and daggers."""
    return label.partition(":")[0].partition(" ")[0].rstrip("\N{DAGGER}")


def _color(name: str) -> str:
    every = list(COLORS.values())
    return COLORS.get(name, every[zlib.crc32(name.encode()) % len(every)])
