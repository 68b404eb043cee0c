"""The estimator as a layer of larger models: in `flax.nnx` and in `equinox`.

A network is a tree of arrays and `estimate_normals` is a pure function, so a module
holds the one and calls the other. As an example, what follows is a head that
turns normals into the shading under a learnt light.

    python examples/inside_modules.py
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from unips_jax import NnxNetwork, UniversalNetwork, estimate_normals


class NnxShading(nnx.Module):
    """Images to normals to shading; trains the light, and the network if you like."""

    def __init__(self, network: UniversalNetwork) -> None:
        """Takes a network, as `load_weights` gives it."""
        self.normals = NnxNetwork(network)
        self.light = nnx.Param(jnp.array([0.0, 0.0, 1.0]))

    def __call__(self, images: Array, mask: Array) -> Array:
        """`[N, H, W, 3]` and `[H, W]` to `[H, W]`."""
        return jnp.maximum(self.normals(images, mask) @ self.light[...], 0)


class EquinoxShading(eqx.Module):
    """The same: an equinox module is a tree of arrays itself."""

    network: UniversalNetwork
    light: Array

    def __init__(self, network: UniversalNetwork) -> None:
        """Takes a network, as `load_weights` gives it."""
        self.network = network
        self.light = jnp.array([0.0, 0.0, 1.0])

    def __call__(self, images: Array, mask: Array) -> Array:
        """`[N, H, W, 3]` and `[H, W]` to `[H, W]`."""
        normals = estimate_normals(self.network, images, mask)
        return jnp.maximum(normals @ self.light, 0)


def main() -> None:
    """Both give the same shading, and a gradient for every parameter."""
    from unips_jax import load_weights

    network = load_weights("tiny")
    images = jax.random.uniform(jax.random.key(0), (4, 64, 64, 3))
    mask = jnp.ones((64, 64), bool)
    in_nnx, in_equinox = NnxShading(network), EquinoxShading(network)
    difference = jnp.abs(in_nnx(images, mask) - in_equinox(images, mask)).max()
    print(f"the two differ by {difference:.1e}")
    gradient = nnx.grad(lambda model: model(images, mask).mean())(in_nnx)
    print(f"{len(jax.tree.leaves(gradient))} gradients")


if __name__ == "__main__":
    main()
