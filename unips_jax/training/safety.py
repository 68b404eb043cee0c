"""What keeps a training run from harm: checks, a lock, and a way to stop it."""

import contextlib
import math
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from unips_jax.errors import InputError
from unips_jax.io.claims import claim
from unips_jax.io.door import new_file
from unips_jax.training.config import Config
from unips_jax.training.sharding import to_host
from unips_jax.training.step import Batch


class NotFinite(InputError, FloatingPointError):
    """The loss or its gradient is not finite."""


def check_input(config: Config, mesh: Mesh) -> None:
    """Checks that there is data, and that the devices can share it."""
    data = config.data
    if data.batch_size % mesh.size:
        alone = jax.process_count() == 1
        fewer = "fewer devices with --mesh.data" if alone else "fewer processes"
        raise InputError(
            f"--data.batch-size {data.batch_size}: expected a multiple of the "
            f"{mesh.size} devices, which share a batch; change it, or take {fewer}"
        )
    share = data.batch_size // mesh.size
    if share % config.mesh.microbatches:
        raise InputError(
            f"--mesh.microbatches {config.mesh.microbatches}: expected a divisor of "
            f"the {share} objects of a device (--data.batch-size over "
            f"{mesh.size} devices), got none; change one of them"
        )
    if data.source != "scenes" and not data.root:
        raise InputError(
            "--data.root: expected the folder of the training data, got none; give "
            "it, or train on scenes with --data.source scenes"
        )
    if data.source == "scenes" and data.root:
        raise InputError(
            f"--data.root {data.root!r}: expected --data.source folders or mixture "
            "with it, got scenes, which read no folder; add one, or leave it out"
        )
    if data.source != "scenes" and not os.path.isdir(data.root.replace("\0", "")):
        raise InputError(
            f"--data.root {data.root!r}: expected the folder of the training data, "
            "found none; `unips render` makes some"
        )
    if jax.dtypes.canonicalize_dtype(config.model.dtype) != config.model.dtype:
        raise InputError(
            "--model.dtype float64: expected JAX to have such numbers, it has not; set "
            "JAX_ENABLE_X64=1, or take float32"
        )


def check_memory(state: Any, mesh: Mesh) -> None:
    """Refuses a network whose training state alone no device can hold."""
    device = mesh.local_devices[0]  # of others nothing is known here
    most = (device.memory_stats() or {}).get("bytes_limit", 0)
    if device.platform == "cpu" and hasattr(os, "sysconf"):
        most = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    needed = sum(
        math.prod(leaf.sharding.shard_shape(leaf.shape)) * leaf.dtype.itemsize
        for leaf in jax.tree.leaves(state)
        if jax.dtypes.issubdtype(leaf.dtype, np.number)
    )
    if most and needed > most:
        raise InputError(
            f"--model: expected a network whose training fits {most / 2**30:.0f} GB of "
            f"memory, got {needed / 2**30:,.0f} GB of parameters and moments; lower "
            "embed_dim, depths or hidden_dim, or split them with --mesh.fsdp"
        )


@contextlib.contextmanager
def alone_in(workdir: Path) -> Iterator[None]:
    """Keeps other runs out of a folder until the block ends."""
    if jax.process_index() > 0:
        yield
        return
    with claim(workdir / ".lock") as ours:
        if not ours:
            raise InputError(
                f"--workdir {workdir}: expected a folder of this run's own, another "
                "process trains there; wait for it or choose another"
            )
        yield


@contextlib.contextmanager
def stop_on_sigterm() -> Iterator[threading.Event]:
    """Gives an event that is set once the process has been asked to stop."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # Python allows handlers in the main thread only.
        return
    before = signal.signal(signal.SIGTERM, lambda *_: stop.set())
    try:
        yield stop
    finally:
        signal.signal(signal.SIGTERM, before)


def any_process(flag: bool) -> bool:
    """Whether the flag of any process is set; all get the same answer, after a wait."""
    if jax.process_count() == 1:
        return flag
    return bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def check_finite(
    step: int, batch: Batch, metrics: dict[str, jax.Array], workdir: Path
) -> None:
    """Saves the batch and raises `NotFinite` if the step was not finite."""
    loss = float(metrics["loss"])
    if np.isfinite(loss) and np.isfinite(float(metrics["grad_norm"])):
        return
    path = workdir / f"nonfinite_step{step}.npz"
    arrays, _ = jax.tree.flatten_with_path(to_host(batch))
    if jax.process_index() == 0:
        named: dict[str, Any] = {
            jax.tree_util.keystr(k, simple=True, separator="."): x for k, x in arrays
        }
        with new_file(path) as file:
            np.savez(file, **named)
    raise NotFinite(
        f"step {step}: loss {loss} or its gradient is not finite; the batch is in "
        f"{path}. The same run would come here again: choose another --workdir, a "
        "lower --optim.learning-rate and, if there is one, --init-weights "
        f"{workdir / 'best.safetensors'}"
    )
