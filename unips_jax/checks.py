"""Checks of configurations' fields."""

from typing import Any


def require(condition: bool, message: str) -> None:
    """Raises `ValueError` with the message unless the condition holds."""
    if not condition:
        raise ValueError(message)


def require_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises `ValueError` unless the field has one of the values."""
    require(value in choices, f"{name}: expected one of {choices}, got {value!r}")


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
