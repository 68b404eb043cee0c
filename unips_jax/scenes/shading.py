"""Radiance of a geometry's pixels under key lights and an environment.

Every image is lit by one key light (directional, near or the sun), whose shadow rays
are marched for each pixel, and by an environment. Its diffuse part is the irradiance
from 256 directions, times the share of it that the few directions in which rays are
traced leave visible; its glossy part is the radiance around the mirror direction,
already blurred, times the visibility there. Where the object hides its surroundings,
its own mean radiance takes their place: light that bounces about, roughly.
"""

import math

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.lighting.reflectance import (
    Surface,
    environment_reflectance,
    fresnel_f0,
    reflectance,
)
from unips_jax.scenes.backdrop import open_sky, ray_clearance
from unips_jax.scenes.config import SceneConfig
from unips_jax.scenes.geometry import Geometry
from unips_jax.scenes.grids import pick, spread
from unips_jax.scenes.lamps import KeyLights, key_light_at
from unips_jax.scenes.noise import Point, dot, normalize
from unips_jax.scenes.surroundings import (
    Environment,
    environment_radiance,
    sphere_points,
    surroundings,
)
from unips_jax.scenes.tracing import clearance, soft_visibility

KEY_STRIDE = 2
_OPEN = 256  # directions of unhidden light


def split(vectors: Array) -> Point:
    """Components of vectors `[..., 3]`, flat."""
    x, y, z = vectors.reshape(-1, 3).T
    return x, y, z


def key_clearance(geometry: Geometry, vector: Array, near: Array) -> Array:
    """Clearance of the rays to a key light, `[P]` for P = H W."""
    # Marched for every second pixel and interpolated: it is continuous across the edges
    # of shadows, which stay sharp when it is compared with zero afterwards.
    mask = geometry.mask
    fields = jnp.concatenate([geometry.positions, geometry.normals], -1)
    picked = pick(jnp.moveaxis(fields, -1, 0), mask, KEY_STRIDE)
    pixel = 2 * geometry.camera.window[2] / mask.shape[0]
    frame = picked.shape[1:]
    picked = picked.reshape(6, -1)
    points = tuple(picked[:3])
    light, reach, _ = key_light_at(vector, near, points)
    origin = tuple(picked[:3] + (0.01 + 0.75 * pixel) * picked[3:])
    clear = clearance(
        geometry.shape,
        geometry.to_object,
        origin,
        light,
        reach,
        steps=12,
        first=0.03,
        growth=0.22,
    )
    if geometry.backdrop is not None:
        blocked = ray_clearance(geometry.backdrop, origin, light, reach)
        clear = jnp.minimum(clear, blocked)
    clear = jnp.clip(clear, -0.5, 0.5).reshape(frame)
    return spread(clear, mask, KEY_STRIDE).reshape(-1)


def shade_key_light(
    geometry: Geometry,
    surface: Surface,
    vector: Array,
    near: Array,
    radius: Array,
    clear: Array,
) -> Array:
    """Radiance under one key light of unit white colour, `[3, P]` for P = H W."""
    point, normal = split(geometry.positions), split(geometry.normals)
    view = split(geometry.view)
    light, _, attenuation = key_light_at(vector, near, point)
    n_l, n_v = dot(normal, light), jnp.maximum(dot(normal, view), 0.02)
    lit = jnp.maximum(n_l, 0.0)
    size = jnp.where(near > 0, radius * jnp.sqrt(attenuation), radius)
    sharpness = 1 / jnp.maximum(size, 0.02)
    seen = soft_visibility(clear, n_l, sharpness)
    if geometry.sunk is not None:  # the fine relief casts no shadows of its own
        seen = seen * (1 - geometry.sunk.reshape(-1) * (1 - lit))
    half = normalize((light[0] + view[0], light[1] + view[1], light[2] + view[2]))
    brdf = reflectance(
        surface,
        n_l=jnp.maximum(n_l, 1e-3),
        n_v=n_v,
        n_h=jnp.maximum(dot(normal, half), 0.0),
        v_h=jnp.maximum(dot(view, half), 0.0),
        widening=0.4 * jnp.minimum(size, 1.0),
    )
    return brdf * (lit * seen * attenuation)


def shade_environment(
    geometry: Geometry, surface: Surface, environment: Environment
) -> tuple[Array, Array]:
    """Radiance under the environment in all its N rotations, `[N, 3, P]`.

    And what the surface reflects of the object's own light where the object hides the
    environment, `[3, P]`.
    """
    normal, view = split(geometry.normals), split(geometry.view)
    n_v = jnp.maximum(dot(normal, view), 0.02)
    diffuse, specular = environment_reflectance(surface, n_v)  # [3, P]
    basis = tuple(geometry.directions.T[..., None])
    visibility = geometry.visibility.reshape(geometry.directions.shape[0], -1)
    cosine = jnp.maximum(sum(n * w for n, w in zip(normal, basis, strict=True)), 0.0)
    weight = cosine / jnp.maximum(jnp.sum(cosine, 0), 1e-3)  # [D, P]
    seen = weight * visibility
    table = _environment_table(geometry, environment)
    open_share = jnp.sum(seen, 0)
    # Few directions, which rays are traced in, tell how much of the light is hidden; as
    # light itself they would be as many lamps.
    unhidden = jnp.einsum("dp,ncd->ncp", weight, table)
    share = jnp.einsum("dp,ncd->ncp", seen, table) / jnp.maximum(unhidden, 1e-6)
    irradiance = _open_irradiance(normal, environment) * share
    # The glossy lobe: environment around the mirror direction, where it is seen.
    n_dot_v = dot(normal, view)
    mirror = tuple(2 * n_dot_v * n - v for n, v in zip(normal, view, strict=True))
    lobe = jnp.maximum(sum(m * w for m, w in zip(mirror, basis, strict=True)), 0.0)
    lobe = lobe * lobe
    lobe = lobe * lobe * lobe + 1e-4
    free = jnp.sum(lobe * visibility, 0) / jnp.sum(lobe, 0)
    # Half of GGX's lobe lies within about this angle of the mirror direction.
    blur = jnp.minimum(1.9 * surface.roughness**2, 1.0)

    def reflected(rotation: Array) -> Array:
        return jnp.stack(environment_radiance(environment, rotation, mirror, blur))

    glossy = jax.lax.map(reflected, environment.rotation)
    total = diffuse * irradiance + specular * free * glossy
    hidden = diffuse * (1 - open_share) + specular * (1 - free)
    return total * environment.scale[:, None, None], hidden


def _open_irradiance(normal: Point, environment: Environment) -> Array:
    """Irradiance / pi where nothing is in the way, `[N, 3, P]`."""
    points = jnp.asarray(sphere_points(_OPEN))
    table = _open_table(environment, points)
    found = _gathered(table.reshape(-1, _OPEN), points, jnp.stack(normal))
    return found.reshape(*table.shape[:2], -1)


@jax.custom_batching.sequential_vmap
def _gathered(table: Array, points: Array, normal: Array) -> Array:
    """The light `[K, D]` from points that normals `[3, P]` get, `[K, P]`."""
    # One scene after the other: CPUs have no fast product for several at once.
    return table @ jnp.maximum(points @ normal, 0.0) * (4 / _OPEN)


def light_means(geometry: Geometry, keys: KeyLights, environment: Environment) -> Array:
    """Mean direction of each image's light at the object's centre, `[N, 3]`.

    Weighted by power: a single light gives its unit direction, light that comes equally
    from everywhere gives zero. What a table or a wall hides does not count.
    """
    squared = jnp.sum(jnp.square(keys.vector), -1, keepdims=True)  # [N, 1]
    fading = jnp.where(keys.near[:, None] > 0, 1 / squared, 1.0)
    power = jnp.mean(keys.color, -1, keepdims=True) * fading
    total = power * keys.vector * jax.lax.rsqrt(squared)
    points = jnp.asarray(sphere_points(_OPEN))
    around = _open_table(environment, points).mean(axis=1)  # [N, D]
    around = around * environment.scale[:, None]
    if geometry.backdrop is not None:
        around = around * open_sky(geometry.backdrop, points)
    around = around * (4 * math.pi / _OPEN)
    total = total + around @ points
    return total / (power + jnp.sum(around, -1, keepdims=True))


def _open_table(environment: Environment, points: Array) -> Array:
    """Radiance from `_OPEN` points of the sphere before scaling, `[N, 3, D]`."""
    return surroundings(environment, points, math.sqrt(2 / _OPEN))


def _environment_table(geometry: Geometry, environment: Environment) -> Array:
    """Radiance from the geometry's directions before scaling, `[N, 3, D]`."""
    directions = geometry.directions
    return surroundings(environment, directions, math.sqrt(1.8 / directions.shape[0]))


def radiance(
    geometry: Geometry,
    surface: Surface,
    keys: KeyLights,
    environment: Environment,
    config: SceneConfig,
    near: Array | None = None,
) -> Array:
    """Linear radiance of every image, `[N, 3, P]`, under a lamp and surroundings each.

    `near`: how far light comes, in image sides, of scenes where it bounces from what is
    near; 0 where the object's mean takes its place; None: so for all.
    """
    clear = jax.vmap(lambda *light: key_clearance(geometry, *light))(
        keys.vector, keys.near
    )
    direct = jax.lax.map(
        lambda light: shade_key_light(geometry, surface, *light),
        (keys.vector, keys.near, keys.radius, clear),
    )
    direct = direct * keys.color[..., None]
    mask = geometry.mask.reshape(-1).astype(jnp.float32)
    area = jnp.maximum(jnp.sum(mask), 1.0)
    albedo = jnp.sum(fresnel_f0(surface) * surface.metallic * mask, 1) / area
    plain = surface.base_color * (1 - surface.metallic) * mask
    albedo = albedo + jnp.sum(plain, 1) / area
    around, hidden = shade_environment(geometry, surface, environment)
    total = direct + around
    # In a hollow, about half of what leaves the surface meets it again.
    own = jnp.sum(total * mask, -1, keepdims=True) / area
    if near is not None:
        around = _average(total, geometry.mask, jnp.maximum(near, 0.01))
        own = jnp.where(near > 0, around, own)
    own = own / (1 - 0.5 * albedo)[:, None]
    return total + config.interreflection * hidden * own


def _average(values: Array, mask: Array, reach: Array) -> Array:
    """Gaussian means of `[..., P]` inside the mask, `reach` image sides wide."""
    index = jnp.arange(mask.shape[0], dtype=jnp.float32)
    away = (index[:, None] - index) / (reach * mask.shape[0])
    band = jnp.exp(-0.5 * away * away)
    weight = mask.astype(jnp.float32)
    sums = band @ (values.reshape(*values.shape[:-1], *mask.shape) * weight) @ band
    means = sums / jnp.maximum(band @ weight @ band, 1e-3)
    return means.reshape(values.shape)
