"""The balloon: the surface of least area over a mask that holds a given volume.

The start of the variational method, and a floor for every table: what the silhouette
alone shows. Heights are in pixels, positive towards the viewer, zero on the mask's
boundary.

Source: Oswald et al. / Haefner et al., "Variational uncalibrated photometric stereo
under general lighting" (ICCV 2019), initialisation.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from scipy import ndimage

from unips_jax.baselines.grid import forward, integrate, shift
from unips_jax.baselines.method import Method, Observed, Unsupported
from unips_jax.baselines.pixels import normal_map

_DIRECT_SIZE = 96
_BURST = 50  # iterations between two looks at the area: float32 cannot see one
_TOLERANCE = 1e-7  # least change of the area per iteration, as a share of it
_LIMIT = 10_000  # iterations at most


def balloon(mask: Array, volume: Array | float) -> Array:
    """Blows a balloon up over a mask, by projected gradient descent on its area.

    `volume` is the mean height over the mask, in pixels, > 0. Returns heights `[H, W]`,
    float32, >= 0 up to rounding; zero outside and on the boundary (the mask minus its
    erosion by a 3x3 cross, the image's border counting as outside).
    """
    mask = jnp.asarray(mask, bool)
    start = jnp.ones(mask.shape, jnp.float32)
    if max(mask.shape) > _DIRECT_SIZE:
        # The minimum is the same from any start; from half the resolution it is near.
        height, width = (2 * (side // 2) for side in mask.shape)
        quarters = mask[:height, :width].reshape(height // 2, 2, width // 2, 2)
        coarse = balloon(jnp.sum(quarters, (1, 3)) >= 2, volume / 2)
        start = 2 * jax.image.resize(coarse, mask.shape, "linear")
    return _balloon(mask, start, jnp.float32(volume))


@jax.jit
def _balloon(mask: Array, start: Array, volume: Array) -> Array:
    inner = mask
    for rows, columns in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        inner = inner & shift(mask, rows, columns)
    count = jnp.maximum(jnp.sum(mask), 1)
    shape = jax.ShapeDtypeStruct(mask.shape, jnp.float32)

    def gradient(height: Array) -> Array:
        return forward(height, mask, closed=True)

    def root(slope: Array) -> Array:
        return jnp.sqrt(1 + jnp.sum(slope**2, axis=0))

    def step(height: Array) -> Array:
        slope = gradient(height)
        flow = jax.linear_transpose(gradient, shape)(slope / root(slope))[0]
        height = jnp.where(inner, height - (0.8 / 8**0.5) * flow, 0.0)
        lift = volume - jnp.sum(height) / count
        return jnp.where(mask, height + lift, 0.0)

    def area(height: Array) -> Array:
        return jnp.sum(jnp.where(mask, root(gradient(height)), 0.0))

    def unfinished(carry: tuple) -> Array:
        _, before, now, done = carry
        return (jnp.abs(now - before) >= _BURST * _TOLERANCE * now) & (done < _LIMIT)

    def burst(carry: tuple) -> tuple:
        height, _, now, done = carry
        height = lax.fori_loop(0, _BURST, lambda _, h: step(h), height)
        return height, now, area(height), done + _BURST

    start = jnp.where(mask, start, 0.0)
    carry = burst((start, jnp.float32(0), area(start), 0))
    height = lax.while_loop(unfinished, burst, carry)[0]
    return jnp.where(inner, height, 0.0)


def relief_normals(height: Array, mask: Array) -> Array:
    """Normals of an orthographic relief, by forward differences.

    `height` is `[H, W]`, towards the viewer, in pixels, zero outside the mask. Returns
    `[3, H, W]`, unit length in the camera frame (x right, y down, z away from the
    camera); zero outside the mask.
    """
    slope = forward(height, mask, closed=False)
    normals = jnp.stack([-slope[0], -slope[1], -jnp.ones_like(height)])
    normals = normals / jnp.linalg.norm(normals, axis=0)
    return jnp.where(mask, normals, 0.0)


@jax.jit
def perspective_depth(
    height: Array, mask: Array, u: Array, v: Array, focal: Array | float
) -> Array:
    """Depth of a perspective surface with the normals of an orthographic relief.

    `height` is `[H, W]`, towards the viewer; `u` and `v` `[H, W]` are columns and rows
    counted from the principal point; all in pixels, as the focal length. Returns depth
    `[H, W]`, positive inside the mask where its logarithm has mean 1, zero outside.
    Slopes seen at more than 85 degrees from the viewing ray are ignored.
    """
    normals = relief_normals(height, mask)
    rays = jnp.stack([u / focal, v / focal, jnp.ones_like(u)])
    along = jnp.sum(rays * normals, axis=0)
    cosine = -along / jnp.linalg.norm(rays, axis=0)
    steep = ~mask | (cosine <= np.cos(np.deg2rad(85.0)))
    slopes = -normals[:2] / focal / jnp.where(steep, 1.0, along)
    log_depth = integrate(jnp.where(steep, 0.0, slopes), mask) + 1
    return jnp.where(mask, jnp.exp(log_depth), 0.0)


def to_product_frame(normals: Array, mask: np.ndarray) -> np.ndarray:
    """Turns camera-frame normals (y down, z away) of any length into ours.

    `[3, H, W]` becomes `[H, W, 3]`, float32, unit length (x right, y up, z to the
    viewer), zero outside the mask; (0, 0, 1) where the length was zero.
    """
    turned = np.moveaxis(np.asarray(normals), 0, -1)[mask] * np.array([1, -1, -1])
    return normal_map(turned, mask)


def hemisphere(*, volume: float | None = None) -> Method:
    """Makes the floor that looks at the mask only: a balloon's normals.

    `volume` is its mean height in pixels, > 0; None: twice the mean distance to the
    silhouette, which turns a disc into a hemisphere.
    """
    if volume is not None and not volume > 0:
        raise ValueError(f"volume: expected pixels > 0, got {volume!r}")

    def method(observed: Observed) -> np.ndarray:
        mask = np.asarray(observed.mask) > 0
        if not mask.any():
            raise Unsupported("hemisphere: needs a mask of the object; it is empty")
        distance = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
        wanted = 2 * distance[mask].mean() if volume is None else volume
        height = balloon(jnp.asarray(mask), wanted)
        return to_product_frame(_smooth_normals(height, jnp.asarray(mask)), mask)

    return method


@jax.jit
def _smooth_normals(height: Array, mask: Array) -> Array:
    # Averaging forward and backward differences keeps the floor centred on its mask.
    right, down = forward(height, mask, closed=False)
    slope_x, slope_y = right + shift(right, 0, -1), down + shift(down, -1, 0)
    normals = jnp.stack([-slope_x / 2, -slope_y / 2, -jnp.ones_like(height)])
    return jnp.where(mask, normals, 0.0)
