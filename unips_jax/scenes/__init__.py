"""Procedural objects, materials and lights, rendered in JAX."""
