"""Compiling the training step, all processes together; and what becomes of memory."""

import ctypes
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import jax
from orbax.checkpoint import multihost

from unips_jax.training.state import TrainState
from unips_jax.training.step import Batch

# Options of mallopt, as malloc.h numbers them.
_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8
# Sizes of holes worth taking, in bytes: smaller ones are found fast.
_HOLES = [2**n for n in range(20, 13, -1)]

Step = Callable[[TrainState, Batch, jax.Array], tuple[TrainState, dict[str, jax.Array]]]


def compile_together(
    step: Any,
    compiling: Callable[[str], AbstractContextManager[None]],
    settle: Callable[[], None],
) -> Step:
    """The jitted step; no process runs it before all have compiled it.

    Processes do not compile equally fast, and collectives between them give up after
    half a minute on CPU.

    Args:
        step: what `jax.jit` gave.
        compiling: entered, with what it is, for every compilation.
        settle: called after it, from `keep_freed_memory`, or `return_freed_memory`.

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
            with compiling(f"the step for sets of {count} images"):
                compiled[types] = step.lower(state, batch, key).compile()
                settle()
                wait(key=f"compiled {types}", timeout_ms=3_600_000)
        return compiled[types](state, batch, key)

    return run


def keep_freed_memory() -> Callable[[], None]:
    """Lets this process keep what it frees, where the C library can (glibc).

    A compiled program's buffers are allocated anew at every call. Large ones come from
    the system, which clears every page again: a quarter of a training step's time.
    Called before threads allocate: each would have a heap of its own.

    Returns:
        What to call after compiling: `settle_memory`.
    """
    if library := _glibc():
        library.mallopt(_M_ARENA_MAX, 1)
        library.mallopt(_M_MMAP_MAX, 0)
        library.mallopt(_M_TRIM_THRESHOLD, -1)  # never
    return settle_memory


def return_freed_memory() -> None:
    """Gives the system what was freed but kept, where the C library can (glibc).

    The compiler leaves about a gigabyte for a step of the paper's size.
    """
    if library := _glibc():
        library.malloc_trim(0)


def settle_memory() -> None:
    """After compiling: returns freed memory, and takes the holes that are left.

    The compiler leaves tens of thousands of holes, of as many sizes, between blocks in
    use. glibc looks through them at every allocation: an eighth of a training step's
    time. Taken for good but never touched, they cost addresses and a page each.
    """
    return_freed_memory()
    if library := _glibc():
        library.sbrk.restype = library.malloc.restype = ctypes.c_size_t
        end = library.sbrk(ctypes.c_ssize_t(0))
        for size in _HOLES:
            while 0 < library.malloc(ctypes.c_size_t(size)) < end:
                pass


def _glibc() -> ctypes.CDLL | None:
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return library if hasattr(library, "mallopt") else None
