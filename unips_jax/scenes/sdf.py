"""The signed distance of a shape: primitives in fixed slots, composed branch-free.

Every primitive is the same formula (a rounded rectangle, optionally hollowed to a
ring, extruded and rounded again, then scaled) with different parameters, so that a
batch of different shapes costs one evaluation each. Unions and cuts are smooth.
Waves displace the composition; `detail` is a finer relief that tilts the normals and
that rays do not see.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from unips_jax.scenes.meshes import grid_distance
from unips_jax.scenes.noise import Point, dot, gradient_noise, rotate, sine

NUM_UNIONS = 4
NUM_CUTS = 2
NUM_SLOTS = NUM_UNIONS + NUM_CUTS
NUM_WAVES = 5
NUM_KNOTS = 5
SOLID = 8.0
_ABSENT = 22  # its column in a packed slot


class Primitives(NamedTuple):
    """Parameters of K primitives."""

    center: Array  # `[K, 3]`
    rotation: Array  # `[K, 3, 3]`, from the object's frame to the primitive's
    scale: Array  # `[K, 3]`, by which the primitive is stretched (ellipsoids)
    extent: Array  # `[K, 3]`, half extents before scaling
    corner: Array  # `[K]`, radius of the corners of the x-y rectangle
    hole: Array  # `[K]`, half thickness of the ring; `SOLID` for solid primitives
    edge: Array  # `[K]`, radius of the edges of the extrusion
    blend: Array  # `[K]`, width of the smooth union with (or cut from) what came before
    absent: Array  # `[K]`, added to the distance; large where the slot is empty


def pack(p: Primitives) -> Array:
    """One row per slot, as the inner loop reads it, `[K, 24]`."""
    matrix = p.rotation / p.scale[:, :, None]
    offset = jnp.einsum("kij,kj->ki", matrix, p.center)
    slots = p.blend.shape[0]
    sign = jnp.where(jnp.arange(slots) < NUM_UNIONS, 1.0, -1.0)
    rest = jnp.stack([p.corner, p.hole, p.edge, p.blend, p.absent, sign], -1)
    columns = [matrix.reshape(slots, 9), offset, p.extent, 1 / p.scale, rest]
    return jnp.concatenate(columns, -1)


class Detail(NamedTuple):
    """Fine relief: noise of two octaves plus one pattern."""

    seed: Array  # uint32
    rotation: Array  # `[3, 3]`, from the object's frame to the pattern's
    frequency: Array  # cells per unit of length
    noise: Array  # amplitudes of the noise, and of the patterns
    groove: Array
    ridge: Array
    dimple: Array
    weave: Array
    groove_width: Array  # share of a cell


class Shape(NamedTuple):
    """One object in its own frame, where it fits into a sphere."""

    slots: Array  # `[K, 24]`, see `pack`; the last `NUM_CUTS` are cut away
    lathe: Array  # 1 where the object is turned about y, else 0
    mirror: Array  # 1 where it is symmetric in x, else 0
    twist: Array  # radians per unit along y
    # `[P, 3]`, how wide the object is at heights from -1 to 1, the bottom and top of
    # its sphere: rows hold a knot's height, the length over which it is rounded and
    # half the bend there; see `profile_through`
    profile: Array
    # `[2]`: a height y and half a thickness; what is not between these two planes is
    # cut away
    slab: Array
    waves: Array  # `[W, 5]`: cycles per unit (3), phase in cycles, amplitude
    wave_warp: Array  # cycles by which a unit of displacement shifts the next wave
    wave_ridge: Array  # 0 for smooth waves, 1 for creases
    step_scale: Array  # factor that makes the distance safe to march
    detail: Detail
    center: Array  # `[3]`, of a sphere around everything
    radius: Array
    kind: Array  # index into `SHAPE_NAMES`
    # `[G, G, G]`, of a mesh instead; None where no scene has one
    grid: Array | None = None
    # `[3]`, by which the mesh is stretched, mirrored where negative
    stretch: Array | None = None
    is_mesh: Array | None = None  # whether the grid is the shape; None: always


def _larger(a: Array, b: Array | float) -> Array:
    """Maximum of finite numbers: one instruction, without the check for NaN."""
    return jnp.where(a > b, a, b)


def _smaller(a: Array, b: Array | float) -> Array:
    return jnp.where(a < b, a, b)


def _compose(d: Array, slot: Array, point: Point) -> Array:
    """Adds one slot `[24]` to (or cuts it from) the distance so far."""
    x, y, z = point
    corner, hole, edge, blend, absent, sign = (slot[i] for i in range(18, 24))
    q = tuple(
        slot[3 * i] * x + slot[3 * i + 1] * y + slot[3 * i + 2] * z - slot[9 + i]
        for i in range(3)
    )
    # Stretching divides the gradient by this; 1 where nothing is stretched.
    inverse = tuple(q[i] * slot[15 + i] for i in range(3))
    scale = lax.rsqrt((dot(inverse, inverse) + 1e-9) / (dot(q, q) + 1e-9))
    dx, dy, dz = (jnp.abs(q[i]) - slot[12 + i] for i in range(3))
    rx, ry = _larger(dx + corner, 0.0), _larger(dy + corner, 0.0)
    inner = _smaller(_larger(dx, dy), -corner)
    ring = jnp.abs(jnp.sqrt(rx * rx + ry * ry + 1e-12) + inner + hole) - hole
    ex, ez = _larger(ring + edge, 0.0), _larger(dz + edge, 0.0)
    inner = _smaller(_larger(ring, dz), -edge)
    e = (jnp.sqrt(ex * ex + ez * ez + 1e-12) + inner) * scale + absent
    d = sign * d
    h = _larger(blend - jnp.abs(d - e), 0.0)
    return sign * (_smaller(d, e) - h * h * (0.25 / blend))


def profile_through(heights: Array, widths: Array, rounding: Array | float) -> Array:
    """The `Shape.profile` `[P, 3]` that is linear between knots.

    At the height y it is the sum of half bends times |y - height|. `heights` `[P]` rise
    from -1 to 1, in radii of the object's sphere; `widths` `[P]` are in (0, 1]; knots
    between the ends are rounded over the height `rounding`.
    """
    slopes = jnp.diff(widths) / jnp.diff(heights)
    ends = 0.5 * (widths[:1] + widths[-1:])
    before = jnp.concatenate([-ends, slopes])
    after = jnp.concatenate([slopes, ends])
    lengths = jnp.full_like(heights, rounding).at[jnp.array([0, -1])].set(0.0)
    return jnp.stack([heights, lengths, 0.5 * (after - before)], -1)


def _width(shape: Shape, y: Array) -> Array:
    """The share of its width that the object keeps at y, in (0, 1]."""
    height = jnp.clip((y - shape.center[1]) / shape.radius, -1.0, 1.0)
    width = jnp.zeros_like(y)
    for at, length, bend in shape.profile:
        away = height - at
        width += bend * jnp.sqrt(away * away + length * length + 1e-9)
    return width


def _fold(shape: Shape, point: Point, width: Array) -> Point:
    x, y, z = point
    x, z = x / width, z / width
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

    def add(d: Array, wave: Array) -> tuple[Array, None]:
        phase = wave[3] + wave[0] * x + wave[1] * y + wave[2] * z
        value = sine(phase + shape.wave_warp * (base - d))
        crease = 1.4 * jnp.sqrt(value * value + 0.01) - 1.0
        value = value + shape.wave_ridge * (crease - value)
        return d - wave[4] * value, None

    return lax.scan(add, d, shape.waves)[0]


def without_cuts(shape: Shape) -> Shape:
    """The shape before anything was cut from it."""
    return shape._replace(slots=shape.slots.at[NUM_UNIONS:, _ABSENT].set(1e3))


def distance(shape: Shape, point: Point) -> Array:
    """Signed distance without detail, in the shape's frame, safe to march by."""
    if shape.grid is None:
        return _drawn_distance(shape, point)
    if shape.is_mesh is None:
        return _mesh_distance(shape, point)
    return lax.cond(shape.is_mesh, _mesh_distance, _drawn_distance, shape, point)


def _mesh_distance(shape: Shape, point: Point) -> Array:
    assert shape.grid is not None and shape.stretch is not None
    stretch = shape.stretch
    inner = tuple(c / stretch[i] for i, c in enumerate(point))
    return grid_distance(shape.grid, inner) * jnp.min(jnp.abs(stretch))


def _drawn_distance(shape: Shape, point: Point) -> Array:
    # In a loop: written out, the compiler's fusion repeats the slots' common parts.
    width = _width(shape, point[1])
    folded = _fold(shape, point, width)

    empty = jnp.full_like(point[0], 1e3)
    d, _ = lax.scan(lambda d, s: (_compose(d, s, folded), None), empty, shape.slots)
    d = _larger(d * width, jnp.abs(point[1] - shape.slab[0]) - shape.slab[1])
    return _displace(shape, point, d) * shape.step_scale


def _cell(cycles: Array) -> Array:
    return cycles - jnp.round(cycles)


def detail(shape: Shape, point: Point) -> Array:
    """Height of the fine relief above the shape, `[...]`, in units of length."""
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
