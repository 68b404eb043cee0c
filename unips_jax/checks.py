"""Checks of configurations' fields."""

import dataclasses
import math
import typing
from typing import Any

from typeguard import CollectionCheckStrategy, TypeCheckError, check_type


def require(condition: bool, message: str) -> None:
    """Raises `ValueError` with the message unless the condition holds."""
    if not condition:
        raise ValueError(message)


def check_types(config: Any) -> None:
    """Raises `ValueError` unless every field has its annotated type, numbers finite."""
    hints = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value, kind = getattr(config, field.name), hints[field.name]
        require_type(field.name, value, kind)
        items = value if isinstance(value, tuple) else (value,)
        for item in items:
            finite = not isinstance(item, float) or math.isfinite(item)
            require(finite, f"{field.name}: expected finite numbers, got {value}")
            # Python counts True as a number, which is hardly ever meant.
            truth = isinstance(item, bool) and "bool" not in str(kind)
            require(not truth, f"{field.name}: expected a number, got {value}")


def require_type(name: str, value: Any, kind: Any) -> None:
    """Raises `ValueError` unless the value, and every item in it, has the type."""
    every = CollectionCheckStrategy.ALL_ITEMS
    try:
        check_type(value, kind, collection_check_strategy=every)
    except TypeCheckError:
        wanted = kind.__name__ if type(kind) is type else str(kind)
        if typing.get_origin(kind) is typing.Literal:
            wanted = f"one of {typing.get_args(kind)}"
        message = f"{name}: expected {wanted}, got {value!r:.200}"
        raise ValueError(message) from None


def require_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises `ValueError` unless the value is one of the choices."""
    require(value in choices, f"{name}: expected one of {choices}, got {value!r}")


def require_at_most(config: Any, most: float, *names: str) -> None:
    """Raises `ValueError` if a field is above a number."""
    for name in names:
        value = getattr(config, name)
        require(value <= most, f"{name}: expected at most {most}, got {value}")


def require_not_negative(config: Any, *names: str) -> None:
    """Raises `ValueError` if a field is below zero."""
    for name in names:
        value = getattr(config, name)
        require(value >= 0, f"{name}: expected 0 or more, got {value}")


def require_positive(config: Any, *names: str) -> None:
    """Raises `ValueError` unless the fields are above zero."""
    for name in names:
        value = getattr(config, name)
        require(value > 0, f"{name}: expected a positive number, got {value}")
