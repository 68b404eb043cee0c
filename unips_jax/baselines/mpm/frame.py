"""MPM-style method: the common frame's place in the world, and its signs.

The merged field is known up to an orthogonal matrix. Integrability fixes it up to
convex against concave, but fails under systematic errors of the patches; the
silhouette, where normals lie in the image plane and point outwards, is sturdier. All
turned fields are in the product's frame: x right, y up, z to the viewer.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from scipy import ndimage

from unips_jax.baselines.silhouette import derivatives, silhouette, smooth

_SAMPLES = 4096
_STEPS = 25
_HUBER = 0.1
_LEAST_Z = 0.05


def frame_by_silhouette(
    field: np.ndarray, mask: np.ndarray, *, name: str
) -> np.ndarray:
    """Turns unit normals `[H, W, 3]` so that they face outwards on the silhouette."""
    rim, outward = silhouette(mask, name=name)
    facing = np.zeros((3, 3))
    facing[:, :2] = field[rim].T @ outward / len(outward)
    facing[:, 2] = field[mask].mean(0)
    left, _, right = np.linalg.svd(facing)
    return field @ (left @ right)


def frame_by_integrability(field: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Turns a field so that it becomes the normals of a surface, convex or concave.

    With r1, r2, r3 the sought axes, n is integrable exactly where r1 . (n x dn/dx) + r2
    . (n x dn/dy) = 0. The eigenvector that solves this best is refined, together with
    its images under the cube's symmetries. Field as in `frame_by_silhouette`.
    """
    inner = ndimage.binary_erosion(mask, iterations=3)
    inner = inner if inner.any() else mask
    soft = smooth(field, mask, 2.0)
    turns = [np.cross(soft, slope)[inner] for slope in derivatives(soft)]
    rows = np.concatenate(turns, axis=1)
    rows = rows / max(float(np.sqrt(np.mean(rows**2))), 1e-12)
    smallest = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(2, 3)
    left, _, right = np.linalg.svd(smallest, full_matrices=False)
    first, second = left @ right
    third = np.cross(first, second)
    if np.mean(field[mask] @ third) < 0:
        third = -third
    starts = cube_symmetries() @ np.stack([first, second, third])
    frames, costs = _refine(
        jnp.asarray(starts, jnp.float32),
        jnp.asarray(_resample(rows), jnp.float32),
        jnp.asarray(_resample(field[mask]), jnp.float32),
    )
    left, _, right = np.linalg.svd(np.asarray(frames[jnp.argmin(costs)], float))
    return field @ (left @ right).T


def _resample(rows: np.ndarray) -> np.ndarray:
    # One fixed number of rows, so that the refinement compiles once.
    return rows[np.linspace(0, len(rows) - 1, _SAMPLES).round().astype(int)]


def cube_symmetries() -> np.ndarray:
    """The cube's 48 rotations and reflections, `[48, 3, 3]`."""
    return np.stack(
        [
            np.diag(signs)[list(order)]
            for order in itertools.permutations(range(3))
            for signs in itertools.product((1.0, -1.0), repeat=3)
        ]
    )


@jax.jit
def _refine(starts: Array, rows: Array, field: Array) -> tuple[Array, Array]:
    """Damped Gauss-Newton from every start `[S, 3, 3]`: frames (rows), costs `[S]`."""
    # Minimises the mean pseudo-Huber misfit of integrability plus the mean squared
    # shortfall of n_z below `_LEAST_Z`.

    def cost(frame: Array) -> Array:
        misfit = rows @ frame[:2].reshape(6)
        huber = _HUBER**2 * (jnp.sqrt(1 + (misfit / _HUBER) ** 2) - 1)
        short = jnp.maximum(_LEAST_Z - field @ frame[2], 0)
        return jnp.mean(huber) + jnp.mean(short**2)

    def step(frame: Array, damping: Array) -> Array:
        first, second, third = frame
        misfit = rows @ frame[:2].reshape(6)
        weight = 0.5 / jnp.sqrt(1 + (misfit / _HUBER) ** 2)
        slope = jnp.cross(first, rows[:, :3]) + jnp.cross(second, rows[:, 3:])
        short = jnp.maximum(_LEAST_Z - field @ third, 0)
        fall = -jnp.where(short[:, None] > 0, jnp.cross(third, field), 0)
        heavy = weight[:, None] * slope
        square = heavy.T @ slope + fall.T @ fall
        right = heavy.T @ misfit + fall.T @ short
        scale = damping * jnp.trace(square) / 3 + 1e-12
        damped = square + scale * jnp.eye(3, dtype=square.dtype)
        turn = -jnp.linalg.solve(damped, right)
        x, y, z = turn
        zero = jnp.zeros_like(x)
        spin = jnp.stack(
            [
                jnp.stack([zero, -z, y]),
                jnp.stack([z, zero, -x]),
                jnp.stack([-y, x, zero]),
            ]
        )
        return frame @ jax.scipy.linalg.expm(spin).T

    def advance(_: int, carry: tuple) -> tuple:
        frame, value, damping = carry
        tried = step(frame, damping)
        after = cost(tried)
        better = after < value
        frame = jnp.where(better, tried, frame)
        damping = jnp.where(better, damping / 4, damping * 8)
        return frame, jnp.minimum(value, after), jnp.clip(damping, 1e-6, 1e6)

    def run(start: Array) -> tuple:
        begin = (start, cost(start), jnp.float32(1e-3))
        frame, value, _ = lax.fori_loop(0, _STEPS, advance, begin)
        return frame, value

    return jax.lax.map(run, starts, batch_size=8)
