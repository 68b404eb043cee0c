import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.scenes import SceneConfig, render_batch, render_scene
from unips_jax.scenes.sensor import _response, erode, record

CONFIG = SceneConfig(rotation_candidates=2, num_directions=8)
render = functools.partial(render_batch, size=32, num_images=3, config=CONFIG)


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(11), 12)


@pytest.fixture(scope="module")
def scenes(keys):
    return jax.tree.map(np.asarray, render(keys))


def test_scenes_keep_their_promises(scenes):
    assert scenes.images.shape == (12, 3, 32, 32, 3)
    assert scenes.images.dtype == np.float32 and scenes.mask.dtype == bool
    for leaf in jax.tree.leaves(scenes):
        assert np.all(np.isfinite(leaf))
    assert scenes.images.min() >= 0 and scenes.images.max() <= 1
    outside = ~scenes.mask
    assert np.all(np.moveaxis(scenes.images, 1, -2)[outside] == 0)
    assert np.all(scenes.normals[outside] == 0)
    length = np.linalg.norm(scenes.normals[scenes.mask], axis=-1)
    np.testing.assert_allclose(length, 1, atol=1e-5)
    away = scenes.light_kind != 0
    assert np.all(scenes.light_directions[away] == 0)
    length = np.linalg.norm(scenes.light_directions[~away], axis=-1)
    np.testing.assert_allclose(length, 1, atol=1e-5)


def test_a_good_camera_scales_each_image_by_what_it_says():
    clean = SceneConfig(
        **dict(linear_rate=1, noise_rate=0, blur_rate=0, mask_error_rate=0),
        eight_bit_rate=0,
    )
    rng = np.random.default_rng(0)
    radiance = rng.uniform(0, 1, (4, 3, 16, 16)) * [
        [[[1]]],
        [[[3]]],
        [[[0.2]]],
        [[[9]]],
    ]
    mask = np.ones((16, 16), bool)
    images, _, gain = jax.jit(record, static_argnums=3)(
        jax.random.key(0), jnp.asarray(radiance, jnp.float32), mask, clean
    )
    assert gain.shape == (4, 3)
    expected = np.clip(radiance * np.asarray(gain)[..., None, None], 0, 1)
    np.testing.assert_allclose(images, expected, atol=2e-3)  # faint noise remains
    assert 0.1 < (expected < 1).mean()


def test_responses_are_those_of_their_names():
    linear = np.float32([0, 0.002, 0.05, 0.2140, 0.5, 1])
    found = [np.asarray(_response(linear, jnp.int32(i), 2.2)) for i in range(3)]
    np.testing.assert_allclose(found[0], linear, atol=1e-5)
    srgb = [0, 0.02584, 0.24780, 0.5, 0.73536, 1]
    np.testing.assert_allclose(found[1], srgb, atol=1e-4)
    np.testing.assert_allclose(found[2][1:], linear[1:] ** (1 / 2.2), rtol=1e-5)


def test_erosion_takes_pixels_of_the_border_alone():
    mask = np.zeros((16, 16), bool)
    mask[2:, 3:13] = True  # cut by the frame below, where nothing is taken
    inner = np.zeros_like(mask)
    inner[3:, 4:12] = True
    uniform = np.random.default_rng(0).random(mask.shape)
    assert np.array_equal(erode(mask, uniform, 0.0), mask)
    assert np.array_equal(erode(mask, uniform, 1.0), inner)
    some = np.asarray(erode(mask, uniform, 0.5))
    assert np.all(some >= inner) and np.all(some <= mask)
    assert 0.3 < (some & ~inner).sum() / (mask & ~inner).sum() < 0.7


def test_silhouettes_reach_the_frame(scenes):
    share = scenes.mask.mean((1, 2))
    assert share.min() > 0.05
    rows, columns = scenes.mask.any(2).sum(1), scenes.mask.any(1).sum(1)
    assert np.all(np.maximum(rows, columns) >= 25)


def test_a_scene_depends_on_its_key_alone(keys, scenes):
    again = jax.tree.map(np.asarray, render(keys[::-1]))
    leaves = jax.tree.leaves(scenes), jax.tree.leaves(again)
    for there, back in zip(*leaves, strict=True):
        np.testing.assert_array_equal(there, back[::-1])
    assert len({image.tobytes() for image in scenes.images}) == 12


def test_the_batch_compiles_once(keys):
    render(keys)
    before = render_batch._cache_size()
    render(jax.random.split(jax.random.key(12), 12))
    assert render_batch._cache_size() == before


@pytest.mark.slow
def test_vmap_equals_a_loop(keys):
    many = render(keys)
    one = jax.jit(lambda key: render_scene(key, size=32, num_images=3, config=CONFIG))
    for index in range(3):
        single = one(keys[index])
        agree = np.mean(np.asarray(single.mask) == np.asarray(many.mask[index]))
        assert agree > 0.995
        both = np.asarray(single.mask & many.mask[index])
        difference = np.abs(single.normals - many.normals[index])[both]
        assert np.quantile(np.asarray(difference), 0.99) < 1e-3
        difference = np.abs(single.images - many.images[index])[:, both]
        assert np.quantile(np.asarray(difference), 0.99) < 1e-2


@pytest.mark.slow
def test_overrides_are_honoured(keys):
    scene = render(
        keys,
        light_kind=jnp.int32(1),
        material=jnp.int32(5),
        shape=jnp.int32(2),
        camera=jnp.int32(1),
    )
    assert np.all(np.asarray(scene.light_kind) == 1)
    assert np.all(np.asarray(scene.material) == 5)
    assert np.all(np.asarray(scene.shape_kind) == 2)
    assert np.all(np.asarray(scene.focal) > 0)
