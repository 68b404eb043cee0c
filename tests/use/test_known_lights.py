"""Lights that are known: unknown ones change nothing, and both paths agree."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import SHALLOW, SHALLOW_OURS, lively_network, lively_weights

from unips_jax.estimation.pure import estimate_normals
from unips_jax.estimation.streaming import estimate_photographs, estimate_with_lights
from unips_jax.models.known_lights import moved_to_known
from unips_jax.models.network import UniversalNetwork

KNOWING = dataclasses.replace(SHALLOW_OURS, known_lights=True)


@functools.cache
def network():
    return lively_network(KNOWING)


@pytest.fixture(scope="module")
def photographs():
    rng = np.random.default_rng(0)
    images = rng.uniform(0.1, 1, (3, 20, 24, 3)).astype(np.float32)
    mask = np.zeros((20, 24), bool)
    mask[2:18, 3:21] = rng.random((16, 18)) > 0.1
    lights = rng.normal(size=(3, 3)).astype(np.float32)
    return images, mask, lights / np.linalg.norm(lights, axis=-1, keepdims=True)


def test_what_is_not_known_changes_nothing(photographs):
    images, mask, lights = photographs
    params = lively_weights(KNOWING)
    old = {name: dict(part) for name, part in params.items()}
    old["encoder"]["consensus"] = {
        name: part
        for name, part in params["encoder"]["consensus"].items()
        if name != "given"
    }
    before = estimate_normals(UniversalNetwork(SHALLOW_OURS, old), images, mask)
    for unknown in (None, np.zeros((3, 3))):
        after = estimate_normals(network(), images, mask, lights=unknown)
        np.testing.assert_allclose(after, before, atol=2e-6)
    known = estimate_normals(network(), images, mask, lights=lights)
    roughly = estimate_normals(network(), images, mask, lights=0.9 * lights)
    assert abs(known - before).max() > 1e-2
    assert abs(known - roughly).max() > 1e-3


def test_photographs_give_what_arrays_give(photographs):
    images, mask, lights = photographs
    expected = estimate_normals(network(), images, mask, lights=lights)
    found = estimate_photographs(network(), images, mask, lights=lights)
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_what_is_mirrored_gives_mirrored_normals(photographs):
    images, mask, lights = photographs
    normals = estimate_normals(network(), images, mask, lights=lights)
    mirror = np.array([-1, 1, 1], np.float32)
    turned = estimate_normals(
        network(), images[:, :, ::-1], mask[:, ::-1], lights=lights * mirror
    )
    np.testing.assert_allclose(turned[:, ::-1] * mirror, normals, atol=2e-5)


def test_lights_of_images_that_do_not_count_have_no_say(photographs):
    images, mask, lights = photographs
    valid, unread = np.array([True, False, True]), lights.copy()
    unread[1] = np.nan  # as of memory that nobody wrote
    found, expected = (
        estimate_normals(network(), images, mask, valid=valid, lights=given)
        for given in (unread, np.where(valid[:, None], lights, 0))
    )
    np.testing.assert_array_equal(found, expected)


def test_networks_of_half_precision_take_lights_too(photographs):
    images, mask, lights = photographs
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), network())
    normals = estimate_normals(half, images, mask, lights=lights)
    assert np.isfinite(normals).all()


def test_gradients_by_lights_are_finite(photographs):
    images, mask, lights = photographs
    lights = jnp.asarray(lights).at[1].set(0)

    def tilt(lights):
        return estimate_normals(network(), images, mask, lights=lights)[..., 0].sum()

    gradient = jax.grad(tilt)(lights)
    assert np.isfinite(gradient).all() and (gradient[0] != 0).any()


def test_lights_that_do_not_fit_are_refused(photographs):
    images, mask, lights = photographs
    for estimate in (estimate_normals, estimate_photographs):
        for wrong in (lights[:2], np.concatenate([lights, lights]), lights[:, :2]):
            with pytest.raises(ValueError, match=r"expected \[N, 3\] = \(3, 3\), one"):
                estimate(network(), images, mask, lights=wrong)
        with pytest.raises(ValueError, match="a network that guesses lights, as the"):
            estimate(lively_network(SHALLOW), images, mask, lights=lights)
    with pytest.raises(ValueError, match="0 for what is not known"):
        estimate_photographs(network(), images, mask, lights=lights * np.nan)


def test_photographs_of_signed_integers_have_no_scale(photographs):
    images, mask, _ = photographs
    with pytest.raises(ValueError, match="uint8, uint16 or floats, got int32"):
        estimate_photographs(network(), (255 * images).astype(np.int32), mask)


def test_a_guess_moves_as_far_as_the_error_does_not_explain():
    lights = jnp.array([[0, 0, 1], [0, 0.6, 0.8], [0, 0, 1], [0, 0, 0.9], [0, 0, 0]])
    guess = jnp.array(
        [[0, 0.6, 0.8], [0, 0.6, 0.8], [0, 0.3, 0.4], [1, 0, 0], [1, 0, 0]]
    )
    moved = guess + moved_to_known(guess[None], lights[None])[0]
    np.testing.assert_allclose(moved[0], lights[0], atol=2e-3)
    for row in (1, 2, 4):  # the same, of mixed light, and unknown
        np.testing.assert_allclose(moved[row], guess[row], atol=1e-6)
    left = np.linalg.norm(np.array([0, 0, 1]) - moved[3])
    np.testing.assert_allclose(left, 2 * np.sin(np.arccos(0.9) / 2), atol=1e-4)


def test_guesses_of_any_of_our_networks_move_to_exact_lights(photographs):
    images, mask, lights = photographs
    plain = lively_network(SHALLOW_OURS)
    guesses = estimate_with_lights(plain, images, mask).lights
    assert (np.linalg.norm(guesses, axis=-1) > 1).all()
    turned = estimate_with_lights(plain, images[:, :, ::-1], mask[:, ::-1]).lights
    np.testing.assert_allclose(turned * [-1, 1, 1], guesses, atol=2e-5)
    moved = estimate_with_lights(plain, images, mask, lights=lights).lights
    moved = moved / np.linalg.norm(moved, axis=-1, keepdims=True)
    np.testing.assert_allclose(moved, lights, atol=5e-3)
