"""PS-Wild-like sets rendered with Blender Cycles."""
