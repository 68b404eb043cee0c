"""Starting the process of a run again, where its steps then take less time.

On CPU under glibc two things cost time. Large buffers are given back to the system
after every use, which clears all their pages again; settings that are read when a
process starts prevent it. With them all threads share one heap, which compiling leaves
in pieces: finding room then takes a fifth of the time, under one lock. So `unips train`
starts again with these settings, and once more when it has compiled: then its programs
come from the cache. A step of 2.0 seconds takes 1.5 so; 2.7 in a process that has
compiled with the settings.
"""

import os
import platform
import sys
from collections.abc import Sequence

import jax

# What keeps large buffers: one heap, from which nothing is given back.
_SETTINGS = {
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "-1",
}
# Of the process that has started again after compiling: it does so once.
_DONE = "UNIPS_TRAIN_COMPILED"
# Fewer steps do not make up for the time that a start takes.
_WORTH_IT = 100


class Restarts:
    """When to start the process again; it is done by `start`."""

    def __init__(self, arguments: Sequence[str]) -> None:
        """Restarts of the process that runs `unips train` with these arguments.

        In any other process (a notebook's, a test's), under other systems and with
        several processes or an accelerator nothing is ever due.
        """
        self._command = _command(arguments)
        self._compiled = 0
        self.due = False
        self._possible = (
            bool(self._command)
            and jax.default_backend() == "cpu"
            and jax.process_count() == 1
        )
        if self._possible:
            jax.monitoring.register_event_listener(self._count)

    def _count(self, event: str, **_: str | int) -> None:
        # A program was compiled, and not read from the cache, but put there.
        self._compiled += event == "/jax/compilation_cache/cache_misses"

    def with_settings(self) -> None:
        """Starts the process again with the settings, unless it has some."""
        if self._possible and not _SETTINGS.keys() & os.environ.keys():
            self._start(_SETTINGS)

    def compiled_all(self, steps_left: int) -> bool:
        """Whether to start again once everything is compiled; `due` from then on."""
        self.due = (
            self._possible
            and self._compiled > 0
            and steps_left >= _WORTH_IT
            and _DONE not in os.environ
            and _SETTINGS.items() <= os.environ.items()
        )
        return self.due

    def start(self) -> None:
        """Starts the process again; does not return."""
        self._start({_DONE: "1"})

    def _start(self, settings: dict[str, str]) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        os.execve(sys.executable, self._command, {**os.environ, **settings})


def _command(arguments: Sequence[str]) -> list[str]:
    """What started this process, if it was `unips train` with these arguments."""
    if sys.platform != "linux" or platform.libc_ver()[0] != "glibc":
        return []
    first = len(sys.orig_argv) - len(arguments)
    before = sys.orig_argv[max(first - 1, 0)]
    if sys.orig_argv[first:] != list(arguments) or first < 2:
        return []
    return sys.orig_argv if before in ("train", "unips_jax.train") else []
