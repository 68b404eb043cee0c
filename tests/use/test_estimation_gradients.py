"""Gradients of the pure function: right, finite, bounded in memory."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_objects import ellipse_photographs
from small_networks import (
    SHALLOW,
    SHALLOW_OURS,
    SMALL,
    SMALL_OURS,
    lively_network,
    with_dtype,
)

from unips_jax import estimate_normals
from unips_jax.models import chunks
from unips_jax.models.config import SelfCalibratingConfig
from unips_jax.models.ops import normalize


@pytest.fixture(scope="module")
def network():
    return lively_network(SHALLOW)


class OneView(SelfCalibratingConfig):
    """Our network without the mirrored images."""

    mirror = False


def test_mirror_averages_with_the_mirrored_images():
    """And so does its gradient; mirrored images give the mirrored normals."""
    images, mask = ellipse_photographs()
    config, network = SHALLOW_OURS, lively_network(SHALLOW_OURS)
    sizes = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    del sizes["network"]
    one_view = dataclasses.replace(network, config=OneView(**sizes))
    target = jax.random.normal(jax.random.key(0), (*mask.shape, 3))

    def mirrored(normals):
        return normals[:, ::-1] * jnp.array([-1, 1, 1])

    plain = estimate_normals(one_view, images, mask)
    other = estimate_normals(one_view, images[:, :, ::-1], mask[:, ::-1])
    expected = normalize(plain + mirrored(other))
    assert abs(plain - expected).max() > 0.01

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def run(images, mask):
        normals = estimate_normals(network, images, mask)
        return jnp.sum(normals * target), normals

    (_, normals), slope = run(images, mask)
    np.testing.assert_allclose(normals, expected, atol=1e-5)
    (_, swapped), _ = run(images[:, :, ::-1], mask[:, ::-1])
    np.testing.assert_allclose(mirrored(swapped), expected, atol=1e-5)
    size = jnp.linalg.norm(slope)
    step = 0.01 * slope / size
    rise = run(images + step, mask)[0][0] - run(images - step, mask)[0][0]
    assert rise / 0.02 == pytest.approx(float(size), rel=0.02)


def test_gradients_agree_with_finite_differences(network):
    """In float64, along random directions, for images and for parameters."""
    with jax.enable_x64(True):
        network = jax.tree.map(
            lambda x: np.asarray(x, np.float64),
            dataclasses.replace(network, config=with_dtype(network.config, "float64")),
        )
        images, mask = ellipse_photographs()
        images = np.asarray(images, np.float64)
        target = jnp.array([0.3, -0.5, 0.8])

        def loss(network, images):
            normals = estimate_normals(network, images, mask)
            return jnp.sum(normals * target)

        generator = np.random.default_rng(0)
        gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(network, images)
        loss = jax.jit(loss)
        for argument in (0, 1):
            point = (network, images)[argument]
            direction = jax.tree.map(
                lambda x: generator.standard_normal(x.shape), point
            )
            products = jax.tree.map(np.vdot, gradients[argument], direction)
            exact = sum(jax.tree.leaves(products))

            def shifted(step, argument=argument, point=point, direction=direction):
                moved = jax.tree.map(lambda x, d: x + step * d, point, direction)
                return loss(*((moved, images), (network, moved))[argument])

            numeric = (shifted(1e-6) - shifted(-1e-6)) / 2e-6
            np.testing.assert_allclose(exact, numeric, rtol=1e-5)


def test_gradients_are_finite_where_images_are_black(network):
    images, mask = ellipse_photographs()
    images[1] = 0

    def loss(images):
        normals = estimate_normals(network, images, mask)
        return jnp.sum(normals**2 * jnp.array([1.0, 2.0, 3.0]))

    assert np.isfinite(jax.grad(loss)(jnp.asarray(images))).all()


def equations(jaxpr, inside_loop=False):
    """Yields a jaxpr's equations at any depth, and whether each is in a loop."""
    for equation in jaxpr.eqns:
        yield equation, inside_loop
        looped = inside_loop or equation.primitive.name in ("scan", "while")
        for value in jax.tree.leaves(
            equation.params, is_leaf=lambda value: hasattr(value, "eqns")
        ):
            if hasattr(value, "eqns"):
                yield from equations(value, looped)


@pytest.mark.parametrize("config", [SMALL, SMALL_OURS], ids=["paper", "ours"])
def test_loops_never_hold_whole_images(config):
    """Nor does their backward pass: else its cost grows with the pixels squared."""
    images, network = jnp.zeros((3, 90, 120, 3)), lively_network(config)

    def loss(images):
        return jnp.sum(estimate_normals(network, images)[..., 2])

    gradient = jax.make_jaxpr(jax.grad(loss))(images)
    sizes = [
        variable.aval.size
        for equation, looped in equations(gradient)
        if looped
        for variable in (*equation.invars, *equation.outvars)
    ]
    whole = images.size
    assert chunks.CHUNK_TOKENS < max(sizes) < whole / 2


def test_no_valid_image_gives_no_normal(network):
    """And no gradient that is not a number."""
    images, mask = ellipse_photographs()

    @jax.jit
    def run(images, valid):
        def loss(images):
            normals = estimate_normals(network, images, mask, valid=valid)
            return jnp.sum(normals), normals

        return jax.grad(loss, has_aux=True)(images)

    gradient, normals = run(jnp.asarray(images), jnp.zeros(3, bool))
    assert not np.any(gradient) and not np.any(normals)
    nothing = jnp.full(images.shape, jnp.nan)
    gradient, normals = run(nothing, jnp.zeros(3, bool))
    assert not np.any(gradient) and not np.any(normals)
    _, normals = run(jnp.asarray(images), jnp.array([True, False, False]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), mask, atol=1e-5)


@pytest.mark.parametrize(
    "config",
    [
        dataclasses.replace(SMALL, aggregation="max", communication="post"),
        dataclasses.replace(SMALL, attention="released", context_sampling="corner"),
        dataclasses.replace(SMALL_OURS, canonical_size=128),  # sampled by gathers
    ],
    ids=["paper", "released", "ours"],
)
def test_strict_promotion_is_enough(config):
    """Of types and of ranks, forward and backward."""
    shapes = jax.eval_shape(lambda: lively_network(config))
    images = jax.ShapeDtypeStruct((3, 9, 7, 3), jnp.float32)
    mask, valid = (jax.ShapeDtypeStruct(shape, bool) for shape in ((9, 7), (3,)))

    def loss(network, images, mask, valid):
        lights = images[:, 0, 0] if network.config.guesses else None
        normals = estimate_normals(
            network, images, mask, valid=valid, lights=lights, uniform_contexts=True
        )
        return jnp.sum(normals)

    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        jax.eval_shape(jax.grad(loss, (0, 1)), shapes, images, mask, valid)


def test_a_gradient_with_respect_to_a_network_is_one(network):
    images, mask = ellipse_photographs()
    gradient = jax.grad(lambda net: estimate_normals(net, images, mask)[..., 0].sum())
    found = gradient(network)
    assert found.config == network.config
    assert jax.tree.structure(found) == jax.tree.structure(network)
    assert np.isfinite(
        np.concatenate([x.ravel() for x in jax.tree.leaves(found)])
    ).all()
