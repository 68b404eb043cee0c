"""Geometry of a scene: visible surface, normals, visibility of the sky.

Rays are sphere-traced through the signed distance. Normals are its derivative, plus
that of the fine relief, which tilts normals but is too low to move what is seen.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from unips_jax.scenes.backdrop import (
    Backdrop,
    draw_backdrop,
    meet,
    open_sky,
    widen_window,
)
from unips_jax.scenes.config import SceneConfig
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.grids import pick, pixel_grid, spread
from unips_jax.scenes.noise import Point, dot, normalize
from unips_jax.scenes.poses import draw_camera, pose_and_frame
from unips_jax.scenes.sdf import Shape, detail
from unips_jax.scenes.shapes import as_mesh, draw_detail, draw_shape
from unips_jax.scenes.slots import is_flat
from unips_jax.scenes.tracing import (
    Camera,
    along,
    camera_rays,
    clearance,
    first_crossings,
    object_point,
    soft_visibility,
    surface_gradient,
    world_distance,
)

SKY_STRIDE = 4


class Geometry(NamedTuple):
    """What does not depend on materials, lights and sensor."""

    mask: Array  # `[H, W]` bool
    normals: Array  # `[H, W, 3]`, unit inside the mask, zero outside
    positions: Array  # `[H, W, 3]` in the world; meaningless outside the mask
    view: Array  # `[H, W, 3]`, unit, towards the viewer
    height: Array  # `[H, W]`, the fine relief in units of its amplitude, about [-1, 1]
    directions: Array  # `[D, 3]`, unit, where visibility is tabulated
    visibility: Array  # `[D, H, W]` in [0, 1]
    shape: Shape  # the object, for shadow rays
    to_object: Array  # `[3, 3]`, world to the object's frame, apart from its centre
    camera: Camera
    focal: Array  # 35 mm equivalent of the frame in mm; 0 for orthographic cameras
    entropy: Array  # of the normals, in bits
    backdrop: Backdrop | None = None  # table and wall; None where no scene has them
    ground: Array | None = None  # `[H, W]` bool, where these are seen; part of the mask
    # `[H, W]`, the share of their surroundings that hollows of the fine relief do not
    # see; None where no scene has them
    sunk: Array | None = None


def _basis_directions(draws: Draws, count: int) -> Array:
    """Jittered spherical Fibonacci points over z > -0.8, `[count, 3]`."""
    index = jnp.arange(count, dtype=jnp.float32)
    z = 1 - 1.8 * (index + draws.uniform(0.2, 0.8, count)) / count
    golden = math.pi * (3 - math.sqrt(5))
    jitter = draws.uniform(-0.3, 0.3, count) / math.sqrt(count / 4)
    angle = golden * index + jitter + draws.uniform(0.0, 2 * math.pi)
    ring = jnp.sqrt(1 - z * z)
    return jnp.stack([ring * jnp.cos(angle), ring * jnp.sin(angle), z], -1)


def _sky_visibility(
    shape: Shape, to_object: Array, points: Array, normals: Array, directions: Array
) -> Array:
    """Visibility in every basis direction, `[D, h, w]`; points `[3, h, w]`."""
    sharpness = math.sqrt(directions.shape[0] / 1.8)
    count, (h, w) = directions.shape[0], points.shape[1:]
    lifted = (points + 0.03 * normals).reshape(3, 1, -1)
    full = (3, count, h * w)
    origin = jnp.broadcast_to(lifted, full).reshape(3, -1)
    towards = jnp.broadcast_to(directions.T[:, :, None], full).reshape(3, -1)
    clear = clearance(
        shape,
        to_object,
        tuple(origin),
        tuple(towards),
        1e3,
        steps=6,
        first=0.08,
        growth=0.4,
    )
    cosine = jnp.einsum("chw,dc->dhw", normals, directions)
    return soft_visibility(clear.reshape(count, h, w), cosine, sharpness)


def _visible_surface(
    shape: Shape, to_object: Array, camera: Camera, size: int
) -> tuple[Array, Point, Point, Point, Array]:
    """Mask, points, normals, directions to the viewer, relief height; all flat."""
    pixel = 2 * camera.window[2] / size
    rays = camera_rays(camera, *pixel_grid(size))
    t, last = first_crossings(shape, to_object, camera, size)

    def base(point: Point) -> Array:
        return world_distance(shape, to_object, point)

    def secant(_: int, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        t, last, moved = carry
        value = base(along(*rays, t))
        slope = (last - value) / jnp.where(jnp.abs(moved) < 1e-6, 1e-6, moved)
        moved = value / jnp.clip(slope, 0.15, 1.5)
        moved = jnp.clip(moved, -2 * pixel, 2 * pixel)
        return t + moved, value, moved

    one = jnp.ones_like(t)
    t, _, _ = jax.lax.fori_loop(0, 2, secant, (t, one, one))
    point = along(*rays, t)
    mask = (last < 0.5 * pixel) & (base(point) < 0.1 * pixel)

    def relief(point: Point) -> Array:
        return detail(shape, object_point(shape, to_object, point))

    height, pullback = jax.vjp(relief, point)
    (slope,) = pullback(jnp.full_like(height, shape.step_scale / shape.radius))
    smooth = surface_gradient(shape, to_object, point)
    normal = normalize(
        (smooth[0] - slope[0], smooth[1] - slope[1], smooth[2] - slope[2])
    )
    view = tuple(-c for c in rays[1])
    away = jnp.minimum(dot(normal, view), 0.0)
    normal = normalize(along(normal, view, -away))
    return mask, point, normal, view, height


def _finest(shape: Shape, camera: Camera, size: int) -> Array:
    """The frequency of a relief whose cells are nine pixels wide."""
    return size / (2 * camera.window[2] * 9 * shape.radius)


def _resolve_detail(shape: Shape, camera: Camera, size: int) -> Shape:
    """Keeps the finest cells wider than nine pixels."""
    frequency = jnp.minimum(shape.detail.frequency, _finest(shape, camera, size))
    return shape._replace(detail=shape.detail._replace(frequency=frequency))


def render_geometry(
    key: Array,
    *,
    size: int,
    config: SceneConfig | None = None,
    shape: Array | int | None = None,
    camera: Array | int | None = None,
    meshes: ArrayLike | None = None,
) -> Geometry:
    """Draws an object and a camera and finds what is visible: the expensive stage."""
    config = config or SceneConfig()
    if size <= 0 or size % 4:
        raise ValueError(f"size: expected a positive multiple of 4, got {size}")
    key_kind, key_shape, key_camera, key_basis = jax.random.split(key, 4)
    draws = Draws(key_kind, 8)
    kind = draws.choice(config.shape_weights) if shape is None else jnp.int32(shape)
    perspective = draws.chance(config.perspective_rate)
    perspective = perspective if camera is None else jnp.asarray(camera)
    solid = draw_shape(key_shape, kind)
    if config.mesh_rate and shape is None:
        if meshes is None:
            raise ValueError("mesh_rate: expected meshes=load_meshes(config), got none")
        key_mesh = jax.random.fold_in(key, 3)
        solid = as_mesh(
            Draws(key_mesh, 8), solid, jnp.asarray(meshes), config.mesh_rate
        )
    draws = Draws(key_camera, 16 + 8 * config.rotation_candidates)
    view = draw_camera(draws, config, perspective)
    solid, pose, view, entropy = pose_and_frame(draws, config, solid, view)
    backdrop = None
    if config.whole_frame_rate:
        draws = Draws(jax.random.fold_in(key, 1), 32)
        backdrop = draw_backdrop(draws, config.whole_frame_rate, ~is_flat(solid.kind))
        view = view._replace(window=widen_window(draws, backdrop, view.window))
    hollow = None
    if config.carving_rate:
        key_carving = jax.random.fold_in(key, 2)
        finest = _finest(solid, view, size)
        solid, hollow = _carve(key_carving, config.carving_rate, solid, finest)
    return finish_geometry(
        key_basis,
        solid,
        pose,
        view,
        size=size,
        config=config,
        entropy=entropy,
        backdrop=backdrop,
        hollow=hollow,
    )


def _carve(key: Array, rate: float, shape: Shape, finest: Array) -> tuple[Shape, Array]:
    """A finer and steeper relief for some, and how dark its hollows are."""
    key_rest, key_draws, key_seed = jax.random.split(key, 3)
    rest = Draws(key_rest, 2)
    carved = rest.chance(rate)
    ranges = (6.0, 30.0), (0.2, 0.7)
    draws = Draws(key_draws, 32)
    new = draw_detail(draws, key_seed, shape.kind, *ranges, always=True)
    coarser = jnp.maximum(new.frequency / finest, 1.0)
    amplitudes = ("noise", "groove", "ridge", "dimple", "weave")
    new = new._replace(
        frequency=new.frequency / coarser,
        **{name: getattr(new, name) * coarser for name in amplitudes},
    )
    detail = jax.tree.map(lambda a, b: jnp.where(carved, a, b), new, shape.detail)
    return shape._replace(detail=detail), carved * rest.uniform(0.1, 0.6)


def finish_geometry(
    key: Array,
    shape: Shape,
    pose: Array,
    camera: Camera,
    *,
    size: int,
    config: SceneConfig,
    entropy: Array | float = 0.0,
    backdrop: Backdrop | None = None,
    hollow: Array | float | None = None,
) -> Geometry:
    """Finds what a camera sees of a given shape.

    `pose [3, 3]` turns the object's frame to the world's; the key is for directions of
    the visibility table; `hollow`: how much of its surroundings the bottom of the fine
    relief does not see.
    """
    to_object = shape.radius * pose.T
    shape = _resolve_detail(shape, camera, size)
    mask, point, normal, view, relief = _visible_surface(shape, to_object, camera, size)
    ground = None
    if backdrop is not None:
        ground = meet(backdrop, camera_rays(camera, *pixel_grid(size)), mask, point)
        point, normal, relief = (
            jax.tree.map(lambda new, old: jnp.where(ground.seen, new, old), *pair)
            for pair in (
                (ground.point, point),
                (ground.normal, normal),
                (jnp.zeros_like(relief), relief),
            )
        )
        mask = mask | ground.seen
    draws = Draws(key, max(128, 2 * config.num_directions + 1))
    directions = _basis_directions(draws, config.num_directions)
    frame = (size, size)
    # A product with the identity: the compiler stores its result, where it would
    # otherwise work out the normals again for each of their uses.
    fields = jnp.eye(11) @ jnp.stack([*point, *normal, *view, relief, 1.0 * mask])
    fields = fields.reshape(11, *frame)
    relief, mask = fields[9], fields[10] > 0.5
    picked = pick(fields[:6], mask, SKY_STRIDE)
    coarse = _sky_visibility(shape, to_object, picked[:3], picked[3:], directions)
    if backdrop is not None:
        coarse = coarse * open_sky(backdrop, directions)[:, None, None]
    visibility = spread(coarse, mask, SKY_STRIDE)
    fields = jnp.moveaxis(fields, 0, -1)
    detail_ = shape.detail
    amplitude = detail_.noise + detail_.groove + detail_.ridge + detail_.weave
    amplitude = amplitude + jnp.abs(detail_.dimple) + 1e-6
    height = relief / amplitude
    sunk = None
    if hollow is not None:
        sunk = hollow * jnp.clip(-height, 0.0, 1.0)
        visibility = visibility * (1 - sunk)
    focal = 18 * camera.distance / camera.window[2]
    return Geometry(
        mask=mask,
        normals=jnp.where(mask[..., None], fields[..., 3:6], 0.0),
        positions=fields[..., :3],
        view=fields[..., 6:9],
        height=height,
        directions=directions,
        visibility=visibility,
        shape=shape,
        to_object=to_object,
        camera=camera,
        focal=jnp.where(camera.perspective > 0, focal, 0.0),
        entropy=jnp.asarray(entropy, jnp.float32),
        backdrop=backdrop,
        ground=None if ground is None else ground.seen.reshape(frame),
        sunk=sunk,
    )
