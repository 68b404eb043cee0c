"""JAX's flags `jax_debug_nans` and `jax_enable_x64`, through whole methods."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_data import lights, shade, sphere
from small_networks import (
    SHALLOW,
    SHALLOW_OURS,
    SMALL,
    SMALL_OURS,
    lively_network,
)
from training_runs import CONFIG, batch

from unips_jax import estimate_normals, integrate_image
from unips_jax.baselines.method import Lights, Observed
from unips_jax.evaluation.methods import UnipsOptions, load_variants
from unips_jax.scenes.draws import Draws, seeded
from unips_jax.training.chunked_sum import chunked_sum
from unips_jax.training.state import init_state
from unips_jax.training.step import batch_gradient, train_step

NONE, NANS, X64 = {}, {"jax_debug_nans": True}, {"jax_enable_x64": True}


@pytest.fixture
def flags():
    """Sets flags, and puts them back."""
    before = {name: getattr(jax.config, name) for name in (*NANS, *X64)}

    def set_flags(given):
        for name, value in (before | given).items():
            jax.config.update(name, value)

    yield set_flags
    set_flags({})


def test_sums_in_pieces_keep_their_type(flags):
    def function(params, xs, constants):
        return jnp.sum(params * xs**2 * constants), xs

    def total(params):
        xs = jnp.arange(5, dtype=jnp.float32)
        return chunked_sum(function, params, xs, jnp.asarray(np.ones(5)), 2)[0]

    found = []
    for given in (NONE, X64):
        flags(given)
        value, slope = jax.value_and_grad(total)(jnp.float32(2))
        assert slope.dtype == jnp.float32
        found.append((float(value), float(slope)))
    assert found[0] == found[1] == (60.0, 30.0)


def test_holes_of_nan_are_no_mistake(flags):
    flags(NANS)
    normals = np.zeros((12, 12, 3), np.float32)
    normals[..., 2], normals[4, 5] = 1, np.nan
    depth = integrate_image(normals, max_rounds=0).depth
    assert np.isnan(depth[4, 5]) and np.isfinite(depth).sum() == 143


def test_scenes_of_a_seed_are_the_same_by_any_generator():
    expected = Draws(jax.random.fold_in(seeded(3), 1), 4).unit(4)
    before = jax.config.jax_default_prng_impl
    jax.config.update("jax_default_prng_impl", "rbg")
    try:
        found = Draws(jax.random.fold_in(seeded(3), 1), 4).unit(4)
    finally:
        jax.config.update("jax_default_prng_impl", before)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    "methods",
    [
        ["classical", "least-squares"],
        pytest.param(
            ["variational:iterations=2", "mpm:frame=integrability"],
            marks=pytest.mark.slow,  # compiles for seconds
        ),
    ],
)
def test_every_baseline_runs_with_wide_numbers(methods, flags):
    variants = load_variants(methods, UnipsOptions(()))
    mask, normals = sphere(24, 24)
    directions = lights(8)
    images = shade(normals, directions).astype(np.float32)
    known = Lights(directions, np.ones((8, 3)))
    for variant in variants:
        found = []
        for given in (NONE, X64):
            flags(given)
            estimate = variant.run(Observed(images, mask, known, np.inf))
            found.append(getattr(estimate, "normals", estimate))
        np.testing.assert_allclose(*found, atol=1e-5, err_msg=variant.label)


@pytest.mark.parametrize(
    ("model", "rule"),
    [(SHALLOW, "adamw"), (SHALLOW_OURS, "muon")],
    ids=["unips", "ours"],
)
def test_a_step_keeps_all_types(model, rule, flags):
    """Of parameters, gradients and the optimiser's state; nothing is compiled."""
    optim = dataclasses.replace(CONFIG.optim, name=rule)
    config = dataclasses.replace(CONFIG, model=model, optim=optim)
    flags(X64)
    state = jax.eval_shape(functools.partial(init_state, config), jax.random.key(0))
    run = functools.partial(_step_and_gradient, config=config)
    found = jax.eval_shape(run, state, batch(8, 3, 16), jax.random.key(1))
    after, metrics, gradient = found
    for tree in (state, after, metrics, gradient):
        kinds = {leaf.dtype for leaf in jax.tree.leaves(tree)}
        assert kinds <= {jnp.dtype("float32"), jnp.dtype("int32")}
    assert jax.tree.map(lambda x: x.dtype, state) == jax.tree.map(
        lambda x: x.dtype, after
    )


def _step_and_gradient(state, sets, key, config):
    _, gradient = batch_gradient(state.params, sets, key, config=config)
    return *train_step(state, sets, key, config=config), gradient


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "rule"), [(SMALL, "adamw"), (SMALL_OURS, "muon")], ids=["unips", "ours"]
)
def test_normals_gradients_and_a_step_are_the_same(config, rule, flags):
    scene = batch(1, 4, 16)
    images = np.array(scene["images"][0], np.float32)
    images, mask = images / images.max(), np.asarray(scene["mask"][0])
    optim = dataclasses.replace(CONFIG.optim, name=rule)
    recipe = dataclasses.replace(CONFIG, model=config, optim=optim)

    def total(x, network):
        return (estimate_normals(network, x, mask) * jnp.arange(3.0)).sum()

    found = []
    for given in (NONE, NANS, X64):
        flags(given)
        network = lively_network(config)
        normals = estimate_normals(network, images, mask)
        slopes = jax.grad(total)(jnp.asarray(images), network)
        sets = batch(8, 3, 16)
        run = functools.partial(train_step, config=recipe)
        state = jax.jit(functools.partial(init_state, recipe))(jax.random.key(0))
        state, metrics = jax.jit(run)(state, sets, jax.random.key(1))
        kinds = {leaf.dtype for leaf in jax.tree.leaves(state.params)}
        assert kinds == {jnp.dtype("float32")} and normals.dtype == jnp.float32
        loss = float(metrics["loss"])
        assert np.isfinite([loss, float(metrics["grad_norm"])]).all()
        found.append((normals, slopes, loss))
    for normals, slopes, loss in found[1:]:
        for value, expected in ((normals, found[0][0]), (slopes, found[0][1])):
            scale = np.abs(expected).max()
            np.testing.assert_allclose(value, expected, atol=2e-4 * scale)
        assert abs(loss - found[0][2]) < 1e-5
    assert found[1][2] == found[0][2]
