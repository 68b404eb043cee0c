"""The light that scenes and folders know of, against closed forms."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_objects import constant_environment, look, make_shape, matt

from unips_jax.lighting.harmonics import BAND, COSINE_LOBE, harmonics
from unips_jax.scenes import SceneConfig, folder_light
from unips_jax.scenes import render as scenes_render
from unips_jax.scenes.backdrop import Backdrop, draw_backdrop
from unips_jax.scenes.config import LIGHT_KINDS
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.incident import incident_light
from unips_jax.scenes.lamps import KeyLights, draw_lights
from unips_jax.scenes.shading import light_means

GAIN = np.float32([[0.5, 1, 2]])


def light_of(
    vector=(0, 0, 1), near=0, color=0.0, around=0.0, window=None, backdrop=None
):
    keys = KeyLights(
        vector=jnp.asarray([vector], jnp.float32),
        near=jnp.asarray([near], jnp.float32),
        radius=jnp.zeros(1),
        color=jnp.full((1, 3), color, jnp.float32),
    )
    environment = constant_environment(around)._replace(**window or {})
    found = incident_light(keys, environment, jnp.asarray(GAIN), backdrop)
    assert found.harmonics_known.all() and found.lamp_known.all()
    return jax.tree.map(lambda x: np.asarray(x)[0], found)


def test_one_distant_lamp():
    way = np.array([0.6, 0, 0.8])
    light = light_of(way, color=3.0)
    expected = 3 * harmonics(way)[:, None] * GAIN[0]
    np.testing.assert_allclose(light.harmonics, expected, atol=1e-6)
    np.testing.assert_allclose(light.lamp_direction, way, atol=1e-6)
    assert (light.lamp_share, light.lamp_nearness) == (1, 0)


def test_a_near_lamp_falls_off():
    light = light_of((0, 1.2, 1.6), near=1, color=3.0)
    far = light_of((0, 0.6, 0.8), color=3.0)
    np.testing.assert_allclose(light.harmonics, far.harmonics / 4, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(light.lamp_direction, (0, 0.6, 0.8), atol=1e-6)
    assert (light.lamp_share, light.lamp_nearness) == pytest.approx((1, 0.5))


def test_uniform_surroundings_have_no_direction():
    light = light_of(around=2.0)
    first = 2 * np.sqrt(4 * np.pi) * GAIN[0]
    np.testing.assert_allclose(light.harmonics[0], first, rtol=1e-5)
    np.testing.assert_allclose(light.harmonics[1:], 0, atol=2e-3)
    assert not light.lamp_direction.any() and light.lamp_share == 0
    half = light_of(color=4 * np.pi, around=1.0)
    assert half.lamp_share == pytest.approx(0.5)
    assert light_of((0, 0, 2), 1, 16 * np.pi, 1.0).lamp_share == pytest.approx(0.5)


def test_a_window_of_the_surroundings():
    way = np.array([0.48, 0.6, 0.64])
    right = np.cross([0, 1, 0], way)
    right /= np.linalg.norm(right)
    axes = jnp.tile(jnp.stack([right, np.cross(way, right), way]), (6, 1, 1))
    half, color = jnp.full((6, 2), 0.06), np.zeros((6, 3), np.float32)
    color[0] = 1 / (4 * 0.06**2)  # irradiance 1, but for the window's bend
    light = light_of(window={"axes": axes, "half": half, "color": jnp.asarray(color)})
    expected = harmonics(way)[:, None] * GAIN[0]
    np.testing.assert_allclose(light.harmonics, expected, atol=0.04)


def test_a_wall_hides_what_is_behind_it():
    wall = Backdrop(
        present=jnp.bool_(True),
        normals=jnp.asarray([[0.0, 0, 1], [0, 0, 1]]),
        offsets=jnp.asarray([1.0, 1e4]),
        waves=jnp.ones((2, 3)),
        slopes=jnp.zeros(2),
    )
    light = light_of(around=1.0, backdrop=wall).harmonics[:, 1]
    integral = np.array([2 * np.pi, 0, np.pi])  # of 1, y and z before the wall
    np.testing.assert_allclose(
        light[:3], integral * [0.2821, 0.4886, 0.4886], atol=0.05
    )


@pytest.mark.parametrize("wall", [False, True])
def test_mean_directions_are_those_of_the_harmonics(wall):
    """So that what is learnt of one light does not contradict the other."""

    @jax.jit
    @jax.vmap
    def both(key):
        first, second = jax.random.split(key)
        backdrop = draw_backdrop(Draws(first, 32), 1.0, jnp.asarray(wall))
        kind = jnp.int32(LIGHT_KINDS.index("environment"))
        keys, around = draw_lights(Draws(second, 160 + 24 * 2), kind, 2)
        seen = types.SimpleNamespace(backdrop=backdrop)
        light = incident_light(keys, around, jnp.ones((2, 3)), backdrop)
        return light_means(seen, keys, around), light.harmonics.mean(-1)

    means, light = map(np.asarray, both(jax.random.split(jax.random.key(0), 16)))
    expected = light[..., [3, 1, 2]] / 0.4886 / (light[..., :1] / 0.2821)
    # With what the wall hides: 0.33.
    assert np.linalg.norm(means - expected, axis=-1).mean() < 0.02


def test_harmonics_are_in_the_units_of_the_images(monkeypatch):
    sphere = look(make_shape(balls=[((0, 0, 0), 0.9)]))
    monkeypatch.setattr(scenes_render, "draw_surface", lambda *_: matt(sphere))
    config = SceneConfig(sensor=False, interreflection=False)
    render = functools.partial(
        scenes_render.shade, num_images=3, config=config, incident=True
    )
    compiled = jax.jit(lambda kind: render(jax.random.key(3), sphere, light_kind=kind))
    for kind, limit in ((1, 0.06), (2, 0.12), (4, np.inf)):
        scene = jax.tree.map(np.asarray, compiled(kind))
        light = scene.incident
        share = COSINE_LOBE[BAND, None]
        lit = harmonics(scene.normals) @ (share * light.harmonics)[:, None]
        expected = (0.6 / np.pi * lit)[:, scene.mask]
        off = scene.images[:, scene.mask] - expected
        assert np.abs(off).mean() < limit * expected.mean()
        unlit = np.all(light.lamp_direction == 0, -1)
        assert np.array_equal(unlit, light.lamp_share == 0)
        assert np.array_equal(light.lamp_nearness > 0, [kind == 4] * 3)


def test_incident_light_is_left_out_unless_asked_for():
    sphere = jax.eval_shape(lambda: look(make_shape(balls=[((0, 0, 0), 0.9)])))
    shade = functools.partial(scenes_render.shade, num_images=2)
    plain, asked = (
        jax.eval_shape(
            functools.partial(shade, incident=incident), jax.random.key(0), sphere
        )
        for incident in (False, True)
    )
    assert plain.incident is None and plain == asked._replace(incident=None)
    assert asked.incident.harmonics.shape == (2, 9, 3)


def test_folders_say_what_they_know():
    nothing = folder_light({"light": "environment"}, 2)
    assert not nothing.lamp_known.any() and not nothing.harmonics_known.any()
    assert nothing.harmonics.shape == (2, 9, 3)
    facts = {
        "light_directions": [[0, 0, 1], [0.6, 0, 0.8]],
        "light_intensities": [[1, 1, 1], [2, 2, 4]],
    }
    lamps = folder_light(facts, 2)
    # A Lambertian surface appears as albedo x intensity where it faces the lamp.
    expected = np.pi * harmonics(np.array([0.6, 0, 0.8]))[:, None] * [2, 2, 4]
    np.testing.assert_allclose(lamps.harmonics[1], expected, rtol=1e-5)
    assert lamps.lamp_share.tolist() == [1, 1] and lamps.lamp_known.all()
    with pytest.raises(ValueError, match="expected 3, one per photograph, got 2"):
        folder_light(facts, 3)


def test_folders_of_cycles_know_their_lamps():
    sun = {"kind": "sun", "direction": [0, 0, 1], "irradiance": [4 * np.pi] * 3}
    lamp = {"kind": "area", "position": [0, 2, 0], "power": [np.pi**2 * 4] * 3}
    around = {"file": "a.hdr", "rotation": [0, 0, 0], "strength": 1}
    drawn = [
        {"lamps": [sun], "environment": around},
        {"lamps": [], "environment": around},
        {"lamps": [lamp], "environment": None},
    ]
    light = folder_light({"lights": drawn, "gains": [0.5, 1, 2]}, 3)
    np.testing.assert_allclose(light.lamp_share, [0.5, 0, 1])
    np.testing.assert_allclose(light.lamp_nearness, [0, 0, 0.5])
    np.testing.assert_allclose(light.lamp_direction, [[0, 0, 1], [0] * 3, [0, 1, 0]])
    assert light.harmonics_known.tolist() == [False, False, True]
    assert light.lamp_known.all() and not light.harmonics[:2].any()
    expected = 2 * np.pi * harmonics(np.array([0, 1.0, 0]))
    np.testing.assert_allclose(light.harmonics[2, :, 0], expected, rtol=1e-5)
