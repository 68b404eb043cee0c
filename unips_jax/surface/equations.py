"""The equations that turn normals into depth, stated once.

Conventions. Row 0 of an image is at the top. Normals are x right, y up, z towards the
viewer. Depth grows away from the viewer, so a point's z in the normals' frame is minus
its depth. A camera is orthographic, or perspective with a focal length f in pixels and
a principal point; the unknown `d`, `[H, W]`, is then

    orthographic:  depth in pixels,
    perspective:   f * log(distance along the optical axis),

which tends to the former as f grows. A tangent plane obeys, with u to the right and v
down,

    m d_u = n_x,    m d_v = -n_y,    m = n_z - n_x (u - c_u) / f + n_y (v - c_v) / f,

(m = n_z without perspective). Each pixel states them for the difference to either side,
and a weight chooses between the sides: in u

    E = sum w (m (d_right - d) - n_x)^2 + (1 - w) (m (d - d_left) - n_x)^2,
    w = sigmoid(k (m (d - d_left))^2 - k (m (d_right - d))^2),

and the same in v. Where the depth jumps to one side, the pixel follows the other. For
fixed weights E is a sum over the edges between neighbours: a weighted graph Laplacian.

Source: Cao, Santo, Shi, Okura, Matsushita, "Bilateral Normal Integration" (ECCV 2022),
Secs. 3-5. A side without a neighbour counts as one without difference. Departure: an
edge asks for the difference that the mean of its two normals has, which is exact on
spheres; the least squares of the two pixels' statements makes silhouettes too flat (on
a hemisphere of 512 pixels, by up to 0.02 of the radius). So the weights are how much an
edge counts, not which of its ends it believes.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

_LEAST = 0.005  # of m: bounds what a noisy normal near 90 degrees asks for


class Statements(NamedTuple):
    """What each pixel states of the depth around it, all `[H, W]`."""

    m: jax.Array  # cosine-like factor of the differences, above 0
    right: jax.Array  # m times the slope to the right
    down: jax.Array  # m times the slope down the rows
    inside: jax.Array  # whether the pixel has a depth


class Edges(NamedTuple):
    """A number for each edge to the right and to the lower neighbour, `[H, W]` each."""

    right: jax.Array
    down: jax.Array


def statements(
    normals: jax.Array,
    mask: jax.Array,
    focal: jax.Array | float | None,
    principal_point: tuple[jax.Array | float, jax.Array | float] | None,
) -> Statements:
    """What normals `[H, W, 3]` state of the depth; harmless where there is none."""
    normals = normals.astype(jnp.float32)
    inside = mask & jnp.isfinite(normals).all(-1) & (jnp.abs(normals).max(-1) > 0)
    normals = jnp.where(inside[..., None], normals, jnp.float32([0, 0, 1]))
    # By the largest first: the square of a very short one is 0.
    normals = normals / jax.lax.stop_gradient(jnp.abs(normals).max(-1, keepdims=True))
    normals = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
    x, y, m = normals[..., 0], normals[..., 1], normals[..., 2]
    if focal is not None:
        height, width = mask.shape
        middle = ((width - 1) / 2, (height - 1) / 2)
        column, row = middle if principal_point is None else principal_point
        across = jnp.arange(width, dtype=jnp.float32)[None, :] - column
        down = jnp.arange(height, dtype=jnp.float32)[:, None] - row
        m = m - x * across / focal + y * down / focal
    return Statements(jnp.maximum(m, _LEAST), x, -y, inside)


def links(inside: jax.Array) -> Edges:
    """The edges that have both ends inside: bool, from `[H, W]` bool."""
    return Edges(inside & to_left(inside), inside & to_top(inside))


def differences(depth: jax.Array) -> Edges:
    """Each neighbour's value minus the pixel's own; without a neighbour, minus that."""
    return Edges(to_left(depth) - depth, to_top(depth) - depth)


def balance(flow: Edges) -> jax.Array:
    """What flows into each pixel from left and top minus what flows out: `[H, W]`.

    The transpose of `differences`, up to the edges that leave the image.
    """
    across = to_right(flow.right) - flow.right
    return across + to_bottom(flow.down) - flow.down


def system(
    stated: Statements, depth: jax.Array, sharpness: jax.Array | float
) -> tuple[Edges, Edges]:
    """The weighted least squares around a depth: each edge's stiffness and difference.

    The depth decides the weights, whose k is `sharpness`; 0 makes them equal.
    """
    linked, step = links(stated.inside), differences(depth)
    right = _axis(
        stated.m, stated.right, linked.right, step.right, to_left, to_right, sharpness
    )
    down = _axis(
        stated.m, stated.down, linked.down, step.down, to_top, to_bottom, sharpness
    )
    return Edges(right[0], down[0]), Edges(right[1], down[1])


def _axis(
    m: jax.Array,
    slope: jax.Array,
    linked: jax.Array,
    step: jax.Array,
    ahead: Callable[[jax.Array], jax.Array],
    behind: Callable[[jax.Array], jax.Array],
    sharpness: jax.Array | float,
) -> tuple[jax.Array, jax.Array]:
    """`system` along one axis, whose neighbours `ahead` and `behind` fetch."""
    step = jnp.where(linked, step, 0)
    onward, backward = m * step, m * behind(step)
    forward = jax.nn.sigmoid(sharpness * (backward**2 - onward**2))
    stiffness = forward * m**2 + ahead((1 - forward) * m**2)
    asked = (slope + ahead(slope)) / jnp.where(linked, m + ahead(m), 1)
    return jnp.where(linked, stiffness, 0), jnp.where(linked, asked, 0)


def to_left(values: jax.Array) -> jax.Array:
    """Each pixel takes its right neighbour's value, 0 at the border: `[H, W]`."""
    return jnp.pad(values[:, 1:], ((0, 0), (0, 1)))


def to_right(values: jax.Array) -> jax.Array:
    """Each pixel takes its left neighbour's value, 0 at the border: `[H, W]`."""
    return jnp.pad(values[:, :-1], ((0, 0), (1, 0)))


def to_top(values: jax.Array) -> jax.Array:
    """Each pixel takes the value below it, 0 at the border: `[H, W]`."""
    return jnp.pad(values[1:], ((0, 1), (0, 0)))


def to_bottom(values: jax.Array) -> jax.Array:
    """Each pixel takes the value above it, 0 at the border: `[H, W]`."""
    return jnp.pad(values[:-1], ((1, 0), (0, 0)))
