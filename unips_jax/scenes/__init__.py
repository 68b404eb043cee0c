"""Procedural scenes with known normals, made in JAX: pure functions of one key."""

from unips_jax.scenes.config import LIGHT_KINDS, MATERIALS, SHAPE_KINDS, SceneConfig
from unips_jax.scenes.geometry import Geometry, render_geometry
from unips_jax.scenes.incident import IncidentLight, folder_light
from unips_jax.scenes.render import Scene, render_batch, render_scene, shade

__all__ = [
    "LIGHT_KINDS",
    "MATERIALS",
    "SHAPE_KINDS",
    "Geometry",
    "IncidentLight",
    "Scene",
    "SceneConfig",
    "folder_light",
    "render_batch",
    "render_geometry",
    "render_scene",
    "shade",
]
