"""The estimator as a layer of larger models: in `flax.nnx` and in `equinox`.

Parameters are a plain nested dictionary and `estimate_normals` is a pure function, so a
module holds the one and calls the other. As an example, what follows is a head that
turns normals into the shading under a learnt light.

    python examples/inside_modules.py
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from unips_jax import ModelConfig, estimate_normals


class NnxShading(nnx.Module):
    """Images to normals to shading; trains the light, and the network if it is told."""

    def __init__(self, config: ModelConfig, params: dict) -> None:
        """Takes weights, as `load_weights` gives them."""
        self.config = config
        self.network = nnx.data(jax.tree.map(nnx.Param, params))
        self.light = nnx.Param(jnp.array([0.0, 0.0, 1.0]))

    def __call__(self, images: Array, mask: Array) -> Array:
        """`[N, H, W, 3]` and `[H, W]` to `[H, W]`."""
        params = nnx.to_pure_dict(nnx.state(self.network))
        normals = estimate_normals(params, images, mask, config=self.config)
        return jnp.maximum(normals @ self.light[...], 0)


class EquinoxShading(eqx.Module):
    """The same: an equinox module is a tree of arrays itself."""

    network: dict
    light: Array
    config: ModelConfig = eqx.field(static=True)

    def __init__(self, config: ModelConfig, params: dict) -> None:
        """Takes weights, as `load_weights` gives them."""
        self.config = config
        self.network = params
        self.light = jnp.array([0.0, 0.0, 1.0])

    def __call__(self, images: Array, mask: Array) -> Array:
        """`[N, H, W, 3]` and `[H, W]` to `[H, W]`."""
        normals = estimate_normals(self.network, images, mask, config=self.config)
        return jnp.maximum(normals @ self.light, 0)


def main() -> None:
    """Both give the same shading, and a gradient for every parameter."""
    from unips_jax import load_weights

    config, params = load_weights("tiny")
    images = jax.random.uniform(jax.random.key(0), (4, 64, 64, 3))
    mask = jnp.ones((64, 64), bool)
    in_nnx, in_equinox = NnxShading(config, params), EquinoxShading(config, params)
    difference = jnp.abs(in_nnx(images, mask) - in_equinox(images, mask)).max()
    print(f"the two differ by {difference:.1e}")
    gradient = nnx.grad(lambda model: model(images, mask).mean())(in_nnx)
    print(f"{len(jax.tree.leaves(gradient))} gradients")


if __name__ == "__main__":
    main()
