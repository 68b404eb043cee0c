"""The one door through which files are written: whole or not at all, errors one line.

Whatever the package writes goes through here; `tests/test_architecture.py` lists what
does not. A file is written under a temporary name in its folder and renamed when it is
complete, so that no reader ever sees a part of it and a full disk or a killed process
leaves what was there before. What the file system refuses becomes `NotWritten`.

Libraries write into an open file (`new_file`), or under the temporary name where they
insist on one (`new_path`): their own errors rarely hold the system's reason.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from unips_jax.errors import InputError

_PART = re.compile(r"\.[0-9a-f]{12}\.\d+-\d+\.tmp")  # see `new_path`
_ABANDONED_S = 86_400  # of a file that is being written, the time changes
# Windows moves nothing that is open elsewhere, if only to be scanned for viruses.
_IN_USE, _PATIENCE_S = (5, 32), 2.0


class NotWritten(InputError):
    """The file system refused to write: `reason`, in its own words, and its `errno`."""

    def __init__(self, path: Path, cause: Exception) -> None:
        self.reason: str = reason_why(cause)
        self.errno: int | None = getattr(cause, "errno", None)
        super().__init__(
            f"{path}: cannot be written: {self.reason}; free space there, or choose "
            "another place"
        )


def reason_why(cause: Exception) -> str:
    """The file system's reason, without the file's name."""
    own = getattr(cause, "reason", None) or getattr(cause, "strerror", None)
    return own or str(cause)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns an OSError, or a `NotWritten` of a part, into one that names the path."""
    try:
        yield
    except (OSError, NotWritten) as error:
        raise NotWritten(path, error) from error


@contextlib.contextmanager
def new_path(path: Path, *, suffix: str | None = None) -> Iterator[Path]:
    """Gives the name under which to write a file, which then gets its own.

    If anything fails, what was there before stays; a killed process may leave the
    temporary file. The file's folder is made if it is not there.
    """
    # Any name may be as long as names can be.
    end = path.suffix if suffix is None else suffix
    writer = f"{os.getpid()}-{threading.get_native_id()}"
    part = path.parent / f".{digest(path.name)}.{writer}.tmp{end}"
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise OSError(errno.EINVAL, "a device or a pipe, not a file")
        try:
            yield part
            patiently(part.replace, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def new_file(path: Path, *, sync: bool = False) -> Iterator[BinaryIO]:
    """Opens a file that is complete or absent, whatever happens; see `new_path`.

    With `sync` it is on the disk when it appears, even if the power fails.
    """
    # Readable too: NumPy then writes by methods whose errors have the reason.
    with new_path(path, suffix="") as part, part.open("w+b") as file:
        yield file
        file.flush()
        if sync:
            os.fsync(file.fileno())


def write_whole(
    path: Path, data: bytes | bytearray | memoryview, *, sync: bool = True
) -> None:
    """Writes a file that is complete or absent, whatever happens; see `new_file`."""
    with new_file(path, sync=sync) as file:
        file.write(data)


def write_json(path: Path, value: Any, *, indent: int | None = None) -> None:
    """Writes a JSON file; names that are not Unicode become JSON's escapes."""
    text = json.dumps(value, indent=indent, ensure_ascii=False) + "\n"
    write_whole(path, text.encode(errors="backslashreplace"), sync=False)


def append_line(path: Path, line: str) -> None:
    """Adds a line to a file, or nothing at all."""
    with writing(path), path.open("ab", buffering=0) as file:
        length = file.seek(0, os.SEEK_END)
        left = memoryview(f"{line}\n".encode())
        try:
            while left:
                left = left[file.write(left) :]
        except OSError:
            with contextlib.suppress(OSError):  # devices have no length
                file.truncate(length)
            raise


def move(source: Path, target: Path) -> None:
    """Renames a file or folder of the same file system; a file there is replaced."""
    with writing(target):
        patiently(source.replace, target)


def patiently(move: Callable[[Path], object], target: Path) -> None:
    """Moves to a target, and tries for a while where Windows finds it in use."""
    end = time.monotonic() + _PATIENCE_S
    while True:
        try:
            move(target)
            return
        except PermissionError as error:
            in_use = getattr(error, "winerror", None) in _IN_USE
            if not in_use or time.monotonic() > end:
                raise
        time.sleep(0.05)


def clear_parts(folder: Path) -> None:
    """Removes temporary files that killed processes left here a day ago or earlier."""
    limit = time.time() - _ABANDONED_S
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if not _PART.match(entry.name):
                continue
            with contextlib.suppress(OSError):  # another process was faster
                if entry.stat(follow_symlinks=False).st_mtime < limit:
                    os.unlink(entry)


def digest(name: str) -> str:
    """Twelve letters that stand for a name of any length."""
    return hashlib.blake2b(os.fsencode(name), digest_size=6).hexdigest()
