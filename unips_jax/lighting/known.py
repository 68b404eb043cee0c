"""Lights that are known before an estimate: from a rig's list, or by hand.

A list (`.lp`, see `io.light_list`) holds directions, taken as exact. By hand a light is
"NAME: upper left", for the file of that name or the photograph of that number: left or
right, upper or lower, and front, in any combination, each 45 degrees away from the
viewer without "front", 27 with it, and known to 35 degrees.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.naming import plain_name, rows_in_order
from unips_jax.lighting.rig import read_directions

_WORDS = {
    "left": (-1, 0, 0),
    "right": (1, 0, 0),
    **dict.fromkeys(("upper", "top", "above"), (0, 1, 0)),
    **dict.fromkeys(("lower", "bottom", "below"), (0, -1, 0)),
    **dict.fromkeys(("front", "centre", "center"), (0, 0, 1)),
}
_BY_HAND = re.compile(
    rf"(.+):\s*((?:{'|'.join(_WORDS)})(?:[\s,-]+\w+)*)", re.IGNORECASE
)
_ERROR = np.cos(np.radians(35))  # of words; networks are trained on errors up to it


def read_known_lights(given: Sequence[str], names: Sequence[str]) -> np.ndarray:
    """Lights of photographs, as `estimate_normals` takes them: `[N, 3]`, float32.

    0 where nothing is known. Later ones replace earlier ones. `InputError` if a list
    fits no photograph, or a name or word is unknown.
    """
    lights = np.zeros((len(names), 3), np.float32)
    for text in given:
        by_hand = _BY_HAND.fullmatch(text.strip())
        if by_hand:
            rows, directions = _by_hand(text, by_hand[1].strip(), by_hand[2], names)
        else:
            rows, directions = _from_list(Path(text), names)
        lights[rows] = directions
    return lights


def _from_list(path: Path, names: Sequence[str]) -> tuple[list[int], np.ndarray]:
    option = f"--known-lights {path}"
    if not path.is_file():
        raise InputError(
            f"{option}: expected a list of lights (.lp), or NAME: and words such as "
            "upper left, found no such file"
        )
    known, directions = read_directions(path, option)
    places = {plain_name(name): row for row, name in enumerate(known)}
    rows = [row for row, name in enumerate(names) if plain_name(name) in places]
    if rows and (len(rows) == len(names) or len(known) != len(names)):
        return rows, directions[[places[plain_name(names[row])] for row in rows]]
    if rows:  # names go on from an earlier object's, or some lights are not known
        others = next(name for name in names if plain_name(name) not in places)
        raise InputError(
            f"{option}: expected as many lights as photographs by their names, or by "
            f"none of them in their order, got {len(rows)} of {len(names)} by name, "
            f"none for {others}; keep the lines of these photographs alone"
        )
    if len(known) == len(names):
        return list(range(len(names))), directions[rows_in_order(known)]
    raise InputError(
        f"{option}: expected lights by the photographs' names ({names[0]}, ...), or "
        f"{len(names)} in their order, got {len(known)} of other names"
    )


def _by_hand(
    text: str, name: str, words: str, names: Sequence[str]
) -> tuple[list[int], np.ndarray]:
    direction = np.zeros(3)
    for word in re.split(r"[\s,-]+", words.lower()):
        if word not in _WORDS:
            raise InputError(
                f"--known-lights {text!r}: expected words of {', '.join(_WORDS)}, got "
                f"{word}"
            )
        direction += _WORDS[word]
    if not direction.any():
        raise InputError(
            f"--known-lights {text!r}: expected a direction, got words that cancel out"
        )
    direction[:2] /= np.linalg.norm(direction[:2]) or 1
    direction[2] += 1
    direction *= _ERROR / np.linalg.norm(direction)
    by_name = [row for row, n in enumerate(names) if plain_name(n) == plain_name(name)]
    if by_name:
        return by_name, direction
    numbers = [str(row + 1) for row in range(len(names))]
    if name.lstrip("0") in numbers:
        return [numbers.index(name.lstrip("0"))], direction
    raise InputError(
        f"--known-lights {text!r}: expected a photograph's name, or its number from 1 "
        f"to {len(names)}, got {name}"
    )
