"""Claims on pieces of work that several processes share."""

import contextlib
import fcntl
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

_T = TypeVar("_T")


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


def claimed(items: Iterable[_T], lock: Callable[[_T], Path]) -> Iterator[_T]:
    """Yields every item while it is ours; what others have comes last, once they end.

    Args:
        items: pieces of work.
        lock: gives the file that stands for one; see `claim`.
    """
    others = []
    for item in items:
        with claim(lock(item)) as ours:
            if ours:
                yield item
            else:
                others.append(item)
    for item in others:
        with claim(lock(item), wait=True):
            yield item
