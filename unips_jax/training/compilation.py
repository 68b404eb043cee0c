"""Compiling the training step, all processes together."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import jax
from orbax.checkpoint import multihost

from unips_jax.training.state import TrainState
from unips_jax.training.step import Batch

Step = Callable[[TrainState, Batch, jax.Array], tuple[TrainState, dict[str, jax.Array]]]


def compile_together(
    step: Any, compiling: Callable[[str], AbstractContextManager[None]]
) -> Step:
    """The jitted step; no process runs it before all have compiled it.

    Processes do not compile equally fast, and collectives between them give up after
    half a minute on CPU. `compiling` is entered, with what it is, for every
    compilation: one for every shape of batch.
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
                wait(key=f"compiled {types}", timeout_ms=3_600_000)
        return compiled[types](state, batch, key)

    return run
