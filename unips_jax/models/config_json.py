"""Configurations as JSON, as they are stored in weights files and checkpoints."""

import dataclasses
import json
from typing import Any, TypeVar

from unips_jax.checks import require
from unips_jax.models.config import NETWORKS, ModelConfig

_T = TypeVar("_T")

# Fields that came later, at the value that changes nothing: left out of JSON, so that
# the hash of weights that have no use for them stays what it was.
_LATER: dict[str, Any] = {"fine_dim": 0, "light_tokens": False, "known_lights": False}


def to_json(config: Any) -> str:
    """Writes a configuration dataclass as JSON text."""
    return json.dumps(
        dataclasses.asdict(config, dict_factory=_without_later), sort_keys=True
    )


def _without_later(items: list[tuple[str, Any]]) -> dict[str, Any]:
    return {
        name: value
        for name, value in items
        if name not in _LATER or value != _LATER[name]
    }


def from_json(cls: type[_T], text: str) -> _T:
    """Reads what `to_json` wrote; `ValueError` where text or a field does not fit."""
    try:
        values = json.loads(text)
    except RecursionError:
        raise ValueError(
            f"{cls.__name__}: expected JSON, got too deep a nest"
        ) from None
    return _from_mapping(cls, values)


def _from_mapping(cls: type[_T], values: Any) -> _T:
    require(
        isinstance(values, dict),
        f"{cls.__name__}: expected a JSON object, got {values!r:.60}",
    )
    if issubclass(cls, ModelConfig):
        values = dict(values)
        network = values.pop("network", None)
        require(
            isinstance(network, str) and network in NETWORKS,
            f"{cls.__name__}: expected a network, one of {sorted(NETWORKS)}, got "
            f"{network!r:.60}. Was the file written by another version of unips_jax?",
        )
        cls = NETWORKS[network]  # type: ignore[assignment]
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}  # type: ignore[arg-type]
    unknown = sorted(set(values) - set(fields))
    require(
        not unknown,
        f"{cls.__name__}: unknown fields {unknown!s:.200}; this version knows "
        f"{sorted(fields)}. Was the file written by another version of unips_jax?",
    )
    kwargs = {}
    for name, value in values.items():
        kind = fields[name].type
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            value = _from_mapping(kind, value)
        elif isinstance(value, list):
            value = tuple(value)
        kwargs[name] = value
    return cls(**kwargs)
