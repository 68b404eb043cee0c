"""Images of normals and materials under new light: a pure, differentiable function.

The reflectance is that of `unips_jax.lighting.reflectance`. Distant lights are summed
exactly. An environment's diffuse part is the mean over the hemisphere, its glossy part
the mean over the lobe around the mirror direction. Neither casts shadows: a normal map
does not tell what lies between a point and the light.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from unips_jax.lighting.environment import (
    blurred,
    glossy_light,
    harmonic_light,
    look_up,
)
from unips_jax.lighting.reflectance import Surface, environment_reflectance, reflectance


class Materials(NamedTuple):
    """A surface's reflectance.

    Attributes:
        base_color: `[H, W, 3]` or `[3]`, linear, in [0, 1].
        roughness: `[H, W]` or a number, in (0, 1], perceptual (the root of GGX's
            alpha).
        metallic: `[H, W]` or a number, in [0, 1].
        specular: a number in [0, 1]: weight of what is glossy and not metallic; 0 is
            Lambertian.
    """

    base_color: ArrayLike
    roughness: ArrayLike = 0.6
    metallic: ArrayLike = 0.0
    specular: ArrayLike = 1.0


class DistantLights(NamedTuple):
    """L distant lights.

    Attributes:
        directions: `[L, 3]`, from the object to the light, of any length above 0.
        colors: `[L, 3]`, irradiance on a surface that faces the light: pi shows a
            white matt one as 1.
    """

    directions: ArrayLike
    colors: ArrayLike


def relight(
    normals: ArrayLike,
    materials: Materials,
    lights: DistantLights | None = None,
    environment: ArrayLike | None = None,
    *,
    focal: ArrayLike | None = None,
) -> Array:
    """The image of a surface under distant lights and an environment.

    Pure and jitted; for `jit`, `vmap` and `grad` with respect to normals, materials,
    lights and environment. Memory is some thirty float32 images however many lights
    there are (their derivatives: as many for each light).

    Args:
        normals: `[H, W, 3]`, x right, y up, z towards the viewer, of unit length, 0
            where there is no surface.
        materials: the reflectance.
        lights: distant lights; None for none.
        environment: `[h, w, 3]`, an equirectangular picture of linear radiance (see
            `unips_jax.lighting.environment`), or `[K, 3]`, spherical harmonics of
            order up to 2, K = 1, 4 or 9 (see `unips_jax.lighting.harmonics`); None for
            none.
        focal: focal length in pixels, the principal point in the image's middle; None
            for an orthographic camera. It moves highlights alone.

    Returns:
        `[H, W, 3]`, float32, linear radiance, 0 where there is no surface.

    Raises:
        ValueError: if shapes do not fit, or normals are integers, as of a normal map
            that `read_normals` decodes.
    """
    normals = jnp.asarray(normals)
    if not jnp.issubdtype(normals.dtype, jnp.floating):
        raise ValueError(
            f"normals: expected floats of unit length, got {normals.dtype}; "
            "read_normals decodes a normal map"
        )
    normals = normals.astype(jnp.float32)
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise ValueError(f"normals: expected [H, W, 3], got {normals.shape}")
    surface = _surface(materials, (normals.shape[0], normals.shape[1]))
    lamps = None if lights is None else _checked(lights)
    around = None if environment is None else _checked_environment(environment)
    distance = None if focal is None else jnp.asarray(focal, jnp.float32)
    with jax.numpy_rank_promotion("allow"):  # whatever the caller's
        return _relight(normals, surface, lamps, around, distance)


@jax.jit
def _relight(
    normals: Array,
    surface: Surface,
    lights: tuple[Array, Array] | None,
    environment: Array | None,
    focal: ArrayLike | None,
) -> Array:
    height, width, _ = normals.shape
    normal = normals.reshape(-1, 3)
    there = jnp.any(normal != 0, -1)
    normal = jnp.where(there[:, None], normal, jnp.float32([0, 0, 1]))
    # What is NaN in materials where there is no surface would be in derivatives.
    color, rough, metallic = (jnp.where(there, x, 0.5) for x in surface[:3])
    surface = Surface(color, rough, metallic, surface.specular)
    view = _view(height, width, focal).reshape(-1, 3)
    n_v = jnp.maximum(jnp.sum(normal * view, -1), 0.02)
    total = jnp.zeros((3, height * width), jnp.float32)
    if lights is not None and len(lights[0]):

        def lit(direction: Array, color: Array) -> Array:
            return color[:, None] * _lit(surface, normal, view, n_v, _unit(direction))

        def add(total: Array, light: tuple[Array, Array]) -> tuple[Array, None]:
            return total + lit(*light), None

        # From the first on: over devices (`jax.shard_map`) sums vary as what is added.
        directions, colors = lights
        first = lit(directions[0], colors[0])
        total, _ = jax.lax.scan(add, first, (directions[1:], colors[1:]))
    if environment is not None:
        total = total + _surrounded(surface, normal, view, n_v, environment)
    image = jnp.where(there, total, 0).T
    return image.reshape(height, width, 3)


def _lit(
    surface: Surface, normal: Array, view: Array, n_v: Array, direction: Array
) -> Array:
    """Radiance under one light of unit irradiance, `[3, P]`."""
    n_l = normal @ direction
    half = _unit(direction + view)
    brdf = reflectance(
        surface,
        n_l=jnp.maximum(n_l, 1e-3),
        n_v=n_v,
        n_h=jnp.maximum(jnp.sum(normal * half, -1), 0.0),
        v_h=jnp.maximum(jnp.sum(view * half, -1), 0.0),
    )
    return brdf * jnp.maximum(n_l, 0.0)


def _surrounded(
    surface: Surface, normal: Array, view: Array, n_v: Array, environment: Array
) -> Array:
    """Radiance under an environment, `[3, P]`."""
    n_dot_v = jnp.sum(normal * view, -1, keepdims=True)
    mirror = _unit(2 * n_dot_v * normal - view)
    if environment.ndim == 2:
        matt, glossy = harmonic_light(environment, normal, mirror, surface.roughness)
    else:
        around = blurred(environment)
        matt = look_up(around.diffuse, normal)
        glossy = glossy_light(around, mirror, surface.roughness)
    diffuse, specular = environment_reflectance(surface, n_v)
    return diffuse * matt.T + specular * glossy.T


def _unit(vectors: Array) -> Array:
    # By the largest first: the squares of very short or long ones leave float32.
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(vectors), -1, keepdims=True))
    vectors = vectors / jnp.where(largest > 0, largest, 1.0)
    squared = jnp.sum(jnp.square(vectors), -1, keepdims=True)
    return vectors * jax.lax.rsqrt(jnp.maximum(squared, 1e-12))


def _view(height: int, width: int, focal: ArrayLike | None) -> Array:
    """Unit vectors towards the viewer, `[H, W, 3]`."""
    if focal is None:
        return jnp.broadcast_to(jnp.float32([0, 0, 1]), (height, width, 3))
    x = ((width - 1) / 2 - jnp.arange(width, dtype=jnp.float32)) / focal
    y = (jnp.arange(height, dtype=jnp.float32) - (height - 1) / 2) / focal
    x, y = jnp.meshgrid(x, y)
    return _unit(jnp.stack([x, y, jnp.ones_like(x)], -1))


def _surface(materials: Materials, size: tuple[int, int]) -> Surface:
    color, rough, metallic, specular = (
        jnp.asarray(values, jnp.float32) for values in materials
    )
    if color.shape not in ((3,), (*size, 3)):
        raise ValueError(
            f"base_color: expected (3,) or {(*size, 3)} as of the normals, got "
            f"{color.shape}"
        )
    for name, values in (("roughness", rough), ("metallic", metallic)):
        if values.shape not in ((), size):
            raise ValueError(
                f"{name}: expected a number or {size} as of the normals, got "
                f"{values.shape}"
            )
    if specular.shape:
        raise ValueError(f"specular: expected a number, got {specular.shape}")
    return Surface(
        jnp.broadcast_to(color, (*size, 3)).reshape(-1, 3).T,
        # Highlights of perfect mirrors would be infinite.
        jnp.maximum(jnp.broadcast_to(rough, size).reshape(-1), 0.03),
        jnp.broadcast_to(metallic, size).reshape(-1),
        specular,
    )


def _checked(lights: DistantLights) -> tuple[Array, Array]:
    directions, colors = (jnp.asarray(values, jnp.float32) for values in lights)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions: expected [L, 3], got {directions.shape}")
    if colors.shape != directions.shape:
        raise ValueError(
            f"colors: expected {directions.shape} as of the directions, got "
            f"{colors.shape}"
        )
    return directions, colors


def _checked_environment(environment: ArrayLike) -> Array:
    around = jnp.asarray(environment, jnp.float32)
    picture = around.ndim == 3 and around.shape[2] == 3 and 0 not in around.shape
    if not picture and around.shape not in ((1, 3), (4, 3), (9, 3)):
        raise ValueError(
            "environment: expected [h, w, 3] or spherical harmonics, [1, 4 or 9, 3], "
            f"got {around.shape}"
        )
    return around
