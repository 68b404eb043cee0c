"""What the commands share: errors that are one line, and progress."""

import contextlib
import functools
import io
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from unips_jax.errors import InputError

_T = TypeVar("_T")


class Command(Protocol):
    """A command's `main`: takes arguments, returns the exit status."""

    def __call__(self, argv: Sequence[str] | None = None) -> int:
        """Runs the command."""
        ...


def command(main: Callable[[Sequence[str] | None], None]) -> Command:
    """Turns a `main(argv)` into one that reports bad input in one line.

    Args:
        main: takes the arguments (None: those of the process).

    Returns:
        A function with the same argument, returning the exit status: 0, 2 after an
        `InputError`, 130 after an interrupt, 141 where nobody reads the output any
        more (`unips ... | head`). Other exceptions are bugs and pass.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str] | None = None) -> int:
        # What the terminal cannot show, such as names that are not Unicode, is escaped.
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            main(argv)
            sys.stdout.flush()
        except InputError as error:
            print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:
            # What is still buffered would fail once more when the process ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 141
        return 0

    return run


def keep_compiled() -> None:
    """Keeps compiled functions for later runs, unless the user said where to."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(home / "unips_jax"))


@contextlib.contextmanager
def progress(description: str) -> Iterator[Callable[[int, int], None]]:
    """Gives a function of (done, total) that shows progress on standard error.

    A bar on a terminal; elsewhere one line at most every ten seconds.

    Args:
        description: a few words for what is being done.
    """
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress

        # The pace is that of the whole run: one item may take minutes.
        with Progress(
            console=Console(stderr=True), transient=True, speed_estimate_period=math.inf
        ) as bar:
            task = bar.add_task(description, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return
    last = time.monotonic()
    first: tuple[float, int] | None = None

    def report(done: int, total: int) -> None:
        nonlocal last, first
        now = time.monotonic()
        # What comes first also waits for compilation: the pace is that of the rest.
        first = first or (now, done)
        if now - last >= 10 and done > first[1]:
            last = now
            left = (now - first[0]) / (done - first[1]) * (total - done)
            print(
                f"{description}: {done}/{total}, about {left:.0f} s left",
                file=sys.stderr,
                flush=True,
            )

    yield report


def track(
    items: Iterable[_T], description: str, *, total: int | None = None
) -> Iterator[_T]:
    """Yields the items, showing `progress`.

    Args:
        items: what to go through, without what an earlier run did, so that the pace is
            true.
        description: a few words for what is being done.
        total: number of items, where `items` has no length.
    """
    if total is None:
        total = len(items)  # type: ignore[arg-type]
    with progress(description) as report:
        for done, item in enumerate(items, 1):
            yield item
            report(done, total)
