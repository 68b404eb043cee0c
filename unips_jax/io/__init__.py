"""Files: photographs and masks in, normals out; NumPy and OpenCV only, never JAX.

What cannot be read or written is an `InputError` of one line that names the file.
"""
