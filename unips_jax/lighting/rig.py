"""Lights of a rig: of an earlier capture by the same lamps, or of an RTI's list.

A result's `lights.json` holds all of each light, so that it is taken as it is. A list
(`.lp`) holds directions alone; colours are then fitted to the photographs.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.light_list import read_light_list
from unips_jax.io.naming import plain_name, rows_in_order
from unips_jax.io.orientation import axes_as_stored
from unips_jax.lighting.harmonics import harmonics as functions
from unips_jax.lighting.light_fit import Lights

_FILE = "lights.json"
_SHAPES = {"direction": (3,), "directness": (), "color": (3,), "harmonics": (9, 3)}


def rig_file(source: Path) -> Path:
    """The file that holds the lights: a list, or that of a folder of results."""
    path = source / _FILE if source.is_dir() else source
    if not path.is_file():
        raise InputError(
            f"--lights-from {source}: expected a result with {_FILE} (`unips estimate "
            "--lights` writes it), or a list of lights (.lp), found none"
        )
    return path


def read_rig(source: Path, names: Sequence[str] | None = None) -> Lights | np.ndarray:
    """Lights (or a list's unit directions `[N, 3]`) of photographs, by their names.

    In order if there are as many, of other names, or no names are given. `InputError`
    if a photograph has none.
    """
    path = rig_file(source)
    if path.suffix.lower() == ".lp":
        known, directions = read_directions(path, f"--lights-from {source}")
        return directions[_rows(known, names, source)]
    stored = _stored(path)
    rows = _rows(stored["file"], names, source)
    values = {name: np.array(stored[name], float)[rows] for name in _SHAPES}
    return _lights(**values)


def _lights(
    direction: np.ndarray,
    directness: np.ndarray,
    color: np.ndarray,
    harmonics: np.ndarray,
) -> Lights:
    towards = functions(direction)[..., None] * color[:, None]
    return Lights(direction, directness, color, harmonics, harmonics - towards)


def turned_to(
    rig: Lights | np.ndarray, source: Path, orientation: int
) -> Lights | np.ndarray:
    """A result's lights as photographs show them that EXIF turns by `orientation`.

    The camera stood still: as stored, its photographs and the earlier ones lie alike. A
    list's directions stay as they are.
    """
    path = rig_file(source)
    if not isinstance(rig, Lights):
        return rig
    before = json.loads(path.read_bytes()).get("exif_orientation", orientation)
    if before not in range(1, 9):
        raise InputError(
            f"{path}: expected an EXIF orientation, 1 to 8, got {before!r}; estimate "
            "that capture again"
        )
    if before == orientation:
        return rig
    turn = axes_as_stored(orientation).T @ axes_as_stored(before)
    # Of functions that are turned: any directions that tell all nine apart.
    some = np.random.default_rng(0).normal(size=(64, 3))
    some /= np.linalg.norm(some, axis=1, keepdims=True)
    spun = np.linalg.pinv(functions(some @ turn.T)) @ functions(some)
    return _lights(
        rig.directions @ turn.T, rig.directness, rig.colors, spun @ rig.harmonics
    )


def read_directions(path: Path, option: str) -> tuple[Sequence[str], np.ndarray]:
    """Names and unit directions `[N, 3]` of a list (`.lp`); errors name the option."""
    found = read_light_list(path)
    if found.problems:
        raise InputError(f"{option}: {found.problems[0]}")
    if not found.names:
        raise InputError(f"{option}: expected lights, one a line, got none")
    if found.lights.shape[1] != 3:
        raise InputError(
            f"{option}: expected directions, three numbers, got highlights' places in "
            "pixels, two"
        )
    length = np.linalg.norm(found.lights, axis=1, keepdims=True)
    if not (length > 0).all():
        raise InputError(f"{option}: expected directions, got one of length 0")
    return found.names, found.lights / length


def _stored(path: Path) -> dict[str, list[Any]]:
    """What `lights.json` holds, as columns."""
    try:
        entries = json.loads(path.read_bytes())["photographs"]
        columns = {name: [e[name] for e in entries] for name in ("file", *_SHAPES)}
        right = len(entries) > 0 and all(isinstance(n, str) for n in columns["file"])
        for name, shape in _SHAPES.items():
            values = np.array(columns[name], float)
            right &= values.shape == (len(entries), *shape)
            right &= bool(np.isfinite(values).all())
        length = np.linalg.norm(np.array(columns["direction"], float), axis=-1)
        right &= bool((abs(length - 1) < 1e-3).all())
    except (OSError, ValueError, KeyError, TypeError):
        right = False
    if not right:
        raise InputError(
            f"{path}: expected lights as `unips estimate --lights` writes them, got "
            "something else; estimate that capture again"
        )
    return columns


def _rows(known: Sequence[str], names: Sequence[str] | None, source: Path) -> list[int]:
    """Which light is each photograph's."""
    if names is None:
        return list(range(len(known)))
    places = {plain_name(name): row for row, name in enumerate(known)}
    wanted = [plain_name(name) for name in names]
    if all(name in places for name in wanted):
        return [places[name] for name in wanted]
    alike = sum(name in places for name in wanted)
    if len(known) == len(names) and not alike:
        return rows_in_order(known)
    missing = next(n for n, w in zip(names, wanted, strict=True) if w not in places)
    raise InputError(
        f"--lights-from {source}: expected a light for each of the {len(names)} "
        "photographs by their names, or as many in their order, of other names, got "
        f"{len(known)}, {alike} of them by name, none for {missing}; rename the "
        "photographs, or keep a copy with their names"
    )
