"""The application: photographs in, normals out, in a browser, on this machine.

An object is a folder on disk (`objects`), which says all that is known of it; the page
only shows it. So a reload, a lost connection or a closed tab costs nothing.
"""
