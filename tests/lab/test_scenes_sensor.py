"""Exposure and noise of the scenes' camera."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.scenes import SceneConfig, sensor


@pytest.mark.parametrize(
    ("pattern", "usual", "spare"),
    [((1, 1), 2.2**0.5, 1), ((0, 2), (3 * 1.1) ** 0.5, 7)],
)
def test_every_image_is_exposed_for_its_own_light(pattern, usual, spare):
    mask = jnp.zeros((4, 4), bool).at[1:3].set(True)
    light, target = np.float32([0.01, 1, 50]), jnp.asarray([0.3, 0.6, 0.9])
    shown = light[:, None, None, None] * jnp.repeat(jnp.asarray(pattern), 2)
    radiance = jnp.where(mask, shown, 1e3) * jnp.ones((3, 3, 4, 4))
    for how, measure in ((False, usual), (True, spare)):
        gain = sensor.exposure(radiance, mask, target, how)
        np.testing.assert_allclose(gain * light, target / measure, rtol=1e-3)


def test_noise_is_each_photographs_own():
    noisy = SceneConfig(
        linear_rate=1, eight_bit_rate=0, noise_rate=1, blur_rate=0, mask_error_rate=0
    )
    radiance, mask = jnp.full((3, 3, 24, 24), 0.4), jnp.ones((24, 24), bool)
    taken = jax.jit(sensor.record, static_argnums=3)
    images, _, _ = taken(jax.random.key(1), radiance, mask, noisy)
    values = np.asarray(images).reshape(9, -1)
    assert values.std(axis=1).min() > 5e-5
    assert np.abs(np.corrcoef(values) - np.eye(9)).max() < 0.2


def test_photographs_of_8_bits_are_made_linear_as_in_use():
    """Those of sRGB wholly, those of other curves in part, those of 16 bits not."""
    curved = SceneConfig(
        linear_rate=0, noise_rate=0, blur_rate=0, mask_error_rate=0, spare_rate=1
    )
    radiance = jnp.linspace(0.05, 1, 32 * 32).reshape(1, 1, 32, 32)
    radiance = radiance * jnp.ones((1, 3, 1, 1))
    mask = jnp.ones((32, 32), bool)
    keys = jax.random.split(jax.random.key(0), 200)
    take = jax.jit(jax.vmap(lambda key: sensor.record(key, radiance, mask, curved)))
    images, _, gain = take(keys)
    linear = np.clip(radiance * np.asarray(gain)[..., None, None], 0, 1)
    away = np.abs(np.asarray(images) - linear).mean(axis=(1, 2, 3, 4))
    assert 0.45 < np.mean(away < 0.004) < 0.68  # seven tenths of four fifths
    assert np.mean(away > 0.1) > 0.1


def test_linear_photographs_of_8_bits_stay_linear():
    config = SceneConfig(
        linear_rate=1, eight_bit_rate=1, noise_rate=0, blur_rate=0, mask_error_rate=0
    )
    radiance, mask = jnp.full((2, 3, 8, 8), 0.1), jnp.ones((8, 8), bool)
    take = jax.jit(lambda key: sensor.record(key, radiance, mask, config))
    images, _, gain = take(jax.random.key(0))
    linear = np.clip(radiance * gain[..., None, None], 0, 1)
    np.testing.assert_allclose(images, linear, atol=1.1 / 255)
