"""Recipes: Python files whose `get_config()` returns a configuration.

Those of the folder `configs` ship with the package and are known by name; others are
given as files.
"""

import runpy
from pathlib import Path
from typing import Any

from unips_jax.errors import InputError
from unips_jax.training.config import Config

_PACKAGE = Path(__file__).parents[1]
# In a wheel the folder lies in the package, in a clone next to it.
_FOLDERS = (_PACKAGE / "configs", _PACKAGE.parent / "configs")


def shipped_recipes() -> dict[str, Path]:
    """The files of the recipes that ship with the package, by name."""
    for folder in _FOLDERS:
        if (folder / "unips.py").is_file():
            return {path.stem: path for path in sorted(folder.glob("*.py"))}
    return {}


def load_config(source: str | Path) -> Config:
    """The configuration of a recipe: a shipped one's name, or a file, which is run.

    Raises:
        InputError: if there is no such recipe, or it fails.
    """
    path = _recipe(str(source))
    try:
        get_config: Any = runpy.run_path(str(path)).get("get_config")
    except (Exception, SystemExit) as error:
        raise InputError(f"--config {source}: {_failure(error, path)}") from error
    if not callable(get_config):
        raise InputError(f"--config {source}: expected a function get_config() in it")
    try:
        config = get_config()
    except (Exception, SystemExit) as error:
        raise InputError(f"--config {source}: {_failure(error, path)}") from error
    if not isinstance(config, Config):
        raise InputError(
            f"--config {source}: expected get_config() to return a Config of "
            f"unips_jax.training, got {type(config).__name__}"
        )
    return config


def _recipe(source: str) -> Path:
    shipped = shipped_recipes()
    if source in shipped:
        return shipped[source]
    if Path(source).is_file():
        return Path(source)
    names = ", ".join(shipped)
    raise InputError(
        f"--config {source}: expected a Python file or one of {names}, found none"
    )


def _failure(error: BaseException, path: Path) -> str:
    """What went wrong in the file, and in which of its lines."""
    place, line = error.__traceback__, 0
    while place is not None:
        if place.tb_frame.f_code.co_filename == str(path):
            line = place.tb_lineno
        place = place.tb_next
    if isinstance(error, SyntaxError) and error.filename in (str(path), None):
        line = error.lineno or 0
    text = f"fails in line {line}: {type(error).__name__}: {error}"
    return text if len(text) < 400 else f"{text[:400]}..."
