"""Whether the axes of an estimate seem turned: found by its score, and named."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from unips_jax.evaluation.scores import error_map

# What one does by mistake, as signs of x, y, z after taking them in this order.
_TURNS: dict[str, tuple[tuple[int, int, int], tuple[int, int, int]]] = {
    "x": ((-1, 1, 1), (0, 1, 2)),
    "y": ((1, -1, 1), (0, 1, 2)),
    "z": ((1, 1, -1), (0, 1, 2)),
    "y and z": ((1, -1, -1), (0, 1, 2)),
    "x and y": ((-1, -1, 1), (0, 1, 2)),
    "channels": ((1, 1, 1), (2, 1, 0)),
}
# What each would mean, and the options of `files:DIR` for it.
_MEANINGS = {
    "x": ("x points to the left", "x=left"),
    "y": ("y points down", "y=down"),
    "z": ("z points away from the viewer", "z=away"),
    "y and z": ("y points down and z away, as in OpenCV", "y=down,z=away"),
    "x and y": ("x and y are both reversed, concave for convex", "x=left,y=down"),
    "channels": ("the channels stand in the order z, y, x", "channels=bgr"),
}
_DECIDING = 0.2  # a correlation
_LEAST_GAIN_DEG, _LARGEST_SHARE, _AGREEING = 5.0, 0.7, 0.75


class Turned(NamedTuple):
    """The axes that seem turned."""

    meaning: str  # which, in words
    options: str  # of `files:DIR` that state it
    as_given: float  # mean error of the normals as they are, in degrees
    turned: float  # mean error with the axes turned

    @property
    def remark(self) -> str:
        """One line for the reader of a report."""
        return (
            f"it seems that {self.meaning}: {self.turned:.1f} degrees when turned, "
            f"{self.as_given:.1f} as given (files:DIR,{self.options} says so)"
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
    normals: np.ndarray, true: np.ndarray, mask: np.ndarray
) -> dict[str, float]:
    """Mean angular errors, in degrees, of normals `[H, W, 3]` with axes turned."""
    inside, known = normals[mask], true[mask]
    return {
        name: float(
            error_map(inside[:, order] * np.array(signs, np.float32), known).mean()
        )
        for name, (signs, order) in _TURNS.items()
    }


def find_turned(pairs: Sequence[tuple[float, Mapping[str, Any]]]) -> Turned | None:
    """What would make most objects much better; None where nothing would.

    `pairs` are each object's mean error and those of `errors_if_turned`.
    """
    if not pairs:
        return None
    given = np.array([mae for mae, _ in pairs])
    best: Turned | None = None
    for name, meaning in _MEANINGS.items():
        turned = np.array([errors[name] for _, errors in pairs])
        gain = given.mean() - turned.mean()
        certain = (
            gain > _LEAST_GAIN_DEG
            and turned.mean() < _LARGEST_SHARE * given.mean()
            and (turned < given).mean() >= _AGREEING
        )
        if certain and (best is None or turned.mean() < best.turned):
            best = Turned(*meaning, float(given.mean()), float(turned.mean()))
    return best
