"""How an object is seen: the camera, a rotation of sufficient entropy, the frame."""

import math

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.scenes.config import SceneConfig
from unips_jax.scenes.draws import Draws, rotation_about
from unips_jax.scenes.grids import pixel_grid
from unips_jax.scenes.noise import normalize
from unips_jax.scenes.sdf import Shape, without_cuts
from unips_jax.scenes.slots import is_flat
from unips_jax.scenes.tracing import (
    Camera,
    along,
    camera_rays,
    sphere_interval,
    surface_gradient,
    trace,
    world_distance,
)

_CANDIDATE_SIZE = 20
_HISTOGRAM_BINS = 16


def normal_entropy_bits(normals: Array, mask: Array) -> Array:
    """Shannon entropy of a normal map in bits; 0 for an empty mask.

    The histogram has 16 x 16 bins over (n_x, n_y) in [-1, 1]^2 (the visible hemisphere
    seen from the front); every masked pixel counts once. A sphere that fills a 24 x 24
    frame has about 7.3 bits, a plane 0. Source: UniPS (Ikehata, CVPR 2022), Sec. 3,
    which keeps objects above 4 and does not state how the histogram is made.
    """
    bins = jnp.arange(_HISTOGRAM_BINS)
    index = jnp.floor((normals[..., :2].reshape(-1, 2) + 1) * (_HISTOGRAM_BINS / 2))
    index = jnp.clip(index, 0, _HISTOGRAM_BINS - 1)
    one_hot = (index[..., None] == bins).astype(jnp.float32)  # [P, 2, bins]
    weight = mask.reshape(-1, 1).astype(jnp.float32)
    counts = (one_hot[:, 0] * weight).T @ one_hot[:, 1]
    p = counts / jnp.maximum(jnp.sum(weight), 1.0)
    return -jnp.sum(jnp.where(p > 0, p * jnp.log2(jnp.maximum(p, 1e-12)), 0.0))


def _look(shape: Shape, camera: Camera, pose: Array) -> tuple[Array, Array, Array]:
    """A small view: entropy, frame around the silhouette, whether there is one."""
    to_object = shape.radius * pose.T
    u, v = pixel_grid(_CANDIDATE_SIZE)
    rays = camera_rays(camera, u, v)
    near, _ = sphere_interval(*rays)
    t, last = trace(shape, to_object, rays, near, 1 / _CANDIDATE_SIZE, 10)
    point = along(*rays, t)
    hit = last < 0.7 / _CANDIDATE_SIZE
    # Where cuts left nothing, rays come near, but not this near.
    seen = jnp.any(world_distance(shape, to_object, point) < 1e-3)
    slope = surface_gradient(shape, to_object, point)
    normals = jnp.stack(normalize(slope), -1)
    margin = 0.7 / _CANDIDATE_SIZE
    bounds = [
        (jnp.min(jnp.where(hit, c, 1.0)), jnp.max(jnp.where(hit, c, -1.0)))
        for c in (u, v)
    ]
    (left, right), (low, high) = bounds
    half = 0.5 * jnp.maximum(right - left, high - low) + margin
    frame = jnp.stack([0.5 * (left + right), 0.5 * (low + high), half])
    frame = jnp.where(seen, frame, jnp.asarray([0.0, 0.0, 1.0]))
    return normal_entropy_bits(normals, hit), frame, seen


def draw_camera(draws: Draws, config: SceneConfig, perspective: Array) -> Camera:
    """Draws a camera whose frame is not yet cropped."""
    focal = draws.log_uniform(*config.focal_range_mm)
    return Camera(
        perspective=perspective.astype(jnp.float32),
        distance=jnp.sqrt(1 + (focal / 18) ** 2),
        window=jnp.asarray([0.0, 0.0, 1.0]),
    )


def pose_and_frame(
    draws: Draws, config: SceneConfig, shape: Shape, camera: Camera
) -> tuple[Shape, Array, Camera, Array]:
    """Draws rotations, takes the first of sufficient entropy, crops the frame.

    Of one object in a thousand the cuts leave nothing: these lose their cuts. `draws`
    has at least 6 numbers for every candidate, and 3 more. Returns the object; its pose
    `[3, 3]`, from its frame to the world; the cropped camera; the entropy in bits.
    """
    count = config.rotation_candidates
    free = draws.rotation(count)
    tilt = draws.uniform(-0.5, 0.5, 2, count)
    spin = rotation_about(2, draws.uniform(-math.pi, math.pi, count))
    facing = rotation_about(0, tilt[0]) @ rotation_about(1, tilt[1]) @ spin
    flat = is_flat(shape.kind)
    poses = jnp.where(flat, facing, free)
    # Perspective frames are opened so that the unit sphere touches their edge.
    reach = camera.distance / jnp.sqrt(jnp.maximum(camera.distance**2 - 1, 1e-3))
    reach = jnp.where(camera.perspective > 0, reach, 1.0)
    camera = camera._replace(window=jnp.stack([0.0, 0.0, 1.0]) * reach)
    entropies, frames, seen = jax.vmap(lambda pose: _look(shape, camera, pose))(poses)
    good = (entropies > config.min_entropy_bits) | flat
    chosen = jnp.where(jnp.any(good), jnp.argmax(good), jnp.argmax(entropies))
    one_hot = (jnp.arange(count) == chosen).astype(jnp.float32)
    pose = jnp.einsum("k,kij->ij", one_hot, poses)
    something = one_hot @ seen > 0
    whole = without_cuts(shape)
    whole_entropy, whole_frame, _ = _look(whole, camera, pose)
    shape = shape._replace(slots=jnp.where(something, shape.slots, whole.slots))
    entropy = jnp.where(something, one_hot @ entropies, whole_entropy)
    frame = jnp.where(something, one_hot @ frames, whole_frame)
    fills = flat & draws.chance(0.75)
    margin = draws.uniform(1.0, 1.08)
    zoom = jnp.where(fills, draws.uniform(0.35, 0.6), margin)
    frame = frame * reach * jnp.stack([1.0, 1.0, zoom])
    return shape, pose, camera._replace(window=frame), entropy
