"""Training data read from disk: NumPy and OpenCV only, never JAX."""
