"""Procedural scenes with known normals, made in JAX: pure functions of one key.

Configurations are read without JAX: what renders is imported when it is first used.
"""

from typing import TYPE_CHECKING

from unips_jax.lazy import attributes
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

__getattr__ = attributes(
    __name__,
    {
        "scenes.geometry": "Geometry render_geometry",
        "scenes.incident": "IncidentLight folder_light",
        "scenes.meshes": "load_meshes",
        "scenes.render": "Scene render_batch render_scene shade",
    },
)
