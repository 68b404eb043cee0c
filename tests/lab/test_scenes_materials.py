"""Reflectance against closed forms: reciprocity, white furnace."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.lighting import reflectance
from unips_jax.scenes import MATERIALS, materials


def _surface(base, roughness, metallic, specular=1.0):
    return reflectance.Surface(
        jnp.full((3, 1), base),
        jnp.full(1, roughness),
        jnp.full(1, metallic),
        jnp.float32(specular),
    )


def _brdf(surface, light, view):
    half = light + view
    half = half / jnp.linalg.norm(half, axis=-1, keepdims=True)
    return reflectance.reflectance(
        surface,
        n_l=light[:, 2],
        n_v=view[:, 2],
        n_h=half[:, 2],
        v_h=jnp.sum(view * half, -1),
    )[0]


def _hemisphere(count=64):
    """Midpoints and solid angles of a fine grid over the hemisphere."""
    z = (np.arange(4 * count) + 0.5) / (4 * count)
    phi = 2 * np.pi * (np.arange(4 * count) + 0.5) / (4 * count)
    z, phi = (grid.ravel() for grid in np.meshgrid(z, phi))
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], -1)
    return jnp.asarray(directions, jnp.float32), 2 * np.pi / z.size


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.2, 0.6, 1.0])
def test_reflectance_is_reciprocal(metallic, roughness):
    a = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    a[..., 2] = np.abs(a[..., 2]) + 0.05
    light, view = a / np.linalg.norm(a, axis=-1, keepdims=True)
    surface = _surface(0.7, roughness, metallic)
    there = _brdf(surface, jnp.asarray(light), jnp.asarray(view))
    back = _brdf(surface, jnp.asarray(view), jnp.asarray(light))
    np.testing.assert_allclose(there, back, rtol=2e-5)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
@pytest.mark.parametrize("cosine", [0.2, 0.6, 1.0])
def test_white_furnace(roughness, cosine):
    light, solid_angle = _hemisphere()
    view = jnp.asarray([[np.sqrt(1 - cosine**2), 0.0, cosine]], jnp.float32)
    view = jnp.broadcast_to(view, light.shape)

    def albedo(surface):
        return float(jnp.sum(_brdf(surface, light, view) * light[:, 2]) * solid_angle)

    lambertian = albedo(_surface(1.0, roughness, 0.0, 0.0))
    assert lambertian == pytest.approx(1.0, abs=1e-3)
    white = albedo(_surface(1.0, roughness, 0.0))
    assert 0.96 < white < 1.02
    metal = albedo(_surface(1.0, roughness, 1.0))
    a, b = reflectance.environment_brdf(jnp.float32(cosine), jnp.float32(roughness))
    assert metal < 1.001
    assert metal == pytest.approx(float(a + b), abs=0.04)


@pytest.mark.parametrize("kind", ["fabric", "uniform", "metal"])
def test_only_rough_objects_are_lambertian(kind):
    point = tuple(jnp.linspace(-1, 1, 64) * scale for scale in (0.3, 0.5, 0.7))

    @jax.jit
    @jax.vmap
    def draw(key):
        index = jnp.int32(MATERIALS.index(kind))
        surface = materials.draw_surface(key, index, point, jnp.zeros(64))
        return surface.specular == 0, jnp.median(surface.roughness)

    matt, roughness = draw(jax.random.split(jax.random.key(0), 400))
    share = {"fabric": 0.4, "uniform": 0.4 * 0.5 / 0.8, "metal": 0.4 * 0.1 / 0.48}
    assert np.mean(matt) == pytest.approx(share[kind], abs=0.08)
    assert np.min(roughness[matt]) > 0.3


def test_paint_covers_some_of_some_surfaces():
    point = tuple(jax.random.uniform(jax.random.key(9), (3, 4000), minval=-1))
    bare = reflectance.Surface(
        jnp.full((3, 4000), 0.5), jnp.full(4000, 0.5), jnp.ones(4000), jnp.float32(1)
    )
    keys = jax.random.split(jax.random.key(0), 40)
    paint = jax.jit(jax.vmap(lambda key: materials.paint(key, 0.5, bare, point)))
    painted = paint(keys)
    share = np.mean(np.asarray(painted.metallic) < 0.5, axis=1)
    assert 10 <= np.sum(share > 0) <= 30
    assert 0.01 < np.median(share[share > 0]) < 0.6
    covered = np.asarray(painted.metallic) == 0
    for color, inside in zip(np.asarray(painted.base_color), covered, strict=True):
        if inside.any():  # one paint each
            assert np.ptp(color[:, inside], axis=1).max() < 1e-6


def test_metal_is_spotted_with_paint_or_rust():
    point = tuple(jax.random.uniform(jax.random.key(9), (3, 2000), minval=-1))
    bare = reflectance.Surface(
        jnp.full((3, 2000), 0.7), jnp.full(2000, 0.2), jnp.ones(2000), jnp.float32(1)
    )
    spot = jax.jit(
        jax.vmap(lambda key, used: materials.spot_metal(key, used, bare, point))
    )
    keys, used = jax.random.split(jax.random.key(0), 60), np.arange(60) % 3 > 0
    surface = jax.tree.map(np.asarray, spot(keys, jnp.asarray(used)))
    share = np.mean(surface.metallic < 0.5, axis=1)
    assert not share[~used].any() and np.all(
        surface.base_color[~used] == np.float32(0.7)
    )
    assert 0.1 < np.median(share[used]) < 0.6
    coated = surface.metallic == 0
    rough = [
        r[c].mean() for r, c in zip(surface.roughness, coated, strict=True) if c.any()
    ]
    assert 0.3 < np.mean(np.array(rough) > 0.6) < 0.8 and np.min(rough) < 0.4
