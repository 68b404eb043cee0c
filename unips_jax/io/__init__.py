"""Files: photographs and masks in, normals out; NumPy and OpenCV only, never JAX."""
