"""Shapes and what is seen of them against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_objects import look, make_shape, profile
from scipy import ndimage

from unips_jax.metrics import angular_error_deg
from unips_jax.scenes import (
    SHAPE_KINDS,
    SceneConfig,
    geometry,
    grids,
    poses,
    sdf,
    shapes,
)


@pytest.fixture(scope="module")
def sphere():
    return look(make_shape(balls=[((0, 0, 0), 0.9)]))


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


def test_the_profile_is_the_outline_and_tilts_the_normals():
    shape = make_shape(slabs=[((0, 0, 0), (0.5, 0.9, 0.5))])
    knots, widths = np.linspace(-1, 1, 5), np.array([0.4, 1, 0.3, 0.8, 0.6])
    shape = shape._replace(profile=profile(widths), step_scale=jnp.float32(0.6))
    found = look(shape, size=64)
    u, v = (np.asarray(c).reshape(64, 64) for c in grids.pixel_grid(64))
    width = 0.5 * np.interp(v, knots, widths)
    inside = np.abs(v) < 0.85
    assert np.all(found.mask[inside & (np.abs(u) < width - 0.03)])
    assert not np.any(found.mask[inside & (np.abs(u) > width + 0.03)])
    index = np.searchsorted(knots, v) - 1
    slope = 0.5 * (np.diff(widths) / np.diff(knots))[index]  # of the face z = width(y)
    true = np.stack([0 * v, -slope, np.ones_like(v)], -1)
    away = np.min(np.abs(v[..., None] - knots), -1) > 0.03
    face = inside & away & (np.abs(u) < width - 0.05)
    assert np.max(np.asarray(angular_error_deg(found.normals, true))[face]) < 0.3


def test_rounded_knots_of_a_profile_are_near_the_straight_ones():
    y = jnp.linspace(-1, 1, 201)
    widths = jnp.asarray([0.5, 1.0, 0.2, 0.9, 0.4])
    shape = make_shape()._replace(profile=profile(widths, 0.1))
    rounded = sdf._width(shape, y)
    straight = jnp.interp(y, jnp.linspace(-1, 1, 5), widths)
    away = jnp.min(abs(y[:, None] - jnp.asarray([-0.5, 0.0, 0.5])), -1)
    np.testing.assert_allclose(rounded[away > 0.2], straight[away > 0.2], atol=0.06)
    bends = 0.5 * np.diff(np.diff(widths) / 0.5)
    np.testing.assert_allclose((rounded - straight)[50:151:50], 0.1 * bends, atol=0.03)


def test_drawn_shapes_are_finite():
    kinds = jnp.tile(jnp.arange(len(SHAPE_KINDS)), 40)
    keys = jax.random.split(jax.random.key(3), kinds.size)
    drawn = jax.jit(jax.vmap(shapes.draw_shape))(keys, kinds)
    for path, values in jax.tree.leaves_with_path(drawn):
        assert np.all(np.isfinite(values)), jax.tree_util.keystr(path)


@pytest.mark.parametrize("kind", ["composition", "lathe", "thin"])
def test_objects_are_hardly_ever_in_pieces(kind):
    @jax.jit
    def inside(key):
        shape = shapes.draw_shape(key, jnp.int32(SHAPE_KINDS.index(kind)))
        axes = (jnp.linspace(-1, 1, 64) * shape.radius + c for c in shape.center)
        return sdf.distance(shape, tuple(jnp.meshgrid(*axes, indexing="ij"))) < 0

    broken = 0
    for key in jax.random.split(jax.random.key(3), 24)[::2]:
        pieces, _ = ndimage.label(np.asarray(inside(key)), np.ones((3, 3, 3)))
        sizes = np.sort(np.bincount(pieces.ravel())[1:])
        broken += sizes[-1] < 0.95 * sizes.sum()
    assert broken <= 2


def test_objects_cut_away_whole_lose_their_cuts(monkeypatch):
    @jax.jit
    def render(shape):
        monkeypatch.setattr(geometry, "draw_shape", lambda *_: shape)
        return geometry.render_geometry(jax.random.key(0), size=32, shape=0)

    for hollow, keeps in ((0.3, True), (0.52, False), (0.9, False)):
        shape = make_shape(balls=[((0, 0, 0), 0.5)], hollows=[((0, 0, 0), hollow)])
        found = render(shape)
        assert np.mean(found.mask) > 0.6  # a disc that reaches the frame: 0.785
        assert float(found.entropy) > 4
        assert np.array_equal(found.shape.slots, shape.slots) == keeps


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


def test_entropy_of_known_maps():
    mask = jnp.ones((16, 16))
    plane = jnp.broadcast_to(jnp.asarray([0.0, 0, 1]), (16, 16, 3))
    assert float(poses.normal_entropy_bits(plane, mask)) == 0
    centers = (np.arange(16) + 0.5) / 8 - 1
    every = np.stack([*np.meshgrid(centers, centers), np.ones((16, 16))], -1)
    entropy = poses.normal_entropy_bits(jnp.asarray(every, jnp.float32), mask)
    assert float(entropy) == pytest.approx(8.0, abs=1e-4)
    assert float(poses.normal_entropy_bits(plane, 0 * mask)) == 0


def test_pick_and_spread_ignore_what_is_not_masked():
    mask = np.zeros((8, 12), bool)
    mask[1, 2] = mask[5:, 4:] = True
    values = jnp.asarray(np.where(mask, 3.0, 1e3), jnp.float32)
    small = grids.pick(values, jnp.asarray(mask), 4)
    assert small.shape == (2, 3)
    np.testing.assert_allclose(small[0, 0], 3.0)
    full = grids.spread(small, jnp.asarray(mask), 4)
    np.testing.assert_allclose(full[mask], 3.0, rtol=1e-3)


@pytest.mark.parametrize("stride", [2, 4])
def test_what_is_picked_comes_back_to_its_place(stride):
    """No shadow lies half a pixel off what casts it."""
    mask = jnp.ones((16, 24), bool)
    rows, columns = jnp.mgrid[:16, :24].astype(jnp.float32)
    for ramp in (rows, columns):
        full = grids.spread(grids.pick(ramp, mask, stride), mask, stride)
        inner = (slice(stride, -stride),) * 2
        np.testing.assert_allclose(full[inner], ramp[inner], atol=1e-3)


def test_the_sky_may_have_many_directions():
    config = SceneConfig(num_directions=100)
    render = functools.partial(geometry.render_geometry, size=16, config=config)
    assert jax.eval_shape(render, jax.random.key(0)).directions.shape == (100, 3)


def test_bad_sizes_and_configurations_are_named():
    with pytest.raises(ValueError, match="multiple of 4, got 30"):
        geometry.render_geometry(jax.random.key(0), size=30)
    with pytest.raises(ValueError, match="light_weights: expected 5 weights"):
        SceneConfig(light_weights=(1.0,))
    with pytest.raises(ValueError, match="blur_rate: expected a rate"):
        SceneConfig(blur_rate=2.0)
    with pytest.raises(ValueError, match="focal_range_mm"):
        SceneConfig(focal_range_mm=(50.0, 20.0))


@pytest.mark.parametrize("finest", [4.0, 100.0])
def test_carvings_stay_steep_however_coarse(finest):
    shape = make_shape(balls=[((0, 0, 0), 0.9)])

    @functools.partial(jax.vmap, in_axes=(0, None))
    def carve(key, rate):
        carved, hollow = geometry._carve(key, rate, shape, jnp.float32(finest))
        return carved.detail, hollow

    keys = jax.random.split(jax.random.key(0), 50)
    detail, hollow = carve(keys, 1.0)
    assert detail.frequency.max() <= finest and detail.frequency.min() >= 4
    parts = (detail.noise, detail.groove, detail.ridge, detail.dimple, detail.weave)
    slope = np.asarray(sum(abs(part) for part in parts) * detail.frequency)
    slope = slope[slope > 0]  # three in ten are smooth
    assert slope.size > 25 and slope.min() > 0.04 and 0.3 < slope.max() < 0.9
    assert 0.1 <= hollow.min() < hollow.max() <= 0.6
    detail, hollow = carve(keys, 0.0)
    assert np.all(detail.frequency == shape.detail.frequency) and not hollow.any()


def test_hollows_of_a_relief_are_darker():
    shape = make_shape(balls=[((0, 0, 0), 0.9)], noise=0.02, frequency=4.0)
    light, dark = look(shape), look(shape, hollow=0.5)
    height, mask = np.asarray(light.height), np.asarray(light.mask)
    low = mask & (height < -0.3)
    seen, less = np.asarray(light.visibility), np.asarray(dark.visibility)
    assert low.sum() > 20
    np.testing.assert_array_equal(less[:, height > 0], seen[:, height > 0])
    expected = seen[:, low] * (1 - 0.5 * np.minimum(-height[low], 1))
    np.testing.assert_allclose(less[:, low], expected, rtol=1e-5, atol=1e-7)
