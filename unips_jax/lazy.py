"""Packages whose names are imported when they are first used."""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def attributes(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """A package's `__getattr__`.

    `modules` holds the names, separated by blanks, that each module of `unips_jax` has.
    """
    place = {
        name: module for module, names in modules.items() for name in names.split()
    }

    def get(name: str) -> Any:
        if name not in place:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"unips_jax.{place[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return get
