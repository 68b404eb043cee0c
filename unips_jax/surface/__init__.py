"""From normals to a surface: depth by bilateral normal integration, files, meshes."""
