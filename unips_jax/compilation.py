"""Compiling the training step: all processes together; and its memory."""

import ctypes
import sys
from collections.abc import Callable
from typing import Any

import jax
from orbax.checkpoint import multihost

from unips_jax.train_state import TrainState
from unips_jax.train_step import Batch

# Options of mallopt, as malloc.h numbers them.
_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8

Step = Callable[[TrainState, Batch, jax.Array], tuple[TrainState, dict[str, jax.Array]]]


def compile_together(step: Any, report: Callable[[str], None]) -> Step:
    """The jitted step; no process runs it before all have compiled it.

    Processes do not compile equally fast, and collectives between them give up after
    half a minute on CPU.

    Args:
        step: what `jax.jit` gave.
        report: called with a line before every compilation.

    Returns:
        A function like `step` that compiles once for every shape of batch.
    """
    wait = multihost.get_barrier_sync_fn()
    compiled: dict[str, Step] = {}

    def run(
        state: TrainState, batch: Batch, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        types = str(jax.tree.map(jax.typeof, batch))
        if types not in compiled:
            count = batch["images"].shape[1]
            report(f"compiling for sets of {count} images; it takes a minute or so")
            compiled[types] = step.lower(state, batch, key).compile()
            return_freed_memory()
            wait(key=f"compiled {types}", timeout_ms=3_600_000)
        return compiled[types](state, batch, key)

    return run


def keep_freed_memory() -> None:
    """Lets this process keep what it frees, where the C library can (glibc).

    A compiled program's buffers are allocated anew at every call. Large ones come from
    the system, which clears every page again: a quarter of a training step's time.
    Called before threads allocate: each would have a heap of its own.
    """
    _call_glibc("mallopt", _M_ARENA_MAX, 1)
    _call_glibc("mallopt", _M_MMAP_MAX, 0)
    _call_glibc("mallopt", _M_TRIM_THRESHOLD, -1)  # never


def return_freed_memory() -> None:
    """Gives the system what was freed but kept, where the C library can (glibc).

    The compiler's threads leave about a gigabyte for a step of the paper's size.
    """
    _call_glibc("malloc_trim", 0)


def _call_glibc(name: str, *arguments: int) -> None:
    if sys.platform == "linux":
        function = getattr(ctypes.CDLL(None), name, None)
        if function is not None:
            function(*arguments)
