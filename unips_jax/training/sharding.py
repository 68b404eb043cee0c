"""Where arrays live: batches split over devices, parameters too if asked (FSDP).

One jitted step serves all; only these shardings differ.
"""

from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from unips_jax.errors import InputError
from unips_jax.training.config import MeshConfig

# Smaller arrays are not worth splitting.
_MIN_SPLIT = 2**14


def make_mesh(config: MeshConfig) -> Mesh:
    """A mesh with the axes "data" and "fsdp"."""
    devices = jax.device_count()
    data = config.data or devices // config.fsdp
    if data * config.fsdp > devices or data == 0:
        raise InputError(
            f"--mesh.data {config.data} --mesh.fsdp {config.fsdp}: expected no more "
            f"than the {devices} devices there are; lower one of them"
        )
    if jax.process_count() > 1 and data * config.fsdp != devices:
        raise InputError(
            f"--mesh.data {config.data} --mesh.fsdp {config.fsdp}: expected all "
            f"{devices} devices of the {jax.process_count()} processes, got "
            f"{data * config.fsdp}; leave --mesh.data out, or start fewer processes"
        )
    used = jax.devices()[: data * config.fsdp]
    return jax.make_mesh(
        (data, config.fsdp),
        ("data", "fsdp"),
        axis_types=(AxisType.Auto, AxisType.Auto),
        devices=used,
    )


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Objects of a batch, split over all devices."""
    return NamedSharding(mesh, P(("data", "fsdp")))


def replicated(mesh: Mesh) -> NamedSharding:
    """The same everywhere."""
    return NamedSharding(mesh, P())


def state_sharding(state: Any, mesh: Mesh) -> Any:
    """Shardings of a training state, or of its shapes: large arrays are split."""
    # Each along its longest axis that the devices of "fsdp" divide; source: big_vision.
    parts = mesh.shape["fsdp"]

    def choose(array: Any) -> NamedSharding:
        if parts == 1 or array.size < _MIN_SPLIT:
            return replicated(mesh)
        for axis in np.argsort(array.shape)[::-1]:
            if array.shape[axis] % parts == 0:
                spec: list[str | None] = [None] * array.ndim
                spec[axis] = "fsdp"
                return NamedSharding(mesh, P(*spec))
        return replicated(mesh)

    return jax.tree.map(choose, state)


def to_host(tree: Any) -> Any:
    """NumPy arrays of whole device arrays, whichever process holds their parts."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    from jax.experimental import multihost_utils

    return multihost_utils.process_allgather(tree, tiled=True)
