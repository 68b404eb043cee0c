"""What the commands share: errors that are one line, and progress."""

import functools
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

_T = TypeVar("_T")


class InputError(ValueError):
    """Something the user gave cannot be used.

    The message is one line that names the file or argument, what was expected, what
    came, and the fix. Commands print it and exit with status 2.
    """


def command(
    main: Callable[[Sequence[str] | None], None],
) -> Callable[[Sequence[str] | None], int]:
    """Turns a `main(argv)` into one that reports bad input in one line.

    Args:
        main: takes the arguments (None: those of the process).

    Returns:
        A function with the same argument, returning the exit status: 0, 2 after an
        `InputError`, 130 after an interrupt. Other exceptions are bugs and pass.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str] | None = None) -> int:
        try:
            main(argv)
        except InputError as error:
            print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
        return 0

    return run


def track(
    items: Iterable[_T], description: str, *, total: int | None = None
) -> Iterator[_T]:
    """Yields the items, showing progress on standard error.

    A bar on a terminal; elsewhere one line at most every ten seconds.

    Args:
        items: what to go through.
        description: a few words for what is being done.
        total: number of items, where `items` has no length.
    """
    if total is None:
        total = len(items)  # type: ignore[arg-type]
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import track as rich_track

        console = Console(stderr=True)
        yield from rich_track(items, description, total=total, console=console)
        return
    start = last = time.monotonic()
    for done, item in enumerate(items, 1):
        yield item
        now = time.monotonic()
        if now - last >= 10:
            last = now
            left = (now - start) / done * (total - done)
            print(
                f"{description}: {done}/{total}, about {left:.0f} s left",
                file=sys.stderr,
                flush=True,
            )
