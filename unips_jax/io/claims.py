"""Claims on pieces of work that several processes share.

Claims are locks of the operating system (`filelock`), which lets them go when a process
ends, however it ends.
"""

import contextlib
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from unips_jax.errors import InputError
from unips_jax.io.door import digest

_T = TypeVar("_T")
_LONGEST = 120  # characters of a name, of which there may be 255 bytes


@contextlib.contextmanager
def claim(lock: Path, *, wait: bool = False) -> Iterator[bool]:
    """Claims a piece of work until the block ends, or the process does.

    `lock` is a file that stands for the work, never removed. Yields whether it is ours;
    with `wait`, once nobody else has it.
    """
    ours = FileLock(lock, timeout=-1 if wait else 0, fallback_to_soft=False)
    try:
        ours.acquire()
    except Timeout:
        yield False
        return
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{lock}: expected a file system that can lock files, to claim work, got: "
            f"{reason}; choose a folder on another"
        ) from error
    try:
        yield True
    finally:
        ours.release()


def claimed(items: Iterable[_T], lock: Callable[[_T], Path]) -> Iterator[_T]:
    """Yields every item while it is ours; what others hold comes last."""
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


def make_folder(path: Path, option: str) -> None:
    """Makes a folder that may be written to, which a command line's `option` named."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror
        raise InputError(f"{option} {path}: cannot be a folder ({reason})") from None
    if not os.access(path, os.W_OK):
        raise InputError(
            f"{option} {path}: expected a folder that may be written to, got one that "
            "may not; choose another"
        )


def slug(text: str) -> str:
    """The text as part of a file's name; of long texts the beginning and a hash."""
    name = re.sub(r"[^A-Za-z0-9.+=-]+", "_", text).strip("_") or "_"
    return name if len(name) <= _LONGEST else f"{name[:_LONGEST]}-{digest(text)}"
