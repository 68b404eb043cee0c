"""What scenes of the long run share with photographs: borders, lamps, small errors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.scenes.config import SceneConfig
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.lamps import draw_lights
from unips_jax.scenes.sensor import record
from unips_jax.training.config import TrainConfig
from unips_jax.training.loss import plain_distance

PLAIN = SceneConfig(noise_rate=0.0, blur_rate=0.0, mask_error_rate=0.0)
POINT = 3


@pytest.mark.parametrize(
    ("rims", "mixed", "least", "most", "missed"),
    [
        (0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 0.9, 1.0, 0.0),
        (0.3, 0.9, 0.6, 1.0, 0.4),
    ],
)
def test_border_pixels_are_partly_background(rims, mixed, least, most, missed):
    """Of a disc that is bright all over; its mask is as exact as without."""
    y, x = np.mgrid[-1:1:48j, -1:1:48j]
    mask = jnp.asarray(np.hypot(x, y) < 0.8)
    inner = np.hypot(x, y) < 0.6
    ring = np.asarray(mask) & (np.hypot(x, y) > 0.74)
    config = dataclasses.replace(PLAIN, rim_rate=rims, mixed_rate=mixed)
    run = jax.jit(lambda key: record(key, jnp.ones((2, 3, 48, 48)), mask, config)[:2])
    off, other = [], []
    for seed in range(40):
        images, found = (np.asarray(a) for a in run(jax.random.key(seed)))
        shown = images[0, 1]
        there = ring & found
        change = abs(shown[there] / np.median(shown[inner]) - 1)
        off.append(change.size and change.mean() > 0.05)
        other.append((found != np.asarray(mask)).any())
    assert least <= np.mean(off) <= most
    assert np.mean(other) <= missed


def test_lamps_stand_as_far_as_they_are_told():
    def distances(far):
        def draw(key):
            keys, _ = draw_lights(Draws(key, 200), jnp.int32(POINT), 4, far=far)
            return jnp.linalg.norm(keys.vector, axis=-1)

        return np.asarray(jax.vmap(draw)(jax.random.split(jax.random.key(0), 50)))

    near = distances(None)
    assert 1.0 < near.min() and near.max() < 3.8
    np.testing.assert_array_equal(distances(jnp.float32(0)), near)
    far = distances(jnp.float32(10))
    assert 8 <= far.min() and far.max() <= 12.5


def test_small_errors_count_where_the_loss_is_less_smooth():
    def slope(degrees, smoothing):
        distance = 2 * np.sin(np.radians(degrees) / 2)
        return float(jax.grad(lambda d: plain_distance(d**2, smoothing))(distance))

    assert slope(1.0, TrainConfig().distance_smoothing) < 0.5
    assert slope(1.0, 1e-4) > 0.8 and slope(15.0, 1e-4) > 0.99
