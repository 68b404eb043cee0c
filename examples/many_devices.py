"""Many objects on many devices: `shard_map` over objects, nothing is exchanged.

    XLA_FLAGS=--xla_force_host_platform_device_count=8 python examples/many_devices.py

Each device estimates its own objects one after the other, with the same parameters.
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import AxisType, Mesh
from jax.sharding import PartitionSpec as P

from unips_jax import UniversalNetwork, estimate_normals


def estimate_objects(
    network: UniversalNetwork, images: Array, masks: Array, *, mesh: Mesh
) -> Array:
    """Normals of many objects.

    Args:
        network: the same for all.
        images: `[B, N, H, W, 3]`; B is a multiple of the number of devices.
        masks: `[B, H, W]`.
        mesh: of devices, with one axis, "objects".

    Returns:
        `[B, H, W, 3]`, each device holding its own.
    """

    @jax.jit
    @functools.partial(
        jax.shard_map,
        mesh=mesh,
        in_specs=(P(), P("objects"), P("objects")),
        out_specs=P("objects"),
    )
    def run(network: UniversalNetwork, images: Array, masks: Array) -> Array:
        one = functools.partial(estimate_normals, network)
        return jax.lax.map(lambda pair: one(*pair), (images, masks))

    return run(network, images, masks)


def all_devices() -> Mesh:
    """Every device along the one axis."""
    return jax.make_mesh(
        (jax.device_count(),), ("objects",), axis_types=(AxisType.Auto,)
    )


def main() -> None:
    """Sixteen objects of noise."""
    from unips_jax import load_weights

    network = load_weights("tiny")
    images = jax.random.uniform(jax.random.key(0), (16, 3, 64, 64, 3))
    masks = jnp.ones((16, 64, 64), bool)
    normals = estimate_objects(network, images, masks, mesh=all_devices())
    print(f"{normals.shape} on {len(normals.sharding.device_set)} devices")


if __name__ == "__main__":
    main()
