"""The application: photographs in, normals out, in a browser, on this machine."""
