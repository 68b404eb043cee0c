"""Rays through signed distances: camera, surface, what blocks the view of a light.

World and camera axes agree: x right, y up, z towards the viewer. The object fits into
the unit sphere at the origin.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.scenes.grids import pixel_grid
from unips_jax.scenes.meshes import cell_of
from unips_jax.scenes.noise import Point, dot, normalize, rotate
from unips_jax.scenes.sdf import Shape, distance


class Camera(NamedTuple):
    """A camera on the z axis, looking down, and the window its frame shows."""

    perspective: Array  # 1 for a perspective camera, 0 for an orthographic one
    distance: Array  # from the origin; infinite in effect for an orthographic camera
    window: Array  # `[3]`, centre x, y and half size of the frame on the plane z = 0


def object_point(shape: Shape, to_object: Array, point: Point) -> Point:
    """A world point in the object's frame."""
    x, y, z = rotate(to_object, point)
    return x + shape.center[0], y + shape.center[1], z + shape.center[2]


def world_distance(shape: Shape, to_object: Array, point: Point) -> Array:
    """Signed distance without detail, in world units."""
    return distance(shape, object_point(shape, to_object, point)) / shape.radius


def camera_rays(camera: Camera, u: Array, v: Array) -> tuple[Point, Point]:
    """Origins and unit directions of the rays through frame coordinates."""
    x = camera.window[0] + camera.window[2] * u
    y = camera.window[1] + camera.window[2] * v
    p = camera.perspective
    z = jnp.full_like(x, 1.5) + p * (camera.distance - 1.5)
    origin = ((1 - p) * x, (1 - p) * y, z)
    depth = jnp.full_like(x, -1.0) * (1 + p * (camera.distance - 1))
    return origin, normalize((p * x, p * y, depth))


def along(origin: Point, direction: Point, t: Array) -> Point:
    """Points origin + t direction."""
    x, y, z = (o + t * d for o, d in zip(origin, direction, strict=True))
    return x, y, z


def sphere_interval(origin: Point, direction: Point) -> tuple[Array, Array]:
    """Where rays enter and leave the unit sphere."""
    middle = -dot(origin, direction)
    half = jnp.sqrt(jnp.maximum(middle**2 - dot(origin, origin) + 1, 0.0))
    return middle - half, middle + half


def approach(
    shape: Shape, to_object: Array, rays: tuple[Point, Point], cone: Array, steps: int
) -> Array:
    """Sphere-traces until the surface enters a cone around the ray."""
    near, far = sphere_interval(*rays)

    def step(_: int, t: Array) -> Array:
        d = world_distance(shape, to_object, along(*rays, t))
        return jnp.minimum(t + jnp.maximum(d - cone, 0.0), far)

    return jax.lax.fori_loop(0, steps, step, near)


def trace(
    shape: Shape,
    to_object: Array,
    rays: tuple[Point, Point],
    start: Array,
    least: Array | float,
    steps: int,
) -> tuple[Array, Array]:
    """Sphere-traces rays, at least by `least` per step until one is inside.

    The least step carries rays past the walls they graze; once inside, the last two
    distances give the crossing. Returns where the rays arrived and the distance one
    step before.
    """
    _, far = sphere_interval(*rays)

    def step(_: int, carry: tuple[Array, Array, Array, Array]):
        t, last, moved, least = carry
        d = world_distance(shape, to_object, along(*rays, t))
        inside = d < 0
        back = d * jnp.maximum(moved, 0.0) / jnp.maximum(last - d, 1e-6)
        least = jnp.where(inside, 0.0, least)
        advance = jnp.where(inside, back, jnp.maximum(d, least))
        return jnp.minimum(t + advance, far), d, advance, least

    one = jnp.ones_like(start)
    carry = (start, 1e3 * one, 1e-4 * one, least * one)
    t, last, _, _ = jax.lax.fori_loop(0, steps, step, carry)
    return t, last


def first_crossings(
    shape: Shape, to_object: Array, camera: Camera, size: int
) -> tuple[Array, Array]:
    """Traces a camera's rays to the surface, all of them, then those still going.

    Rays that graze a contour, the outline or one in front of another surface, take many
    more steps than others: without the second march every contour would be a gap. It is
    of a third of the rays, those nearest to a surface if more are still going. Returns
    what `trace` does, `[size * size]`.
    """
    pixel = 2 * camera.window[2] / size
    factor = 4
    coarse = camera_rays(camera, *pixel_grid(size // factor))
    start = approach(shape, to_object, coarse, 0.75 * factor * pixel, 12)
    start = start.reshape(size // factor, size // factor)
    start = jnp.repeat(jnp.repeat(start, factor, 0), factor, 1).reshape(-1)
    rays = camera_rays(camera, *pixel_grid(size))
    near, far = sphere_interval(*rays)
    start = jnp.maximum(start - 0.5 * factor * pixel, near)
    t, last = trace(shape, to_object, rays, start, pixel, 20)
    going = (last > 0.5 * pixel) & (t < far)
    _, index = jax.lax.top_k(jnp.where(going, -last, -jnp.inf), size * size // 3)
    few: Any = tuple(tuple(c[index] for c in part) for part in rays)
    later, closer = trace(shape, to_object, few, t[index], pixel, 32)
    return t.at[index].set(later), last.at[index].set(closer)


def gradient(function, point: Point) -> Point:
    """Derivative of a field."""
    # Forward and in a loop: the fields are loops, costly to reverse, and written out
    # the compiler repeats the field for every consumer.

    def slope(tangent: Array) -> Array:
        full = tuple(jnp.full_like(point[0], 1.0) * tangent[i] for i in range(3))
        return jax.jvp(function, (point,), (full,))[1]

    x, y, z = jax.lax.map(slope, jnp.eye(3))
    return x, y, z


def surface_gradient(shape: Shape, to_object: Array, point: Point) -> Point:
    """Derivative of the distance; across a cell of a grid, whose own has steps."""
    if shape.grid is None:
        return gradient(lambda p: world_distance(shape, to_object, p), point)
    half: Array | float = 0.75 * cell_of(shape.grid)
    if shape.is_mesh is not None:
        half = jnp.where(shape.is_mesh, half, 1e-3)

    def slope(axis: Array) -> Array:
        ahead, behind = (
            world_distance(
                shape, to_object, tuple(c + s * axis[i] for i, c in enumerate(point))
            )
            for s in (half, -half)
        )
        return (ahead - behind) / (2 * half)

    return tuple(jax.lax.map(slope, jnp.eye(3)))


def clearance(
    shape: Shape,
    to_object: Array,
    origin: Point,
    direction: Point,
    reach: Array | float,
    *,
    steps: int,
    first: Array | float,
    growth: float,
) -> Array:
    """Closest approach of rays to the object, relative to the distance travelled.

    Negative where the ray enters the object; about the angle, in radians, by which it
    clears it otherwise (I. Quilez's penumbra estimate). The march does not shorten the
    distance for safety as `trace` does (not by more than half): it would end inside
    larger hollows, before it meets their walls. `reach` is how far the light is;
    `first` the length of the first step, `growth` the least of the others, as a share
    of the distance travelled.
    """
    shortening = jnp.maximum(shape.step_scale, 0.5)
    start = jnp.full(jnp.broadcast_shapes(origin[0].shape, direction[0].shape), first)

    def step(_: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        t, closest = carry
        d = world_distance(shape, to_object, along(origin, direction, t)) / shortening
        closest = jnp.minimum(closest, jnp.where(t < reach, d / t, 1e3))
        return t + jnp.maximum(d, growth * t), closest

    carry = (start, jnp.full_like(start, 1e3))
    return jax.lax.fori_loop(0, steps, step, carry)[1]


def soft_visibility(clearance: Array, cosine: Array, sharpness: Array | float) -> Array:
    """How much of a disc of light is seen past the object, in [0, 1].

    An unoccluded plane has the clearance `cosine`, between normal and direction, and
    must not shade itself. `sharpness` is the reciprocal of the light's angular radius.
    """
    plane = jnp.minimum(sharpness * jnp.maximum(cosine, 0.02), 1.0)
    return jnp.clip(sharpness * clearance / plane, 0.0, 1.0)
