"""Random numbers for scene parameters: one block of uniforms, handed out in order.

One call of the generator per group of parameters instead of one per parameter keeps
the compiled program small.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def seeded(seed: int) -> Array:
    """A key for a seed, of the same numbers whatever `jax_default_prng_impl` is.

    Others than threefry's draw other numbers for many keys together than one by one.
    """
    return jax.random.key(seed, impl="threefry2x32")


class Draws:
    """Hands out independent random numbers; the order of calls is the layout."""

    def __init__(self, key: Array, count: int) -> None:
        """Draws the block of at most `count` numbers."""
        self._block = jax.random.uniform(key, (count,))
        self._used = 0

    def unit(self, *shape: int) -> Array:
        """Uniform in [0, 1), `[*shape]`; `ValueError` if the block is used up."""
        first, self._used = self._used, self._used + math.prod(shape)
        if self._used > self._block.size:
            raise ValueError(
                f"Draws: expected at most {self._block.size} numbers, asked for "
                f"{self._used}; enlarge the block"
            )
        return self._block[first : self._used].reshape(shape)

    def uniform(self, low: ArrayLike, high: ArrayLike, *shape: int) -> Array:
        """Uniform in [low, high), `[*shape]`."""
        low = jnp.asarray(low, jnp.float32)
        return low + (high - low) * self.unit(*shape)

    def log_uniform(self, low: ArrayLike, high: ArrayLike, *shape: int) -> Array:
        """Log-uniform in [low, high), `[*shape]`."""
        return jnp.exp(self.uniform(jnp.log(low), jnp.log(high), *shape))

    def chance(self, rate: ArrayLike, *shape: int) -> Array:
        """True with the given probability, `[*shape]` bool."""
        return self.unit(*shape) < rate

    def choice(self, weights: ArrayLike | Sequence[float], *shape: int) -> Array:
        """Index into `weights` with probability in proportion, `[*shape]` int32."""
        edges = jnp.cumsum(jnp.asarray(weights, jnp.float32))
        value = self.unit(*shape)[..., None] * edges[-1]
        index = jnp.sum(value >= edges, axis=-1)
        return jnp.minimum(index, edges.size - 1).astype(jnp.int32)

    def direction(self, *shape: int) -> Array:
        """Uniform on the sphere, `[*shape, 3]`."""
        z = self.uniform(-1.0, 1.0, *shape)
        angle = self.uniform(0.0, 2 * math.pi, *shape)
        ring = jnp.sqrt(1 - z * z)
        return jnp.stack([ring * jnp.cos(angle), ring * jnp.sin(angle), z], -1)

    def rotation(self, *shape: int) -> Array:
        """Uniform over rotations, `[*shape, 3, 3]` (Shoemake's quaternions)."""
        u = self.unit(*shape)
        a = self.uniform(0.0, 2 * math.pi, *shape)
        b = self.uniform(0.0, 2 * math.pi, *shape)
        x, y = jnp.sqrt(1 - u) * jnp.sin(a), jnp.sqrt(1 - u) * jnp.cos(a)
        z, w = jnp.sqrt(u) * jnp.sin(b), jnp.sqrt(u) * jnp.cos(b)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def rotation_about(axis: int, angle: Array) -> Array:
    """Rotation matrices `[..., 3, 3]` about axis 0, 1 or 2; angles in radians."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rows = [[zero] * 3 for _ in range(3)]
    rows[axis][axis] = one
    rows[first][first], rows[first][second] = cos, -sin
    rows[second][first], rows[second][second] = sin, cos
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
