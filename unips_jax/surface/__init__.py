"""From normals to a surface: depth by bilateral normal integration, files, meshes."""

from unips_jax.surface.images import Integration, integrate_image
from unips_jax.surface.integrate import integrate_normals

__all__ = ["Integration", "integrate_image", "integrate_normals"]
