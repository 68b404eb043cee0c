"""The one kind of error that is the user's to mend, and what to install for what.

Hints name the packages of an extra, not the extra: they work from a clone, from a wheel
and from an index alike.
"""

_EXTRAS = {
    "app": "starlette uvicorn fast-simplification pillow-heif rawpy",
    "export": "onnx",
    "heif": "pillow-heif",
    "mesh": "fast-simplification",
    "raw": "rawpy",
    "ray": "ray",
}


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one line that names the file or argument, what was expected, what
    came, and the fix. Commands print it and exit with status 2.
    """


def install_hint(extra: str) -> str:
    """The command that installs what an extra of `pyproject.toml` holds."""
    return f"pip install {_EXTRAS[extra]}"
