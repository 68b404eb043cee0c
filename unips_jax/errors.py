"""The one kind of error that is the user's to mend."""


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one line that names the file or argument, what was expected, what
    came, and the fix. Commands print it and exit with status 2.
    """
