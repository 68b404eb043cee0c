"""Geometry, light and shadow against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from unips_jax.metrics import angular_error_deg
from unips_jax.render import describe
from unips_jax.scenes import (
    SHAPE_KINDS,
    SceneConfig,
    geometry,
    grids,
    lights,
    materials,
    sdf,
    shading,
    shapes,
    tracing,
)
from unips_jax.scenes import render as scenes_render

CONFIG = SceneConfig()
FLAT = {"twist": 0.0, "lathe": 0.0, "mirror": 0.0, "wave_warp": 0.0, "wave_ridge": 0.0}


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
        neck=jnp.asarray([0.0, 0.0, 1.0]),
        taper=jnp.float32(0),
        slab=jnp.asarray([0.0, 1e3]),
        center=jnp.zeros(3),
        radius=jnp.float32(1),
        kind=jnp.int32(0),
        **{name: jnp.float32(value) for name, value in FLAT.items()},
    )


def look(shape, *, size=32, perspective=0.0, distance=3.0, half=1.0, config=CONFIG):
    camera = tracing.Camera(
        jnp.float32(perspective), jnp.float32(distance), jnp.asarray([0.0, 0, half])
    )
    return jax.jit(
        lambda s: geometry.finish_geometry(
            jax.random.key(0), s, jnp.eye(3), camera, size=size, config=config
        )
    )(shape)


@pytest.fixture(scope="module")
def sphere():
    return look(make_shape(balls=[((0, 0, 0), 0.9)]))


def matt(geometry_, color=0.6):
    count = geometry_.mask.size
    return materials.Surface(
        base_color=jnp.full((3, count), color),
        roughness=jnp.full(count, 0.5),
        metallic=jnp.zeros(count),
        specular=jnp.float32(0),
    )


def constant_environment(radiance):
    zeros = jnp.zeros(3)
    full = zeros + radiance
    return lights.Environment(
        rotation=jnp.eye(3)[None],
        zenith=full,
        horizon=full,
        ground=full,
        axes=jnp.broadcast_to(jnp.eye(3), (lights.NUM_LOBES, 3, 3)),
        half=jnp.full((lights.NUM_LOBES, 2), 0.1),
        color=jnp.zeros((lights.NUM_LOBES, 3)),
        clutter=jnp.float32(0),
        clutter_frequency=jnp.float32(1),
        scale=jnp.ones(1),
    )


def directional(geometry_, surface, direction):
    direction = jnp.asarray(direction, jnp.float32)
    direction = direction / jnp.linalg.norm(direction)
    near, radius = jnp.float32(0), jnp.float32(0.005)
    clear = jax.jit(shading.key_clearance)(geometry_, direction, near)
    image = shading.shade_key_light(geometry_, surface, direction, near, radius, clear)
    return np.asarray(image).reshape(3, *geometry_.mask.shape)[0]


def test_the_sphere_is_where_it_should_be(sphere):
    u, v = (np.asarray(c).reshape(32, 32) for c in grids.pixel_grid(32))
    inside = np.hypot(u, v)
    assert np.all(sphere.mask[inside < 0.88])
    assert not np.any(sphere.mask[inside > 0.93])
    z = np.sqrt(np.maximum(0.81 - u**2 - v**2, 0))
    true = np.stack([u, v, z], -1) / 0.9
    interior = inside < 0.85
    error = angular_error_deg(sphere.normals, true)
    assert np.max(np.asarray(error)[interior]) < 0.3
    assert v[0, 0] > 0 > u[0, 0]  # row 0 on top, y up
    assert np.all(np.asarray(sphere.normals)[~np.asarray(sphere.mask)] == 0)


def test_normals_are_the_derivative_of_the_displaced_surface():
    shape = make_shape(
        balls=[((0, 0, 0), 0.8)], noise=0.02, frequency=4.0, amplitude=0.04
    )
    found = look(shape)
    shape = found.shape
    mask = np.asarray(found.mask)
    points = np.asarray(found.positions)[mask]
    step = 2e-3

    @jax.jit
    def value(p):
        point = (p[:, 0], p[:, 1], p[:, 2])
        relief = sdf.detail(shape, point) * shape.step_scale
        return sdf.distance(shape, point) - relief

    slope = [
        np.asarray(value(points + step * axis) - value(points - step * axis))
        for axis in np.eye(3, dtype=np.float32)
    ]
    error = angular_error_deg(np.asarray(found.normals)[mask], np.stack(slope, -1))
    facing = np.stack(slope, -1)[:, 2] > 0.1 * np.linalg.norm(slope, axis=0)
    assert np.mean(np.asarray(error)[facing]) < 0.15
    assert np.quantile(np.asarray(error)[facing], 0.99) < 1.0


def test_a_neck_narrows_the_object_and_tilts_its_normals():
    shape = make_shape(slabs=[((0, 0, 0), (0.5, 0.85, 0.5))])
    shape = shape._replace(
        neck=jnp.asarray([0.6, 0.1, 0.4]), step_scale=jnp.float32(0.6)
    )
    found = look(shape, size=64)
    u, v = (np.asarray(c).reshape(64, 64) for c in grids.pixel_grid(64))
    away = (v - 0.1) / 0.4
    width = 0.5 * (1 - 0.6 / (1 + away**2))
    inside = np.abs(v) < 0.8
    assert np.all(found.mask[inside & (np.abs(u) < width - 0.03)])
    assert not np.any(found.mask[inside & (np.abs(u) > width + 0.03)])
    slope = 0.5 * 0.6 * 2 * away / 0.4 / (1 + away**2) ** 2  # of the face z = width(y)
    true = np.stack([0 * v, -slope, np.ones_like(v)], -1)
    face = inside & (np.abs(u) < width - 0.05)
    assert np.max(np.asarray(angular_error_deg(found.normals, true))[face]) < 0.3


@pytest.mark.parametrize("taper", [0.6, -0.6])
def test_a_taper_narrows_the_object_towards_one_end(taper):
    shape = make_shape(slabs=[((0, 0, 0), (0.5, 0.85, 0.5))])
    shape = shape._replace(taper=jnp.float32(taper), step_scale=jnp.float32(0.8))
    found = look(shape, size=64)
    u, v = (np.asarray(c).reshape(64, 64) for c in grids.pixel_grid(64))
    width = 0.5 * (1 - 0.6 * (0.5 + 0.5 * np.sign(taper) * v))
    inside = np.abs(v) < 0.8
    assert np.all(found.mask[inside & (np.abs(u) < width - 0.03)])
    assert not np.any(found.mask[inside & (np.abs(u) > width + 0.03)])
    true = np.array([0.0, 0.15 * np.sign(taper), 1.0])  # of the face z = width(y)
    face = inside & (np.abs(u) < width - 0.05)
    assert np.max(np.asarray(angular_error_deg(found.normals, true))[face]) < 0.3


@pytest.mark.parametrize("kind", ["composition", "lathe", "thin"])
def test_objects_are_hardly_ever_in_pieces(kind):
    @jax.jit
    def inside(key):
        shape = shapes.draw_shape(key, jnp.int32(SHAPE_KINDS.index(kind)))
        axes = (jnp.linspace(-1, 1, 72) * shape.radius + c for c in shape.center)
        return sdf.distance(shape, tuple(jnp.meshgrid(*axes, indexing="ij"))) < 0

    broken = 0
    for key in jax.random.split(jax.random.key(3), 24):
        pieces, _ = ndimage.label(np.asarray(inside(key)), np.ones((3, 3, 3)))
        sizes = np.sort(np.bincount(pieces.ravel())[1:])
        broken += sizes[-1] < 0.95 * sizes.sum()
    assert broken <= 3


def test_normals_face_the_viewer_and_are_unit(sphere):
    mask = np.asarray(sphere.mask)
    normals = np.asarray(sphere.normals)[mask]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert np.min(np.sum(normals * np.asarray(sphere.view)[mask], -1)) > -1e-5


def test_what_a_contour_hides_begins_right_behind_it():
    balls = [((0, 0, -0.25), 0.7), ((0, 0.1, 0.8), 0.15)]
    found = look(make_shape(balls=balls), size=128)
    u, v = (np.asarray(c).reshape(128, 128) for c in grids.pixel_grid(128))
    true = np.zeros((128, 128, 3))
    for (_, y, _), radius in balls:
        inside = np.hypot(u, v - y) < radius
        z = np.sqrt(np.maximum(radius**2 - u**2 - (v - y) ** 2, 0))
        true[inside] = (np.stack([u, v - y, z], -1) / radius)[inside]
    np.testing.assert_array_equal(found.mask, np.hypot(u, v) < 0.7)
    error = np.asarray(angular_error_deg(found.normals, true))[found.mask]
    assert np.max(error) < 1


def test_perspective_points_project_to_their_pixels():
    found = look(
        make_shape(balls=[((0.1, 0, 0), 0.8)]),
        perspective=1.0,
        distance=1.6,
        half=1.2,
    )
    mask = np.asarray(found.mask)
    x, y, z = np.asarray(found.positions)[mask].T
    u, v = (np.asarray(c).reshape(32, 32)[mask] for c in grids.pixel_grid(32))
    depth = 1.6 - z
    np.testing.assert_allclose(x / depth * 1.6 / 1.2, u, atol=1e-4)
    np.testing.assert_allclose(y / depth * 1.6 / 1.2, v, atol=1e-4)
    assert float(found.focal) == pytest.approx(18 * 1.6 / 1.2)
    # A sphere shows less than a hemisphere: the rim's normals still face away from z.
    view = np.asarray(found.view)[mask]
    np.testing.assert_allclose(
        view,
        np.stack([-x, -y, depth], -1) / np.linalg.norm([x, y, depth], axis=0)[:, None],
        atol=1e-4,
    )


def test_lambertian_sphere_under_a_directional_light(sphere):
    for direction in ((0, 0, 1), (-1, 0.3, 1), (0, 1, 0.4)):
        image = directional(sphere, matt(sphere), direction)
        unit = np.asarray(direction) / np.linalg.norm(direction)
        cosine = np.asarray(sphere.normals) @ unit
        inside = np.asarray(sphere.mask) & (cosine > 0.1)
        expected = 0.6 / np.pi * cosine
        np.testing.assert_allclose(image[inside], expected[inside], rtol=0.01)
        assert np.all(image[np.asarray(sphere.mask) & (cosine < 0)] == 0)


def test_intensities_told_are_those_of_a_lambertian_surface(sphere, monkeypatch):
    albedo = np.array([0.6, 0.4, 0.2], np.float32)
    surface = matt(sphere)._replace(base_color=jnp.tile(albedo[:, None], 32 * 32))
    monkeypatch.setattr(scenes_render, "draw_surface", lambda *_: surface)
    config = SceneConfig(sensor=False, interreflection=False)
    scene = jax.jit(
        lambda key: scenes_render.shade(
            key, sphere, num_images=3, config=config, light_kind=0
        )
    )(jax.random.key(1))
    facts, scene = describe(scene), jax.tree.map(np.asarray, scene)
    intensities = np.asarray(facts["light_intensities"])
    assert np.ptp(intensities, axis=0).min() > 0.03
    cosine = np.einsum("hwc,nc->nhw", scene.normals, facts["light_directions"])
    expected = albedo * cosine[..., None] * intensities[:, None, None]
    lit = scene.mask & (cosine > 0.1)
    assert lit.sum((1, 2)).min() > 200
    np.testing.assert_allclose(scene.images[lit], expected[lit], rtol=0.01)
    assert np.all(scene.images[scene.mask & (cosine < 0)] == 0)


def test_light_from_the_left_brightens_slopes_that_face_left(sphere):
    image = directional(sphere, matt(sphere), (-1, 0, 0.5))
    left = np.asarray(sphere.normals)[..., 0] < -0.3
    right = np.asarray(sphere.normals)[..., 0] > 0.3
    assert image[left].mean() > 3 * image[right].mean()
    assert left[:, :16].sum() > 0 and not left[:, 17:].any()
    above = directional(sphere, matt(sphere), (0, 1, 0.5))
    assert above[:16].sum() > 3 * above[16:].sum()


def test_lambertian_sphere_under_a_constant_environment(sphere):
    image, _ = shading.shade_environment(
        sphere, matt(sphere), constant_environment(2.0)
    )
    inside = np.asarray(sphere.mask).reshape(-1)
    np.testing.assert_allclose(np.asarray(image)[0, :, inside], 1.2, rtol=0.03)


def test_cast_shadow_of_a_ball_over_a_plane():
    shape = make_shape(
        balls=[((0, 0, 0.5), 0.2)], slabs=[((0, 0, -0.1), (0.9, 0.9, 0.1))]
    )
    found = look(shape, size=64)
    image = directional(found, matt(found), (1, 0, 1))
    lit = 0.6 / np.pi / np.sqrt(2)
    u, v = (np.asarray(c).reshape(64, 64) for c in grids.pixel_grid(64))
    plane = (np.abs(u) < 0.8) & (np.abs(v) < 0.8) & (np.hypot(u, v) > 0.25)
    # The shadow is an ellipse about x = -0.5, half axes 0.2 sqrt(2) and 0.2.
    ellipse = np.hypot((u + 0.5) / np.sqrt(2), v)
    assert np.all(image[plane & (ellipse < 0.14)] < 0.05 * lit)
    outside = image[plane & (ellipse > 0.26)]
    np.testing.assert_allclose(outside, lit, rtol=0.05)


@pytest.fixture(scope="module")
def bowl():
    """A round hollow of radius 0.5, its center 0.1 above a plate's face at z = 0."""
    shape = make_shape(
        slabs=[((0, 0, -0.3), (0.7, 0.7, 0.3))], hollows=[((0, 0, 0.1), 0.5)]
    )
    # Marched as carefully as a wavy object.
    return look(shape._replace(step_scale=jnp.float32(0.5)), size=64)


def test_a_hollow_is_shadowed_by_its_rim(bowl):
    light = np.asarray([np.sin(np.pi / 3), 0, np.cos(np.pi / 3)])
    image = directional(bowl, matt(bowl), light)
    u, v = (np.asarray(c).reshape(64, 64) for c in grids.pixel_grid(64))
    inside = np.hypot(u, v) < 0.45
    point = np.stack([u, v, 0.1 - np.sqrt(np.maximum(0.25 - u**2 - v**2, 0))], -1)
    from_center = point - [0, 0, 0.1]
    facing = -(from_center @ light)
    leaves = point + 2 * facing[..., None] * light  # where the ray meets the sphere
    shadow = inside & (facing > 0.02) & (leaves[..., 2] < 0)
    lit = inside & (facing > 0.02) & (leaves[..., 2] > 0)
    expected = 0.6 / np.pi * facing / 0.5
    assert np.mean(image[shadow] > 0.5 * expected[shadow]) < 0.35
    assert np.mean(image[lit] < 0.5 * expected[lit]) < 0.02


def test_a_round_hollow_sees_its_share_of_the_sky_and_itself(bowl):
    around, hidden = shading.shade_environment(
        bowl, matt(bowl), constant_environment(1.0)
    )
    u, v = grids.pixel_grid(64)
    inside = np.asarray(jnp.hypot(u, v) < 0.45).reshape(-1)
    # The opening is 0.6 of the sphere, and every point sees it under that share.
    sky, itself = np.asarray(around)[0, 0, inside], np.asarray(hidden)[0, inside]
    np.testing.assert_allclose(np.mean(sky), 0.6 * 0.6, atol=0.04)
    np.testing.assert_allclose(sky + itself, 0.6, atol=1e-4)


def test_constant_environment_never_amplifies(sphere):
    count = sphere.mask.size
    for metallic in (0.0, 1.0):
        surface = materials.Surface(
            jnp.ones((3, count)),
            jnp.linspace(0.06, 1.0, count),
            jnp.full(count, metallic),
            jnp.float32(1),
        )
        image, hidden = shading.shade_environment(
            sphere, surface, constant_environment(1.0)
        )
        inside = np.asarray(sphere.mask).reshape(-1)
        assert np.max(np.asarray(image + hidden)[0, :, inside]) < 1.02
        assert np.min(np.asarray(image)[0, :, inside]) > 0.3


def test_near_light_falls_off_with_the_square_of_the_distance():
    point = tuple(jnp.asarray([c]) for c in (0.0, 0.0, 1.0))
    direction, reach, factor = lights.key_light_at(
        jnp.asarray([0.0, 0.0, 3.0]), jnp.float32(1), point
    )
    assert [float(c[0]) for c in direction] == pytest.approx([0, 0, 1])
    assert (float(reach[0]), float(factor[0])) == pytest.approx((2, 0.25))


def test_entropy_of_known_maps():
    mask = jnp.ones((16, 16))
    plane = jnp.broadcast_to(jnp.asarray([0.0, 0, 1]), (16, 16, 3))
    assert float(geometry.normal_entropy_bits(plane, mask)) == 0
    centers = (np.arange(16) + 0.5) / 8 - 1
    every = np.stack([*np.meshgrid(centers, centers), np.ones((16, 16))], -1)
    entropy = geometry.normal_entropy_bits(jnp.asarray(every, jnp.float32), mask)
    assert float(entropy) == pytest.approx(8.0, abs=1e-4)
    assert float(geometry.normal_entropy_bits(plane, 0 * mask)) == 0


def test_pick_and_spread_ignore_what_is_not_masked():
    mask = np.zeros((8, 12), bool)
    mask[1, 2] = mask[5:, 4:] = True
    values = jnp.asarray(np.where(mask, 3.0, 1e3), jnp.float32)
    small = grids.pick(values, jnp.asarray(mask), 4)
    assert small.shape == (2, 3)
    np.testing.assert_allclose(small[0, 0], 3.0)
    full = grids.spread(small, jnp.asarray(mask), 4)
    np.testing.assert_allclose(full[mask], 3.0, rtol=1e-3)


def test_bad_sizes_and_configurations_are_named():
    with pytest.raises(ValueError, match="multiple of 4, got 30"):
        geometry.render_geometry(jax.random.key(0), size=30)
    with pytest.raises(ValueError, match="light_weights: expected 5 weights"):
        SceneConfig(light_weights=(1.0,))
    with pytest.raises(ValueError, match="blur_rate: expected a rate"):
        SceneConfig(blur_rate=2.0)
    with pytest.raises(ValueError, match="focal_range_mm"):
        SceneConfig(focal_range_mm=(50.0, 20.0))
