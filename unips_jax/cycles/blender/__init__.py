"""What runs in Blender's own Python (the `bpy` package), which has no JAX.

Only `bpy`, `mathutils` and NumPy are imported here; everything after a rendering is
`unips_jax.cycles`'s. Imports are relative: Blender's Python knows this package by
another name.
"""
