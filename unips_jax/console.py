"""What the commands share: their options, errors that are one line, and progress."""

import contextlib
import dataclasses
import difflib
import functools
import glob
import io
import itertools
import math
import os
import re
import sys
import time
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from unips_jax.errors import InputError

_T = TypeVar("_T")


class Command(Protocol):
    """A command's `main`: takes arguments, returns the exit status."""

    def __call__(self, argv: Sequence[str] | None = None) -> int: ...


def command(main: Callable[[Sequence[str] | None], None]) -> Command:
    """Turns a `main(argv)` into one that reports bad input in one line.

    It returns the exit status: 0, 2 after an `InputError` or what else is no bug (a
    full disk, a device that is not there, too little memory), 130 after an interrupt,
    141 where nobody reads the output any more (`unips ... | head`). Other exceptions
    are bugs and pass.
    """

    @functools.wraps(main)
    def run(argv: Sequence[str] | None = None) -> int:
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:  # closed, or there is no console
                nowhere = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
                setattr(sys, name, nowhere)
        # What the terminal cannot show, such as names that are not Unicode, is escaped.
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")
        try:
            main(argv)
            sys.stdout.flush()
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return 130
        except BrokenPipeError:
            # What is still buffered would fail once more when the process ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 141
        except Exception as error:
            reason = reason_of(error)
            if reason is None:
                raise
            print(f"error: {reason}", file=sys.stderr)
            return 2
        return 0

    return run


def reason_of(error: Exception) -> str | None:
    """One line for an error that is no bug; None for one that is."""
    text = str(error)
    if isinstance(error, InputError):
        pass
    elif isinstance(error, OSError) and error.strerror:
        text = error.strerror
        if error.filename is not None:
            text = f"{os.fsdecode(error.filename)}: {text}"
    elif isinstance(error, MemoryError):
        text = f"out of memory: {text or 'give smaller or fewer images'}"
    elif isinstance(error, RuntimeError) and text.startswith("RESOURCE_EXHAUSTED"):
        text = f"out of memory: give smaller or fewer images ({text.splitlines()[0]})"
    else:
        return None
    return " ".join(text.split())


def parse(
    options: type[_T],
    argv: Sequence[str] | None,
    *,
    prog: str,
    description: str,
    default: _T | None = None,
    negatable: bool = False,
) -> _T:
    """Parses a command's arguments; the docstring of `options` describes them.

    With `negatable`, every --flag has its --no-flag. `InputError` for an option that
    there is not, with those that are nearest, and for one of several values that is
    given twice; `SystemExit` after help, and with status 2 for other bad arguments.
    """
    import tyro

    arguments = sys.argv[1:] if argv is None else list(argv)
    if {"-h", "--help"} & set(arguments):
        print(f"{description.strip()}\n")  # tyro would make each paragraph one line
    given: dict[str, Any] = {
        "prog": prog,
        "description": "",
        "config": (tyro.conf.DisallowNone,),
    }
    if not negatable:
        given["config"] += (tyro.conf.FlagCreatePairsOff,)
    if default is not None:
        given["default"] = default
    found, unknown = tyro.cli(
        options, args=arguments, return_unknown_args=True, **given
    )
    if unknown:
        shown = io.StringIO()
        with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
            tyro.cli(options, args=["--help"], **given)
        known = dict.fromkeys(re.findall(r"--\w[\w.-]*", shown.getvalue()))
        near = _nearest(unknown[0], list(known))
        hint = f"perhaps {' or '.join(near)}; " if near else ""
        what = "has no option" if unknown[0].startswith("-") else "does not expect"
        raise InputError(f"{prog} {what} {unknown[0]}: {hint}see `{prog} --help`")
    _require_once(options, arguments)
    return found


def _require_once(options: type, arguments: Sequence[str]) -> None:
    """Refuses an option of several values given twice: only the last would count."""
    several, given = dict(_of_several(options)), Counter[str]()
    for argument in itertools.takewhile(lambda a: a != "--", arguments):
        name = argument.partition("=")[0]
        name = name.replace("_", "-") if name.startswith("--") else name[:2]
        given.update([several[name]] if name in several else [])
    for option, count in given.items():
        if count > 1:
            times = "twice" if count == 2 else f"{count} times"
            raise InputError(
                f"{option}: expected once, with all its values after it, got it "
                f"{times}; write {option} A B"
            )


def _of_several(options: type, group: str = "--") -> Iterator[tuple[str, str]]:
    """How options that take any number of values may be written, and their names."""
    for field, hint in typing.get_type_hints(options, include_extras=True).items():
        given = getattr(hint, "__metadata__", ())
        kind = typing.get_args(hint)[0] if given else hint
        name = group + field.replace("_", "-")
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            nameless = any(getattr(each, "name", None) == "" for each in given)
            yield from _of_several(kind, group if nameless else f"{name}.")
        elif typing.get_args(kind)[1:] == (...,):
            yield name, name
            for each in given:
                for alias in getattr(each, "aliases", None) or ():
                    yield alias, name


def expanded(paths: Iterable[Path]) -> Iterator[Path]:
    """Paths, those that a pattern fits in place of it: Windows' shells leave that."""
    for path in paths:
        there = os.path.lexists(path)
        found = [] if there else sorted(map(Path, glob.glob(str(path))))
        yield from found or [path]


def require_patterns(include: Sequence[str], exclude: Sequence[str]) -> None:
    """Refuses folders, which were meant to be worked on, and paths: no name fits."""
    for option, patterns in (("--include", include), ("--exclude", exclude)):
        for pattern in patterns:
            if os.path.isdir(pattern):  # however long
                raise InputError(
                    f"{option} {pattern}: expected a pattern of file names, got a "
                    "folder; name folders first"
                )
            if {os.sep, os.altsep} & {*pattern}:
                raise InputError(
                    f"{option} {pattern}: expected a pattern of file names, got a "
                    "path; leave out its folder"
                )


def _nearest(name: str, known: Sequence[str]) -> list[str]:
    """Options that a name may stand for: by initials, as --optim.lr, or by spelling."""
    name = name.partition("=")[0].replace("_", "-")
    *group, last = name.lstrip("-").split(".")

    def initials(option: str) -> bool:
        *other, field = option.lstrip("-").split(".")
        short = "".join(word[0] for word in field.split("-") if word)
        return other == group and short == last

    return [option for option in known if initials(option)] or (
        difflib.get_close_matches(name, known, n=2)
    )


def one_of(choices: Sequence[str], *, several: bool = False) -> Any:
    """Annotates an option, or with `several` a list, whose choices are known here."""
    import tyro

    choice: Any = tyro.extras.literal_type_from_choices(choices)
    kind = tuple[choice, ...] if several else choice
    return tyro.conf.arg(constructor=kind, help_behavior_hint=_default_if_any)


def _default_if_any(default: str) -> str:
    shown = default.strip("[]'")
    return "" if shown in ("None", "") else f"(default: {shown})"


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]
) -> None:
    """Prints a table."""
    from rich.console import Console
    from rich.table import Table

    shown = Table()
    for column in columns:
        shown.add_column(column)
    for row in rows:
        shown.add_row(*row)
    width = None if sys.stdout.isatty() else 160
    Console(width=width, markup=False, highlight=False).print(title, shown, sep="\n")


def start_jax() -> None:
    """Readies JAX for a command: a device that there is, and compilations are kept."""
    import jax

    cache_compilations()
    try:
        jax.devices()
    except Exception as error:  # an AssertionError without text, among others
        asked = os.environ.get("JAX_PLATFORMS", "")
        reason = f" ({error})" if str(error) else ""
        raise InputError(
            f"JAX_PLATFORMS={asked}: expected a platform that JAX can use here, got "
            f"none{reason}; install JAX's build for it, such as jax[cuda12], or unset "
            "the variable"
        ) from error


def cache_compilations(folder: str | os.PathLike[str] | None = None) -> None:
    """Keeps what JAX compiles for later runs, at most a gigabyte of it.

    Every command does so. To be called before JAX compiles something. A folder that
    JAX has already, as `JAX_COMPILATION_CACHE_DIR` names one, stays if none is given.

    Args:
        folder: where; `unips_jax` in the user's cache folder if None.
    """
    import jax

    named = "JAX_COMPILATION_CACHE_DIR" in os.environ  # an empty name: none
    there = getattr(jax.config, "jax_compilation_cache_dir", None)
    if folder is None and (named or there):
        return
    # Without a home folder, of the environment or the user's, nothing is kept.
    with contextlib.suppress(RuntimeError):
        if folder is None:
            folder = _cache_folder()
            _clear_halves(folder)
        jax.config.update("jax_compilation_cache_dir", os.fspath(folder))
        jax.config.update("jax_compilation_cache_max_size", 2**30)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _clear_halves(cache: Path) -> None:
    """Removes what a full disk or a kill left: JAX would keep nothing more."""
    from filelock import FileLock, Timeout

    if not cache.is_dir():
        return
    # JAX holds this lock while it writes.
    with (
        contextlib.suppress(OSError, Timeout),
        FileLock(cache / ".lockfile", timeout=1),
    ):
        for entry in cache.glob("*-cache"):
            name = entry.name.removesuffix("-cache")
            if not entry.with_name(f"{name}-atime").exists():
                entry.unlink()


def _cache_folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "unips_jax"


@contextlib.contextmanager
def progress(description: str) -> Iterator[Callable[[int, int], None]]:
    """Gives a function of (done, total) that shows progress on standard error.

    A bar on a terminal; elsewhere one line at most every ten seconds.
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

    `items` are without what an earlier run did, so that the pace is true; `total` is
    their number, where they have no length.
    """
    if total is None:
        total = len(items)  # type: ignore[arg-type]
    with progress(description) as report:
        for done, item in enumerate(items, 1):
            yield item
            report(done, total)
