"""Claims on pieces of work that several processes share."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def claim(lock: Path, *, wait: bool = False) -> Iterator[bool]:
    """Claims a piece of work until the block ends, or the process does.

    Args:
        lock: a file that stands for the work; made if it is not there, never removed.
        wait: until nobody else has it.

    Yields:
        Whether it is ours.
    """
    with lock.open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True
