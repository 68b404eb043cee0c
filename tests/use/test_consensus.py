"""What the images of a set agree on: begins as nothing, guesses what it is taught."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from small_networks import SHALLOW_OURS as CONFIG
from small_networks import lively, lively_network, lively_weights

from unips_jax.models.encoding import Guesses
from unips_jax.models.light_tokens import LightTokens
from unips_jax.models.network import EncoderDecoder, init_params
from unips_jax.training import loss as losses
from unips_jax.training.config import Config, DataConfig, TrainConfig
from unips_jax.training.step import batch_loss


def agreement(params):
    @jax.jit
    def run(contexts, params):
        return (
            EncoderDecoder(CONFIG).bind({"params": params}).encoder.consensus(contexts)
        )

    return functools.partial(run, params=params)


def contexts(sets=2, images=3):
    return jax.random.normal(jax.random.key(0), (sets, images, 4, 4, 8))


def test_begins_as_the_identity_and_changes_the_contexts():
    # Compiled for this part alone: all of it, uncompiled, takes a minute.
    part = jax.jit(lambda key: init_params(CONFIG, key)["encoder"]["consensus"])
    begun, _ = agreement({"encoder": {"consensus": part(jax.random.key(0))}})(
        contexts()
    )
    np.testing.assert_array_equal(begun, contexts())
    changed, _ = agreement(lively_weights(CONFIG))(contexts())
    assert abs(changed - contexts()).max(axis=-1).min() > 1e-3


def test_every_image_has_its_light_and_all_have_one_shape():
    agree = agreement(lively_weights(CONFIG))
    _, guesses = agree(contexts())
    order = jnp.array([2, 0, 1])
    _, permuted = agree(contexts()[:, order])
    np.testing.assert_allclose(permuted.normals, guesses.normals, atol=1e-5)
    np.testing.assert_allclose(permuted.lights, guesses.lights[:, order], atol=1e-5)
    lights = np.asarray(guesses.lights).reshape(6, 3)
    assert (
        np.linalg.norm(lights[:, None] - lights, axis=-1)[~np.eye(6, dtype=bool)].min()
        > 0
    )
    # Every cell hears of every other, and of every image.
    moved, _ = agree(contexts().at[0, 0, 0, 0].add(1))
    assert abs(moved - agree(contexts())[0])[0].max(axis=-1).min() > 0
    np.testing.assert_array_equal(moved[1], agree(contexts())[0][1])


def test_padding_has_no_say_in_light_tokens():
    keys = jax.random.split(jax.random.key(0))
    cells = jax.random.normal(keys[0], (1, 3, 4, 32))
    light = jax.random.normal(keys[1], (1, 3, 32))
    tokens = LightTokens(32)
    params = lively(lambda key: tokens.init(key, cells, light, None))
    run, some = jax.jit(tokens.apply), np.array([0, 2])
    found, kinds = run(params, cells, light, jnp.array([True, False, True]))
    expected, own = run(params, cells[:, some], light[:, some], None)
    np.testing.assert_allclose(found[:, some], expected, atol=1e-5)
    np.testing.assert_allclose(kinds.near[:, some], own.near, atol=1e-5)


def scene():
    rng = np.random.default_rng(0)
    images = rng.random((2, 3, 16, 16, 3)).astype(np.float32)
    mask = np.zeros((2, 16, 16), bool)
    mask[:, 2:12, 3:13] = True
    normals = mask[..., None] * np.array([0.6, 0, 0.8], np.float32)
    lights = rng.normal(size=(2, 3, 3)).astype(np.float32)
    return images, mask, normals, lights


def test_losses_of_guesses_are_their_distances():
    _, mask, normals, lights = scene()
    flat = np.broadcast_to(normals[0, 5, 5], (2, 4, 4, 3))

    def score(guesses, mask, normals, lights):
        objects = losses.Objects(None, mask, normals, lights)
        return losses._guess_losses(guesses, objects, "mask")

    right = score(Guesses(5 * flat, lights), mask, normals, lights)
    assert max(right.values()) < 1e-3
    wrong = score(Guesses(-flat, lights + (0, 0.5, 0)), mask, normals, lights)
    np.testing.assert_allclose([wrong["coarse"], wrong["lights"]], [2, 0.5], atol=0.04)
    assert list(score(Guesses(flat, lights), mask, normals, None)) == ["coarse"]
    # The last cell's corner is inside the mask, not what its normal is made of.
    cut = mask.copy()
    cut[:, 10:12, 11:13] = False
    right = score(Guesses(flat, lights), cut, normals * cut[..., None], None)
    assert right["coarse"] < 1e-3


def test_guesses_weigh_what_the_configuration_says():
    names = "images", "mask", "normals", "lights"
    batch = dict(zip(names, map(jnp.asarray, scene()), strict=True))
    data = DataConfig(source="scenes", image_size=16, num_pixels=20, augment=False)

    def loss(coarse, lights):
        train = TrainConfig(coarse_guess_weight=coarse, lights_guess_weight=lights)
        config = Config(model=CONFIG, data=data, train=train)
        run = jax.jit(functools.partial(batch_loss, config=config))
        keys = jax.random.split(jax.random.key(0), (2, len(batch["mask"])))
        return run(lively_weights(CONFIG), batch, *keys)

    alone, metrics = loss(0, 0)
    both = float(alone + 0.2 * metrics["coarse"] + 0.1 * metrics["lights"])
    assert float(loss(0.2, 0.1)[0]) == pytest.approx(both, rel=1e-5)
    assert min(metrics["coarse"], metrics["lights"]) > 0.1


def test_training_teaches_every_parameter():
    images, mask, normals, lights = scene()

    @jax.jit
    @jax.value_and_grad
    def loss(network, lights):
        keys = jax.random.split(jax.random.key(0), 2)
        objects = losses.Objects(images, mask, normals, lights)
        options = losses.LossOptions(num_pixels=20)
        return losses.training_loss(network, objects, keys, options)[0]

    network = lively_network(CONFIG)
    value, gradient = loss(network, lights)
    for name, leaf in flatten_dict(
        gradient.params["encoder"]["consensus"], sep="/"
    ).items():
        if not name.endswith("key/bias"):  # drops out of the softmax
            assert np.abs(leaf).max() > 0, name
    unknown, gradient = loss(network, None)
    assert unknown < value
    assert not np.any(gradient.params["encoder"]["consensus"]["lights"]["kernel"])
