"""Whether the axes of an estimate seem turned: found by its score, and named."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from unips_jax.evaluation.scores import error_map

# Signs of x, y, z after taking them in this order.
Axes = tuple[tuple[int, int, int], tuple[int, int, int]]
_OURS: Axes = ((1, 1, 1), (0, 1, 2))
# What one does by mistake.
_TURNS: tuple[Axes, ...] = (
    ((-1, 1, 1), (0, 1, 2)),
    ((1, -1, 1), (0, 1, 2)),
    ((1, 1, -1), (0, 1, 2)),
    ((1, -1, -1), (0, 1, 2)),
    ((-1, -1, 1), (0, 1, 2)),
    ((1, 1, 1), (2, 1, 0)),
)
# What options of `files:DIR` mean.
_MEANINGS = {
    "": "x points right, y up and z to the viewer",
    "x=left": "x points to the left",
    "y=down": "y points down",
    "z=away": "z points away from the viewer",
    "y=down,z=away": "y points down and z away, as in OpenCV",
    "x=left,y=down": "x and y are both reversed, concave for convex",
    "channels=bgr": "the channels stand in the order z, y, x",
}
_DECIDING = 0.2  # a correlation
_LEAST_GAIN_DEG, _LARGEST_SHARE, _AGREEING = 5.0, 0.7, 0.75


class Turned(NamedTuple):
    """The axes that seem turned."""

    options: str  # of `files:DIR` that state them, all that are needed
    as_given: float  # mean error of the normals as they are, in degrees
    turned: float  # mean error with the axes turned

    @property
    def remark(self) -> str:
        """One line for the reader of a report."""
        each = " and ".join(_MEANINGS[option] for option in self.options.split(","))
        meaning = _MEANINGS.get(self.options, each)
        stated = f"files:DIR,{self.options}" if self.options else "files:DIR alone"
        return (
            f"it seems that {meaning}: {self.turned:.1f} degrees when turned, "
            f"{self.as_given:.1f} as given (of files, {stated} says so)"
        )


def misfit(integrabilities: Sequence[float]) -> str:
    """A line on a method whose objects' slopes do not fit together, else empty."""
    decided = [x for x in integrabilities if abs(x) > _DECIDING]
    if not decided or sum(x < 0 for x in decided) < _AGREEING * len(decided):
        return ""
    mean = sum(decided) / len(decided)
    return (
        "slopes do not fit together as a surface's do (correlation "
        f"{mean:+.2f}): an axis seems to be the other way, x or y"
    )


def errors_if_turned(
    normals: np.ndarray, true: np.ndarray, mask: np.ndarray, stated: Axes = _OURS
) -> dict[str, float]:
    """Mean angular errors, in degrees, of normals `[H, W, 3]` with axes turned.

    `stated` are the axes by which they were read, if from a file. Each error is named
    by the options of `files:DIR` that state what was stated, but for the turn.
    """
    before, order = np.array(stated[0], np.float32), stated[1]
    inside, known = normals[mask] * before, true[mask]
    errors = {}
    for turn, places in _TURNS:
        signs = before * np.array(turn, np.float32)
        words = zip(("x=left", "y=down", "z=away"), signs, strict=True)
        options = [word for word, sign in words if sign < 0]
        options += ["channels=bgr"] * (places != order)
        error = error_map(inside[:, places] * signs, known).mean()
        errors[",".join(options)] = float(error)
    return errors


def find_turned(pairs: Sequence[tuple[float, Mapping[str, Any]]]) -> Turned | None:
    """What would make most objects much better; None where nothing would.

    `pairs` are each object's mean error and those of `errors_if_turned`.
    """
    if not pairs:
        return None
    given = np.array([mae for mae, _ in pairs])
    best: Turned | None = None
    for options in pairs[0][1]:
        turned = np.array([errors[options] for _, errors in pairs])
        gain = given.mean() - turned.mean()
        certain = (
            gain > _LEAST_GAIN_DEG
            and turned.mean() < _LARGEST_SHARE * given.mean()
            and (turned < given).mean() >= _AGREEING
        )
        if certain and (best is None or turned.mean() < best.turned):
            best = Turned(options, float(given.mean()), float(turned.mean()))
    return best
