import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.scenes import SceneConfig, lamps, render_batch, rims, sensor
from unips_jax.scenes.draws import Draws

SIZE = 48


@pytest.fixture(scope="module")
def disc():
    y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    distance = 16 - np.hypot(x, y)
    return distance > 0, distance


def drawn(disc, *, seed=0, num_images=2):
    mask, _ = disc
    draws = Draws(jax.random.key(seed), 48 + 3 * num_images)
    uniform = jax.random.uniform(jax.random.key(seed + 1000), mask.shape)
    return rims.draw_rims(draws, uniform, jnp.ones((num_images, 3)), jnp.array(mask))


def test_depth_counts_pixels_from_the_border(disc):
    mask, distance = disc
    depth = np.asarray(rims.border_depth(jnp.array(mask)))
    assert depth.min() == -1 - rims.REACH and depth.max() == rims.REACH
    near = abs(distance) < rims.REACH - 1
    assert abs(depth - np.floor(distance))[near].max() <= 1.01
    assert np.mean(depth[near] == np.floor(distance)[near]) > 0.7


def test_the_frame_is_no_border():
    mask = jnp.zeros((16, 16), bool).at[8:].set(True)
    depth = np.asarray(rims.border_depth(mask))
    expected = np.clip(np.arange(16) - 8, -1 - rims.REACH, rims.REACH)
    np.testing.assert_array_equal(depth, np.tile(expected[:, None], 16))


def test_values_continue_beyond_the_mask(disc):
    mask, distance = disc
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    garbage = np.where(mask, 0, 1e6)
    values = np.stack([0 * x + 3, x]) + garbage
    found = np.asarray(rims.extend(jnp.array(values, jnp.float32), jnp.array(mask)))
    np.testing.assert_allclose(found[:, mask], values[:, mask], rtol=1e-6)
    reached = ~mask & (distance > -3.5)
    np.testing.assert_allclose(found[0][reached], 3, rtol=1e-6)
    # Neighbours on the object's side alone: the ramp lags by less than the way.
    assert abs(found[1] - x)[reached].max() < 4.5
    assert np.all(found[:, distance < -7] == 0)


@pytest.mark.parametrize("offset", [-3, -1, 0, 2, 4])
def test_masks_miss_the_object_by_the_offset(disc, offset):
    mask, _ = disc
    depth = np.asarray(rims.border_depth(jnp.array(mask)))
    made = drawn(disc)._replace(offset=jnp.full(mask.shape, float(offset)))
    found = np.asarray(rims.miss(made, jnp.array(mask)))
    np.testing.assert_array_equal(found, depth >= -offset)


def test_thin_objects_keep_their_mask():
    mask = jnp.zeros((16, 16), bool).at[4:12, 7:9].set(True)
    made = rims.Rims(jnp.bool_(True), 1.0 * mask, jnp.zeros((1, 3, 16, 16)), -2.0)
    np.testing.assert_array_equal(rims.miss(made, mask), mask)
    beside = jnp.where(jnp.arange(16) < 9, -2.0, 3.0)  # as many pixels, but others
    found = rims.miss(made._replace(offset=beside), mask)
    np.testing.assert_array_equal(found, mask)


def test_masks_are_wrong_in_both_directions_and_exact(disc):
    mask, _ = disc
    made = [drawn(disc, seed=seed) for seed in range(60)]
    masks = np.stack([rims.miss(one, jnp.array(mask)) for one in made])
    change = masks.sum((1, 2)) / mask.sum() - 1
    assert 8 <= (change == 0).sum() <= 25
    assert (change < -0.05).sum() > 5 and (change > 0.05).sum() > 15
    assert 0.1 < change.max() < 0.7
    reach = np.asarray(rims.border_depth(jnp.array(mask)))
    assert not masks[:, reach < -rims.REACH].any()


def test_borders_mix_with_the_background(disc):
    mask, distance = disc
    images = jnp.full((2, 3, SIZE, SIZE), 0.5) * mask
    made = drawn(disc)
    black = jnp.zeros_like(made.background)
    made = made._replace(background=black, mixed=jnp.bool_(True))
    mixed = np.asarray(rims.mix(made, images, jnp.array(mask)))
    np.testing.assert_allclose(mixed[..., distance > 3], 0.5, rtol=1e-5)
    assert np.all(mixed[..., distance < -3] == 0)
    border = mixed[..., (distance > 0) & (distance < 0.5)]
    assert 0.1 < border.min() and border.max() < 0.49
    sharp = rims.mix(made._replace(mixed=jnp.bool_(False)), images, jnp.array(mask))
    np.testing.assert_array_equal(sharp, images)


@pytest.mark.slow  # two programs of scenes
def test_scenes_know_the_truth_below_their_masks():
    options = {"rotation_candidates": 2, "num_directions": 8}
    options["shape_weights"] = (1, 1, 0, 1, 0, 0, 0)
    keys = jax.random.split(jax.random.key(5), 12)
    usual, rimmed = (
        render_batch(
            keys,
            size=SIZE,
            num_images=2,
            config=SceneConfig(rim_rate=rate, **options),
        )
        for rate in (0.0, 1.0)
    )
    length = jnp.linalg.norm(rimmed.normals, axis=-1)
    np.testing.assert_allclose(length[rimmed.mask], 1, atol=1e-5)
    assert np.all(np.asarray(length)[~rimmed.mask] == 0)
    both = rimmed.mask & usual.mask
    np.testing.assert_allclose(rimmed.normals[both], usual.normals[both], atol=1e-4)
    assert (rimmed.mask & ~usual.mask).any((1, 2)).sum() >= 3
    assert (usual.mask & ~rimmed.mask).any((1, 2)).sum() >= 2
    colors = rimmed.base_color[both], usual.base_color[both]
    np.testing.assert_allclose(*colors, atol=1e-4)
    for scene in (usual, rimmed):
        assert np.all(scene.base_color[scene.mask] > 0)
        for values in (scene.base_color, scene.roughness, scene.metallic):
            values = np.asarray(values)
            assert values.min() >= 0 and values.max() <= 1
            assert not np.any(values[~np.asarray(scene.mask)])


def test_images_outside_the_mask_stay_black(disc):
    mask, _ = disc
    radiance = jnp.ones((2, 3, SIZE, SIZE))
    config = SceneConfig(rim_rate=1.0)
    record = jax.jit(sensor.record, static_argnums=3)
    for seed in range(4):
        key = jax.random.key(seed)
        images, seen, _ = record(key, radiance, jnp.array(mask), config)
        assert np.all(np.asarray(images)[..., ~np.asarray(seen)] == 0)
        assert images.min() >= 0 and images.max() <= 1


def test_lights_keep_to_one_side():
    draw = jax.jit(lambda key: _lights(key, 1.0))
    corners = 0
    for seed in range(20):
        sides, direction = draw(jax.random.key(seed))
        np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-5)
        across = np.asarray(direction @ sides.axes.T)
        assert np.all(across[:, 0] >= -1e-6)
        corners += bool(sides.corner)
        assert np.all(across[:, 1] >= -1e-6) or not sides.corner
    assert 3 <= corners <= 14


def test_other_scenes_are_lit_as_ever():
    key = jax.random.key(3)
    sides, direction = _lights(key, 0.0)
    assert not sides.one and not sides.corner
    plain, _ = lamps.draw_lights(Draws(key, 400), jnp.int32(0), 8)
    np.testing.assert_array_equal(direction, plain.vector)


def _lights(key, rate):
    sides = lamps.draw_sides(
        Draws(jax.random.fold_in(key, 1), 8), SceneConfig(side_rate=rate)
    )
    keys, _ = lamps.draw_lights(Draws(key, 400), jnp.int32(0), 8, sides)
    return sides, keys.vector
