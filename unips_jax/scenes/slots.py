"""The slots of `sdf.Shape`: the primitives of an object, and where they sit."""

import math

import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.scenes.config import SHAPE_KINDS
from unips_jax.scenes.draws import Draws, rotation_about
from unips_jax.scenes.sdf import NUM_SLOTS, NUM_UNIONS, SOLID, Primitives

# Columns: ellipsoid, box, cylinder, capsule, torus, frame.
_TYPE_WEIGHTS = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],  # blob
        [0.35, 0.15, 0.15, 0.15, 0.12, 0.08],  # composition
        [0.05, 0.4, 0.3, 0.05, 0.1, 0.1],  # machine
        [0.3, 0.35, 0.15, 0.1, 0.1, 0.0],  # lathe
        [0.1, 0.1, 0.05, 0.4, 0.25, 0.1],  # thin
        [0.5, 0.12, 0.1, 0.14, 0.14, 0.0],  # relief
        [0.3, 0.3, 0.1, 0.1, 0.1, 0.1],  # plate
    ],
    np.float32,
)
# Columns: least and greatest size, thickness factor, blend low and high, chance that
# a slot is used, chance of a cut, of a twist, of a mirror, of a profile, of flat ends.
TRAITS = np.array(
    [
        [0.35, 0.8, 1.0, 0.15, 0.5, 0.8, 0.4, 0.2, 0.25, 0.35, 0.15],
        [0.25, 0.7, 0.9, 0.03, 0.25, 0.75, 0.4, 0.25, 0.3, 0.35, 0.15],
        [0.25, 0.7, 0.9, 0.01, 0.06, 0.75, 0.6, 0.05, 0.3, 0.35, 0.15],
        [0.3, 0.6, 0.9, 0.03, 0.3, 0.6, 0.7, 0.1, 0.0, 0.8, 0.5],
        [0.35, 0.8, 0.35, 0.02, 0.15, 0.9, 0.2, 0.2, 0.3, 0.3, 0.1],
        [0.15, 0.6, 0.8, 0.03, 0.2, 0.8, 0.65, 0.0, 0.0, 0.0, 0.0],
        [0.1, 0.35, 0.8, 0.02, 0.08, 0.5, 0.65, 0.0, 0.0, 0.0, 0.0],
    ],
    np.float32,
)
LATHE = SHAPE_KINDS.index("lathe")
FLAT = (SHAPE_KINDS.index("relief"), SHAPE_KINDS.index("plate"))


def is_flat(kind: Array) -> Array:
    """Whether a kind is a relief or a plate, seen from the front."""
    return (kind == FLAT[0]) | (kind == FLAT[1])


def _typed_primitives(draws: Draws, kind: Array, size: Array, blend: Array):
    """Parameters of every slot for every type, then the chosen type's."""
    weights = jnp.asarray(_TYPE_WEIGHTS)[kind]
    types = draws.choice(weights, NUM_SLOTS)
    thick = jnp.asarray(TRAITS)[kind, 2]
    a, b, c = (draws.uniform(lo, 1.0, NUM_SLOTS) for lo in (0.5, 0.4, 0.35))
    small = draws.uniform(0.02, 0.3, NUM_SLOTS)
    one, zero = jnp.ones(NUM_SLOTS), jnp.zeros(NUM_SLOTS)
    solid = jnp.full(NUM_SLOTS, SOLID)
    side = 0.75 * thick * size
    tube = thick * size * (0.1 + 0.25 * c)
    ball = jnp.stack([a, b * 0.5 + 0.5, c * 0.6 + 0.4], -1) * size[:, None]
    # Per type: extent x, y, z, corner, hole, edge.
    table = [
        [one, one, one, one, solid, one],
        [a * size, b * side, c * side, small * b * side, solid, small * c * side],
        [a * side, a * side, b * size, a * side, solid, small * c * side * 0.5],
        [tube, tube, size, tube, solid, tube],
        [size, size, tube, size, tube, tube],
        [size, size * (0.5 + 0.5 * a), tube, small * size, tube, small * tube],
    ]
    stacked = jnp.stack([jnp.stack(row, -1) for row in table])  # [T, K, 6]
    chosen = jnp.sum(
        stacked * (types == jnp.arange(6)[:, None])[..., None], axis=0
    )  # [K, 6]
    is_ball = (types == 0)[:, None]
    scale = jnp.where(is_ball, ball, 1.0)
    rotation = draws.rotation(NUM_SLOTS)
    reach = jnp.where(
        is_ball[:, 0], jnp.max(ball, -1), jnp.linalg.norm(chosen[:, :3], axis=-1)
    )
    primitives = Primitives(
        center=jnp.zeros((NUM_SLOTS, 3)),
        rotation=rotation,
        scale=jnp.broadcast_to(scale, (NUM_SLOTS, 3)),
        extent=chosen[:, :3],
        corner=chosen[:, 3],
        hole=chosen[:, 4],
        edge=chosen[:, 5],
        blend=blend,
        absent=zero,
    )
    return primitives, reach


def _material(
    primitives: Primitives, direction: Array, side: Array, lathe: Array
) -> tuple[Array, Array]:
    """Where primitives are solid: about their centers, or in the tube of rings.

    Of K slots and unit directions `[K, 3]`. `side` `[K]`, 0 or 1, is whether a ring is
    met on its x or its y axis; with `lathe` rings are met in the half plane x > 0, z =
    0 instead. Returns a point inside, from the center, `[K, 3]`, and how far the
    material reaches from there at least, `[K, K]`: slots by directions.
    """
    ring = (primitives.hole < SOLID)[:, None]
    side = side[:, None]
    tube = jnp.take_along_axis(primitives.rotation, side[..., None], 1)[:, 0]
    section = jnp.cross(primitives.rotation[:, 2], jnp.asarray([0.0, 0.0, 1.0]))
    length = jnp.linalg.norm(section, axis=-1, keepdims=True)
    section = section / jnp.maximum(length, 1e-9)  # of lathes: their rings lie flat
    tube = jnp.where(lathe, section * jnp.sign(section[:, :1]), tube)
    width = jnp.take_along_axis(primitives.extent, side, 1) - primitives.hole[:, None]
    middle = jnp.where(ring, tube * width, 0.0)
    half = primitives.extent * primitives.scale
    half = jnp.where(ring, primitives.hole[:, None], half)
    turned = jnp.einsum("kij,lj->kli", primitives.rotation, direction)
    return middle, 1 / jnp.linalg.norm(turned / half[:, None], axis=-1)


def _attached_centers(
    draws: Draws, primitives: Primitives, size: Array, used: Array, lathe: Array
) -> Array:
    """Each of K slots, `[K, 3]`, overlaps one before it, so that all are connected."""
    # Cuts sit near the surface, further out the larger they are: they hollow, but
    # mostly leave the rest in one piece. Turned objects (`lathe`), of which only the
    # half plane x > 0, z = 0 counts, stack their slots along y there.
    upwards = jnp.where(draws.chance(0.5, NUM_SLOTS), 1.0, -1.0)
    lean = draws.uniform(0.0, 0.5, NUM_SLOTS)
    stacked = jnp.stack(
        [jnp.sin(lean), upwards * jnp.cos(lean), jnp.zeros(NUM_SLOTS)], -1
    )
    direction = jnp.where(lathe, stacked, draws.direction(NUM_SLOTS))

    side = draws.chance(0.5, NUM_SLOTS).astype(jnp.int32)
    middle, reach = _material(primitives, direction, side, lathe)
    parent = draws.unit(NUM_SLOTS)
    out = draws.uniform(0.45, 0.95, NUM_SLOTS)
    overlap = draws.uniform(0.0, 0.5, NUM_SLOTS)
    centers = [jnp.zeros(3)]
    for slot in range(1, NUM_SLOTS):
        count = min(slot, NUM_UNIONS)
        index = (parent[slot] * count).astype(jnp.int32)
        index = jnp.where(used[index], index, 0)
        origin = jnp.stack(centers)[index] + middle[index]
        step = out[slot] * reach[index, slot]
        if slot < NUM_UNIONS:
            step = step + overlap[slot] * reach[slot, slot]
            origin = origin - middle[slot]
        else:
            step = step + 0.5 * size[slot]
        centers.append(origin + direction[slot] * step)
    return jnp.stack(centers)


def _turned_cuts(
    draws: Draws, centers: Array, size: Array, used: Array
) -> tuple[Array, Array]:
    """Centers of a turned object's cuts: a waist and an opening at the top."""
    heights = centers[:NUM_UNIONS, 1]
    low = jnp.min(jnp.where(used[:NUM_UNIONS], heights, jnp.inf))
    high = jnp.max(jnp.where(used[:NUM_UNIONS], heights, -jnp.inf))
    waist = draws.uniform(0.2, 0.5) + size[NUM_UNIONS]
    near = jnp.stack([waist, draws.uniform(low, high), 0.0])
    return near, jnp.stack([0.0, high + 0.3 * size[0], 0.0])


def draw_slots(draws: Draws, kind: Array) -> tuple[Primitives, Array]:
    """Primitives of a kind of object, and how far each reaches, -1000 where unused."""
    traits = jnp.asarray(TRAITS)[kind]
    size = draws.uniform(traits[0], traits[1], NUM_SLOTS)
    size = size.at[0].set(jnp.maximum(size[0], 0.5 * (traits[0] + traits[1])))
    blend = draws.log_uniform(traits[3], traits[4]) * draws.uniform(0.6, 1.4, NUM_SLOTS)
    is_cut = jnp.arange(NUM_SLOTS) >= NUM_UNIONS
    size = size * jnp.where(is_cut, draws.log_uniform(0.4, 1.5, NUM_SLOTS), 1.0)
    used = draws.chance(jnp.where(is_cut, traits[6], traits[5]), NUM_SLOTS)
    used = used.at[:2].set(True)
    primitives, reach = _typed_primitives(draws, kind, size, blend)
    lathe = kind == LATHE
    # What a turned object begins with stands upright, unless it is a ring.
    begins = lathe & (jnp.arange(NUM_SLOTS) == 0) & (primitives.hole == SOLID)
    upright = rotation_about(2, jnp.asarray(0.5 * math.pi))
    rotation = jnp.where(begins[:, None, None], upright, primitives.rotation)
    primitives = primitives._replace(rotation=rotation)
    centers = _attached_centers(draws, primitives, size, used, lathe)
    cuts = jnp.stack(_turned_cuts(draws, centers, size, used))
    centers = centers.at[NUM_UNIONS:].set(jnp.where(lathe, cuts, centers[NUM_UNIONS:]))

    # Reliefs and plates: slot 0 is the plate, the others sit on its face.
    flat = is_flat(kind)
    face = jnp.concatenate(
        [
            draws.uniform(-1.1, 1.1, NUM_SLOTS, 2),
            draws.uniform(0.0, 0.3, NUM_SLOTS, 1) * (size[:, None] + 0.3),
        ],
        -1,
    )
    face = face.at[0].set(jnp.asarray([0.0, 0.0, -0.25]))
    centers = jnp.where(flat, face, centers)
    slab = jnp.stack([1.5, draws.uniform(1.1, 1.5), 0.35])
    first = {
        "scale": jnp.ones(3),
        "rotation": jnp.eye(3),
        "extent": slab,
        "corner": jnp.asarray(0.1),
        "hole": jnp.asarray(SOLID),
        "edge": draws.uniform(0.01, 0.1),
    }
    replaced = {
        name: jnp.where(
            flat & (jnp.arange(NUM_SLOTS) == 0).reshape((-1,) + (1,) * value.ndim),
            value,
            getattr(primitives, name),
        )
        for name, value in first.items()
    }
    reach = reach.at[0].set(jnp.where(flat, jnp.linalg.norm(slab), reach[0]))
    absent = jnp.where(used, 0.0, 1e3)
    primitives = primitives._replace(center=centers, absent=absent, **replaced)
    return primitives, jnp.where(used & ~is_cut, reach, -1e3)


def bounding_sphere(
    primitives: Primitives, reach: Array, lathe: Array, mirror: Array
) -> tuple[Array, Array]:
    """Centre and radius of a sphere around them."""
    center = primitives.center
    low = jnp.min(center - reach[:, None], axis=0)
    high = jnp.max(center + reach[:, None], axis=0)
    folded = jnp.stack([lathe + mirror, 0.0, lathe]) > 0
    middle = jnp.where(folded, 0.0, 0.5 * (low + high))
    radius = jnp.max(jnp.linalg.norm(center - middle, axis=-1) + reach)
    return middle, radius
