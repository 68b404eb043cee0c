"""Compiling the training step: all processes together, and without its leftovers."""

import ctypes
import sys
from collections.abc import Callable
from typing import Any

import jax
from orbax.checkpoint import multihost

from unips_jax.train_state import TrainState
from unips_jax.train_step import Batch

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


def return_freed_memory() -> None:
    """Gives the system what was freed but kept, where the C library can (glibc).

    The compiler's threads leave about a gigabyte for a step of the paper's size.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
