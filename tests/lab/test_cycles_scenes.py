"""What Cycles is asked to render: lamps, surroundings, and how objects lie."""

import numpy as np
import pytest

from unips_jax.cycles import lighting, run
from unips_jax.cycles.blender import framing
from unips_jax.cycles.environments import draw_environment, mean_radiance


@pytest.mark.parametrize("kind", lighting.LIGHTINGS)
def test_lights_are_where_they_should_be(kind):
    rng = np.random.default_rng(1)
    lights = [lighting.draw_light(rng, kind, "x.hdr", 2.0) for _ in range(200)]
    for light in lights:
        assert bool(light["environment"]) == (kind in ("environment", "mixed"))
        assert bool(light["lamps"]) == (kind != "environment")
    if kind == "environment":
        assert lights[0]["environment"]["strength"] == 0.5
    else:
        key = "position" if kind == "near" else "direction"
        places = np.array([light["lamps"][0][key] for light in lights])
        distance = np.linalg.norm(places, axis=1)
        assert np.all(places[:, 2] / distance > np.cos(np.deg2rad(75.01)))
        if kind != "near":
            np.testing.assert_allclose(distance, 1)


def test_gain_puts_the_bright_pixels_below_one():
    mask = np.ones((40, 40), bool)
    radiance = np.linspace(0, 7, 1600).reshape(40, 40, 1) * [1, 0.5, 0.2]
    gain = lighting.automatic_gain(radiance, mask)
    assert np.percentile(radiance[..., 0] * gain, 99.5) == pytest.approx(0.9)
    assert lighting.automatic_gain(0 * radiance, mask) == 1


def test_environments_are_finite_and_differ():
    drawn = [draw_environment(np.random.default_rng(i)) for i in range(8)]
    for picture in drawn:
        assert picture.shape == (256, 512, 3) and picture.dtype == np.float32
        assert np.isfinite(picture).all() and picture.min() >= 0
        # The seam is no step: it differs no more than columns usually do.
        across = np.abs(np.diff(picture, axis=1)).mean()
        assert np.abs(picture[:, 0] - picture[:, -1]).mean() < 20 * across
    assert len({picture.tobytes() for picture in drawn}) == 8
    assert mean_radiance(np.full((16, 32, 3), 0.5)) == pytest.approx(0.5)


@pytest.mark.parametrize("facing", [True, False])
def test_rotations_are_quaternions(facing):
    rng = np.random.default_rng(0)
    turns = np.array([run._rotation(rng, facing=facing) for _ in range(300)])
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-9)
    w, x, y, z = turns.T
    towards = 1 - 2 * (x * x + y * y)  # where the z axis goes
    if facing:
        assert towards.min() >= np.cos(np.deg2rad(35)) - 1e-9
    else:
        assert towards.min() < -0.5


def test_elongated_objects_reach_the_frame_too():
    corners = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T * [1, 1, 6]
    corners = corners / np.linalg.norm(corners, axis=1).max()
    rng = np.random.default_rng(0)
    for index in range(200):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        focal_mm = None if index % 10 == 0 else rng.uniform(35, 60)
        points = corners @ turn
        scale, offset, fits = framing.fit(points, focal_mm)
        x, y, z = (scale * points + offset).T
        ratio = 1.0
        if focal_mm:
            ratio = 2 * focal_mm / 36 / (framing.camera_distance(focal_mm) - z)
            assert ratio.min() > 0
        sides = [[(ratio * v).min(), (ratio * v).max()] for v in (x, y)]
        assert fits and np.abs(sides).max() == pytest.approx(1, abs=0.01)
        np.testing.assert_allclose(np.sum(sides, 1), 0, atol=0.02)
    assert not framing.fit(corners * [1, 1, 4], 35.0)[2]  # a needle in the eye


def test_pixels_of_the_outline_are_the_objects_alone():
    alpha = np.float32([[1, 0.25, 5e-4, 0.5]])
    colors = zip("RGB", (0.8, 0.4, 0.2), strict=True)
    channels = {name: alpha * value for name, value in colors} | {"A": alpha}
    mask = np.array([[True, True, True, False]])
    image = run.read_photograph(channels, mask)
    np.testing.assert_allclose(image[0, :2], [[0.8, 0.4, 0.2]] * 2, rtol=1e-6)
    assert not image[0, 2:].any()
