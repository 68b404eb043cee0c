"""Objects of known shape and views of them, for several test files."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from unips_jax.lighting import reflectance
from unips_jax.scenes import SceneConfig, geometry, sdf, surroundings, tracing

CONFIG = SceneConfig()
FLAT = {"twist": 0.0, "lathe": 0.0, "mirror": 0.0, "wave_warp": 0.0, "wave_ridge": 0.0}


def profile(widths=(1, 1, 1, 1, 1), rounding=0.0) -> jax.Array:
    heights = jnp.linspace(-1, 1, sdf.NUM_KNOTS)
    return sdf.profile_through(heights, jnp.asarray(widths, jnp.float32), rounding)


def make_shape(
    balls=(), slabs=(), hollows=(), noise=0.0, frequency=1.0, amplitude=0.0
) -> sdf.Shape:
    """Balls (center, radius) and boxes (center, half extents), less round hollows."""
    rows = []
    for center, radius in balls:
        rows.append((center, np.full(3, radius), np.ones(3), 1.0, 1.0))
    for center, half in slabs:
        rows.append((center, np.ones(3), np.asarray(half), 0.0, 0.0))
    used = np.arange(sdf.NUM_SLOTS) < len(rows)
    rows += [(np.zeros(3), np.ones(3), np.ones(3), 0.0, 0.0)] * int(np.sum(~used))
    for slot, (center, radius) in enumerate(hollows, sdf.NUM_UNIONS):
        rows[slot] = (center, np.full(3, radius), np.ones(3), 1.0, 1.0)
        used[slot] = True
    center, scale, extent, corner, edge = (
        jnp.asarray(np.stack([np.asarray(c, np.float32) for c in column]))
        for column in zip(*rows, strict=True)
    )
    count = sdf.NUM_SLOTS
    primitives = sdf.Primitives(
        center=center,
        rotation=jnp.broadcast_to(jnp.eye(3), (count, 3, 3)),
        scale=scale,
        extent=extent,
        corner=corner,
        hole=jnp.full(count, sdf.SOLID),
        edge=edge,
        blend=jnp.full(count, 1e-4),
        absent=jnp.where(jnp.asarray(used), 0.0, 1e3),
    )
    zero = jnp.float32(0)
    relief = sdf.Detail(
        seed=jnp.uint32(7),
        rotation=jnp.eye(3),
        frequency=jnp.float32(frequency),
        noise=jnp.float32(noise),
        groove=zero,
        ridge=zero,
        dimple=zero,
        weave=zero,
        groove_width=jnp.float32(0.2),
    )
    waves = jnp.zeros((sdf.NUM_WAVES, 5)).at[0].set(jnp.asarray([2, 1, 0, 0.1, 0.0]))
    return sdf.Shape(
        slots=sdf.pack(primitives),
        waves=waves.at[0, 4].set(amplitude),
        step_scale=jnp.float32(1 if amplitude == 0 else 0.7),
        detail=relief,
        profile=profile(),
        slab=jnp.asarray([0.0, 1e3]),
        center=jnp.zeros(3),
        radius=jnp.float32(1),
        kind=jnp.int32(0),
        **{name: jnp.float32(value) for name, value in FLAT.items()},
    )


def look(
    shape,
    *,
    size=32,
    perspective=0.0,
    distance=3.0,
    half=1.0,
    config=CONFIG,
    **options,
):
    camera = tracing.Camera(
        jnp.float32(perspective), jnp.float32(distance), jnp.asarray([0.0, 0, half])
    )
    return _look(shape, camera, options, size=size, config=config)


@functools.partial(jax.jit, static_argnames=("size", "config"))  # one for all objects
def _look(shape, camera, options, *, size, config):
    key, pose = jax.random.key(0), jnp.eye(3)
    return geometry.finish_geometry(
        key, shape, pose, camera, size=size, config=config, **options
    )


def matt(geometry_, color=0.6):
    count = geometry_.mask.size
    return reflectance.Surface(
        base_color=jnp.full((3, count), color),
        roughness=jnp.full(count, 0.5),
        metallic=jnp.zeros(count),
        specular=jnp.float32(0),
    )


def constant_environment(radiance):
    zeros = jnp.zeros(3)
    full = zeros + radiance
    return surroundings.Environment(
        rotation=jnp.eye(3)[None],
        zenith=full,
        horizon=full,
        ground=full,
        axes=jnp.broadcast_to(jnp.eye(3), (surroundings.NUM_LOBES, 3, 3)),
        half=jnp.full((surroundings.NUM_LOBES, 2), 0.1),
        color=jnp.zeros((surroundings.NUM_LOBES, 3)),
        clutter=jnp.float32(0),
        clutter_frequency=jnp.float32(1),
        scale=jnp.ones(1),
    )
