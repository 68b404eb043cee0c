"""Losses that look at neighbours and at kinds of light."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import SHALLOW, SHALLOW_OURS, lively_network, lively_weights

from unips_jax.models.light_tokens import LightGuess
from unips_jax.models.network import UniversalNetwork
from unips_jax.scenes.incident import IncidentLight
from unips_jax.training import loss as losses
from unips_jax.training.config import Config, DataConfig, TrainConfig
from unips_jax.training.light_loss import light_losses
from unips_jax.training.loss import LossOptions, Objects, training_loss
from unips_jax.training.pixels import draw_blocks, neighbour_distances, steepness


def test_blocks_are_neighbours_on_the_mask():
    mask = np.random.default_rng(0).random((10, 14)) > 0.6
    index, inside = draw_blocks(jnp.asarray(mask), 61, jax.random.key(0))
    assert index.shape == (60,)
    blocks = np.asarray(index).reshape(-1, 4)
    np.testing.assert_array_equal(blocks - blocks[:, :1], [[0, 1, 14, 15]] * 15)
    np.testing.assert_array_equal(inside, mask.reshape(-1)[index])
    assert np.asarray(inside).reshape(-1, 4).any(axis=1).all()
    assert len(set(np.asarray(index))) == 60


def test_steepness_and_differences_by_hand():
    flat, step = np.zeros((4, 3), np.float32), np.zeros((4, 3), np.float32)
    step[[1, 3], 0] = 0.5  # the right column differs: two of four pairs
    normals = jnp.asarray(np.concatenate([flat, step]))
    inside = jnp.ones(8, bool)
    np.testing.assert_allclose(
        steepness(normals, inside), [0] * 4 + [0.25] * 4, atol=1e-6
    )
    one_outside = inside.at[7].set(False)  # leaves one steep pair of two
    np.testing.assert_allclose(steepness(normals, one_outside)[4:], 0.25, atol=1e-6)
    weights = jnp.where(one_outside, 0.1, 0.0)
    squared, pairs = neighbour_distances(jnp.zeros((8, 3)), normals, weights)
    np.testing.assert_allclose(squared, [[0] * 4, [0.25, 0.25, 0, 0]])
    np.testing.assert_allclose(pairs, [[0.1] * 4, [0.1, 0, 0.1, 0]])


def objects():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(2, 16, 16, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return Objects(
        jnp.asarray(rng.random((2, 3, 16, 16, 3)), jnp.float32),
        jnp.asarray(rng.random((2, 16, 16)) > 0.3),
        jnp.asarray(normals, jnp.float32),
    )


BLOCKS = LossOptions(num_pixels=400, grid_loss=False, pixel_blocks=True)


def test_whole_objects_have_the_same_error_in_blocks(monkeypatch):
    """All pixels drawn: blocks change their order, and pieces change nothing."""
    network = UniversalNetwork(SHALLOW_OURS, lively_weights(SHALLOW_OURS))
    keys = jax.random.split(jax.random.key(1), 2)

    def run(options):
        loss = jax.jit(training_loss, static_argnames="options")
        value, metrics = loss(network, objects(), keys, options=options)
        return float(value), float(metrics["mae_deg"])

    plain = run(dataclasses.replace(BLOCKS, pixel_blocks=False))
    whole = run(BLOCKS)
    np.testing.assert_allclose(whole, plain, rtol=1e-5)
    both = dataclasses.replace(BLOCKS, steepness_weight=1.0, differences_weight=0.1)
    weighed = run(both)
    assert weighed[1] == pytest.approx(plain[1], rel=1e-5)
    assert 1.05 * plain[0] < weighed[0] < 1.5 * plain[0]
    monkeypatch.setattr(losses, "CHUNK_TOKENS", 60)  # blocks by twos
    np.testing.assert_allclose(run(both), weighed, rtol=1e-5)


def test_steep_pixels_count_more_in_the_loss_alone():
    images, mask, normals, *_ = (x[0] for x in objects()[:3])
    options = dataclasses.replace(BLOCKS, steepness_weight=2.0)
    prepare = functools.partial(losses._prepare, config=SHALLOW_OURS, options=options)
    found = jax.jit(prepare)(images, mask, normals, jax.random.key(0))
    inside = found.weights > 0
    steep = np.exp(2 * steepness(found.true, inside))[inside]
    assert np.ptp(steep) > 0.5
    np.testing.assert_allclose(found.counted[inside], steep / steep.sum(), rtol=1e-5)
    np.testing.assert_allclose(found.weights[inside], 1 / inside.sum(), rtol=1e-5)


def lamp(**fields):
    """A distant lamp from the right that is half of the light, in one image."""
    harmonics = np.zeros((1, 1, 9, 3), np.float32)
    harmonics[..., 0, :] = [2.0, 4.0, 6.0]
    known = jnp.ones((1, 1), bool)
    light = IncidentLight(
        jnp.asarray(harmonics),
        jnp.asarray([[[1.0, 0.0, 0.0]]]),
        jnp.full((1, 1), 0.5),
        jnp.zeros((1, 1)),
        known,
        known,
    )
    return light._replace(**fields)


def right_guess():
    guess = jnp.zeros((1, 1, 9, 3)).at[..., 0, :].set(jnp.array([0.5, 1.0, 1.5]))
    far, off = jnp.asarray([[[3.0, 0.0, 0.0]]]), jnp.full((1, 1), -50.0)
    return LightGuess(guess, 0 * far, jnp.zeros((1, 1)), off, far, jnp.zeros((1, 1)))


def test_right_guesses_cost_nothing():
    losses_of = jax.jit(light_losses)
    for value in losses_of(right_guess(), lamp()).values():
        assert float(value) == pytest.approx(0, abs=1e-6)
    # A distant lamp has no nearness, and darkness no harmonics to guess.
    anywhere = right_guess()._replace(nearness=jnp.ones((1, 1)))
    assert losses_of(anywhere, lamp())["lamps"] == pytest.approx(0, abs=1e-6)
    dark = lamp(harmonics=jnp.zeros((1, 1, 9, 3)))
    assert losses_of(right_guess(), dark)["harmonics"] == 0
    near = lamp(lamp_nearness=jnp.full((1, 1), 0.4))
    assert losses_of(right_guess(), near)["lamps"] > 1
    unknown = jnp.zeros((1, 1), bool)
    wrong = right_guess()._replace(distant=-right_guess().distant)
    alone = losses_of(wrong, lamp())
    assert alone["lamps"] > 0.9
    assert losses_of(wrong, lamp(lamp_known=unknown))["lamps"] == 0
    twice, two = (
        jax.tree.map(lambda x: jnp.concatenate([x, x], 1), x) for x in (wrong, lamp())
    )
    one = jnp.array([[True, False]])
    two = two._replace(lamp_known=one, harmonics_known=one)
    for name, value in losses_of(twice, two).items():
        assert float(value) == pytest.approx(float(alone[name]))


def test_every_new_parameter_has_a_gradient():
    config = dataclasses.replace(
        SHALLOW_OURS, fine_dim=5, light_tokens=True, known_lights=True
    )
    rng = np.random.default_rng(1)
    shared = jnp.ones((2, 3), bool)
    light = IncidentLight(
        jnp.asarray(rng.random((2, 3, 9, 3)), jnp.float32),
        jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32),
        jnp.asarray(rng.random((2, 3)), jnp.float32),
        jnp.asarray([[0.0, 0.5, 0.0], [0.3, 0.0, 0.2]], jnp.float32),
        shared,
        shared,
    )
    known = objects()._replace(
        lights=light.lamp_direction,
        incident=light,
        known_lights=light.lamp_direction,
    )

    def loss(params, weight):
        network = UniversalNetwork(config, params)
        keys = jax.random.split(jax.random.key(1), 2)
        options = dataclasses.replace(
            BLOCKS, squared_loss=False, steepness_weight=1.0, differences_weight=0.1
        )
        options = dataclasses.replace(options, kinds_guess_weight=weight)
        return training_loss(network, known, keys, options)

    run = jax.jit(jax.grad(loss, (0, 1), has_aux=True))
    (gradient, by_weight), metrics = run(lively_weights(config), 0.1)
    assert {"coarse", "lights", "harmonics", "lamps"} <= metrics.keys()
    kinds = float(metrics["harmonics"] + metrics["lamps"])
    assert float(by_weight) == pytest.approx(kinds, rel=1e-5)
    flat, _ = jax.tree.flatten_with_path(gradient["encoder"])
    for path, value in flat:
        assert np.isfinite(value).all()
        name = jax.tree_util.keystr(path)
        if "key" not in name or "bias" not in name:  # softmax does not see it
            assert np.abs(value).max() > 0, name


def test_objects_that_do_not_fit_are_refused():
    keys = jax.random.split(jax.random.key(1), 2)
    odd = jax.tree.map(lambda x: x[..., 1:, 1:, :], objects()._replace(mask=None))
    odd = odd._replace(mask=objects().mask[..., 1:, 1:])
    with pytest.raises(ValueError, match="expected images with even sides, got"):
        training_loss(lively_network(SHALLOW_OURS), odd, keys, BLOCKS)
    known = objects()._replace(known_lights=jnp.ones((2, 3, 3)))
    with pytest.raises(ValueError, match="a network that guesses lights"):
        training_loss(lively_network(SHALLOW), known, keys, BLOCKS)


def test_settings_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="expected no grid_loss"):
        Config(model=dataclasses.replace(SHALLOW_OURS, fine_dim=5))
    with pytest.raises(ValueError, match="expected blocks of pixels"):
        Config(train=TrainConfig(steepness_weight=1.0))
    with pytest.raises(ValueError, match="pixel_blocks: expected no grid_loss"):
        DataConfig(pixel_blocks=True)
