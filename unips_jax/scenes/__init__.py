"""Procedural scenes with known normals, made in JAX: pure functions of one key.

Configurations are read without JAX: what renders is imported when it is first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

from unips_jax.scenes.config import (
    LIGHT_KINDS,
    MATERIALS,
    SHAPE_KINDS,
    SHAPE_NAMES,
    SceneConfig,
)

if TYPE_CHECKING:
    from unips_jax.scenes.geometry import Geometry, render_geometry
    from unips_jax.scenes.incident import IncidentLight, folder_light
    from unips_jax.scenes.meshes import load_meshes
    from unips_jax.scenes.render import Scene, render_batch, render_scene, shade

__all__ = [
    "LIGHT_KINDS",
    "MATERIALS",
    "SHAPE_KINDS",
    "SHAPE_NAMES",
    "Geometry",
    "IncidentLight",
    "Scene",
    "SceneConfig",
    "folder_light",
    "load_meshes",
    "render_batch",
    "render_geometry",
    "render_scene",
    "shade",
]

_MODULES = {
    "Geometry": "geometry",
    "render_geometry": "geometry",
    "IncidentLight": "incident",
    "folder_light": "incident",
    "load_meshes": "meshes",
    "Scene": "render",
    "render_batch": "render",
    "render_scene": "render",
    "shade": "render",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
