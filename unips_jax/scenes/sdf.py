"""The signed distance of a shape: primitives in fixed slots, composed branch-free.

Every primitive is the same formula (a rounded rectangle, optionally hollowed to a
ring, extruded and rounded again, then scaled) with different parameters, so that a
batch of different shapes costs one evaluation each. Unions and cuts are smooth.
Waves displace the composition; `detail` adds finer relief that only the surface and
its normals see, not the shadow rays.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from unips_jax.scenes.noise import Point, dot, gradient_noise, rotate, sine

NUM_UNIONS = 5
NUM_CUTS = 2
NUM_SLOTS = NUM_UNIONS + NUM_CUTS
NUM_WAVES = 5


class Primitives(NamedTuple):
    """Parameters of K primitives.

    Attributes:
        center: `[K, 3]`.
        rotation: `[K, 3, 3]`, from the object's frame to the primitive's.
        inverse_scale: `[K, 3]`, coordinates are multiplied by it (ellipsoids).
        min_scale: `[K]`, smallest scale, which keeps distances from overshooting.
        extent: `[K, 3]`, half extents before scaling.
        corner: `[K]`, radius of the corners of the x-y rectangle.
        hole: `[K]`, half thickness of the ring; 0 for solid primitives.
        edge: `[K]`, radius of the edges of the extrusion.
        blend: `[K]`, width of the smooth union with (or cut from) what came before.
        absent: `[K]`, added to the distance; large where the slot is empty.
    """

    center: Array
    rotation: Array
    inverse_scale: Array
    min_scale: Array
    extent: Array
    corner: Array
    hole: Array
    edge: Array
    blend: Array
    absent: Array


class Detail(NamedTuple):
    """Fine relief: noise of two octaves plus one pattern.

    Attributes:
        seed: uint32.
        rotation: `[3, 3]`, from the object's frame to the pattern's.
        frequency: cells per unit of length.
        noise: amplitude of the noise.
        groove, ridge, dimple, weave: amplitudes of the patterns.
        groove_width: share of a cell.
    """

    seed: Array
    rotation: Array
    frequency: Array
    noise: Array
    groove: Array
    ridge: Array
    dimple: Array
    weave: Array
    groove_width: Array


class Shape(NamedTuple):
    """One object in its own frame, where it fits into a sphere.

    Attributes:
        primitives: the slots; the last `NUM_CUTS` are cut away.
        sign: `[K]`, 1 for slots that are added, -1 for those cut away.
        lathe: 1 where the object is turned about y, else 0.
        mirror: 1 where it is symmetric in x, else 0.
        twist: radians per unit along y.
        wave_vector: `[W, 3]`, cycles per unit.
        wave_phase: `[W]`, cycles.
        wave_amplitude: `[W]`.
        wave_warp: cycles by which a unit of displacement shifts the next wave.
        wave_ridge: 0 for smooth waves, 1 for creases.
        step_scale: factor that makes the distance safe to march.
        detail: fine relief.
        center: `[3]` and
        radius: scalar, a sphere around everything.
        kind: index into `SHAPE_KINDS`.
    """

    primitives: Primitives
    sign: Array
    lathe: Array
    mirror: Array
    twist: Array
    wave_vector: Array
    wave_phase: Array
    wave_amplitude: Array
    wave_warp: Array
    wave_ridge: Array
    step_scale: Array
    detail: Detail
    center: Array
    radius: Array
    kind: Array


def _primitive(p: Primitives, point: Point) -> Array:
    """Distance to one primitive; the leaves of `p` have no slot axis here."""
    c = p.center
    local = (point[0] - c[0], point[1] - c[1], point[2] - c[2])
    x, y, z = rotate(p.rotation, local)
    scale, extent, corner, hole, edge = (
        *(p.inverse_scale, p.extent, p.corner, p.hole, p.edge),
    )
    dx = jnp.abs(x * scale[0]) - extent[0]
    dy = jnp.abs(y * scale[1]) - extent[1]
    dz = jnp.abs(z * scale[2]) - extent[2]
    rx, ry = jnp.maximum(dx + corner, 0.0), jnp.maximum(dy + corner, 0.0)
    inner = jnp.minimum(jnp.maximum(dx, dy), -corner)
    ring = jnp.abs(jnp.sqrt(rx * rx + ry * ry + 1e-12) + inner + hole) - hole
    ex, ez = jnp.maximum(ring + edge, 0.0), jnp.maximum(dz + edge, 0.0)
    inner = jnp.minimum(jnp.maximum(ring, dz), -edge)
    d = jnp.sqrt(ex * ex + ez * ez + 1e-12) + inner
    return d * p.min_scale + p.absent


def _fold(shape: Shape, point: Point) -> Point:
    x, y, z = point
    turn = shape.twist * y * 0.15915494
    sin, cos = sine(turn), sine(turn + 0.25)
    x, z = cos * x - sin * z, sin * x + cos * z
    around = jnp.sqrt(x * x + z * z + 1e-6)
    side = jnp.sqrt(x * x + 4e-4)
    x = x + shape.lathe * (around - x) + shape.mirror * (side - x)
    return x, y, z - shape.lathe * z


def _displace(shape: Shape, point: Point, d: Array) -> Array:
    """Subtracts waves, each shifted by the displacement before it."""
    x, y, z = point
    base = d

    def add(d: Array, wave: tuple[Array, Array, Array]) -> tuple[Array, None]:
        k, phase, amplitude = wave
        phase = phase + k[0] * x + k[1] * y + k[2] * z
        value = sine(phase + shape.wave_warp * (base - d))
        crease = 1.4 * jnp.sqrt(value * value + 0.01) - 1.0
        value = value + shape.wave_ridge * (crease - value)
        return d - amplitude * value, None

    waves = (shape.wave_vector, shape.wave_phase, shape.wave_amplitude)
    return lax.scan(add, d, waves)[0]


def distance(shape: Shape, point: Point) -> Array:
    """Signed distance to the shape without its detail, negative inside.

    The slots are composed in a loop: written out, the compiler's fusion repeats
    their common parts.

    Args:
        shape: parameters.
        point: in the object's frame.

    Returns:
        A lower bound of the distance (approximately), scaled to be safe to march.
    """
    folded = _fold(shape, point)

    def compose(d: Array, slot: tuple[Primitives, Array]) -> tuple[Array, None]:
        p, sign = slot
        d, e = sign * d, _primitive(p, folded)
        h = jnp.maximum(p.blend - jnp.abs(d - e), 0.0)
        return sign * (jnp.minimum(d, e) - h * h * (0.25 / p.blend)), None

    empty = jnp.full_like(point[0], 1e3)
    d, _ = lax.scan(compose, empty, (shape.primitives, shape.sign))
    return _displace(shape, point, d) * shape.step_scale


def _cell(cycles: Array) -> Array:
    return cycles - jnp.round(cycles)


def detail(shape: Shape, point: Point) -> Array:
    """Height of the fine relief above the shape, `[...]`, in units of length.

    Args:
        shape: parameters.
        point: in the object's frame.
    """
    d = shape.detail
    fx, fy, fz = (c * d.frequency for c in rotate(d.rotation, point))
    coarse = gradient_noise(d.seed, (fx, fy, fz))
    fine = gradient_noise(d.seed + 1, (2 * fy + 0.5, 2 * fz + 0.5, 2 * fx + 0.5))
    height = d.noise * (coarse + 0.5 * fine)
    warp = 0.1 * coarse
    nearest = 0.5 - jnp.maximum(jnp.abs(_cell(fx + warp)), jnp.abs(_cell(fy + warp)))
    groove = jnp.clip(nearest / d.groove_width, 0.0, 1.0)
    height = height - d.groove * (1 - groove * groove * (3 - 2 * groove))
    height = height + d.ridge * sine(0.7 * fz + 2 * warp)
    cell = (_cell(0.7 * fx), _cell(0.7 * fy), _cell(0.7 * fz))
    bump = jnp.maximum(1 - 5.0 * dot(cell, cell), 0.0)
    height = height + d.dimple * bump * bump
    return height + d.weave * sine(fx) * sine(fy)


def surface(shape: Shape, point: Point) -> Array:
    """Implicit function of the displaced surface: zero on it, negative inside.

    Args:
        shape: parameters.
        point: in the object's frame.
    """
    return distance(shape, point) - detail(shape, point) * shape.step_scale
