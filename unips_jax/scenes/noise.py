"""Noise and waves over points, written as plain arithmetic without table look-ups.

Points are triples (x, y, z) of equally shaped arrays, so that everything fuses into
a few loops.
"""

import jax.numpy as jnp
from jax import Array, lax

Point = tuple[Array, ...]  # x, y and z


def rotate(matrix: Array, point: Point) -> Point:
    """Product of a matrix `[3, 3]` with points."""
    x, y, z = point
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


def dot(a: Point, b: Point) -> Array:
    """Scalar product of triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normalize(a: Point) -> Point:
    """Triples of length one; zero stays zero."""
    inverse = lax.rsqrt(jnp.maximum(dot(a, a), 1e-20))
    return (a[0] * inverse, a[1] * inverse, a[2] * inverse)


def sine(cycles: Array) -> Array:
    """Sine of `2 pi cycles` to 1e-3, continuously differentiable."""
    y = cycles - jnp.round(cycles)
    y = y * (8.0 - 16.0 * jnp.abs(y))
    return y * (0.775 + 0.225 * jnp.abs(y))


def _gradient(h: Array, x: Array, y: Array, z: Array) -> Array:
    h = (h ^ (h >> 15)) * jnp.uint32(0x2C1B3C6D)
    h = (h ^ (h >> 12)) * jnp.uint32(0x297A2D39)
    h = h ^ (h >> 15)
    gx = (h & 1023).astype(jnp.float32) - 511.5
    gy = ((h >> 10) & 1023).astype(jnp.float32) - 511.5
    gz = (h >> 20 & 1023).astype(jnp.float32) - 511.5
    return (gx * x + gy * y + gz * z) * (1 / 512)


def gradient_noise(seed: Array, point: Point) -> Array:
    """Perlin's gradient noise with hashed gradients, cell size 1, in about [-1, 1]."""
    floor = [jnp.floor(c) for c in point]
    x, y, z = (c - f for c, f in zip(point, floor, strict=True))
    cell = [f.astype(jnp.int32).astype(jnp.uint32) for f in floor]
    primes = (jnp.uint32(0x8DA6B343), jnp.uint32(0xD8163841), jnp.uint32(0xCB1AB31F))
    low = [c * p for c, p in zip(cell, primes, strict=True)]
    low[0] = low[0] + seed
    high = [h + p for h, p in zip(low, primes, strict=True)]
    u, v, w = (c * c * c * (c * (c * 6 - 15) + 10) for c in (x, y, z))

    def plane(hz: Array, dz: Array) -> Array:
        a = _gradient(low[0] ^ low[1] ^ hz, x, y, dz)
        b = _gradient(high[0] ^ low[1] ^ hz, x - 1, y, dz)
        c = _gradient(low[0] ^ high[1] ^ hz, x, y - 1, dz)
        d = _gradient(high[0] ^ high[1] ^ hz, x - 1, y - 1, dz)
        near, far = a + u * (b - a), c + u * (d - c)
        return near + v * (far - near)

    bottom, top = plane(low[2], z), plane(high[2], z - 1)
    return bottom + w * (top - bottom)


def pixel_noise(seed: Array, shape: tuple[int, ...]) -> Array:
    """White noise, the sum of four hashed bytes: mean 0, deviation 1, at most 3.5."""
    size = 1
    index = jnp.zeros(shape, jnp.uint32)
    for axis in reversed(range(len(shape))):
        index = index + lax.broadcasted_iota(jnp.uint32, shape, axis) * jnp.uint32(size)
        size *= shape[axis]
    h = index * jnp.uint32(0x9E3779B9) ^ seed
    h = (h ^ (h >> 16)) * jnp.uint32(0x7FEB352D)
    h = (h ^ (h >> 15)) * jnp.uint32(0x846CA68B)
    h = h ^ (h >> 16)
    total = (h & 255) + ((h >> 8) & 255) + ((h >> 16) & 255) + (h >> 24)
    return (total.astype(jnp.float32) - 510.0) * (1 / 147.8)
