"""Finer contexts and light tokens: they begin as the identity, and act once trained."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import SHALLOW_OURS, lively_weights

from unips_jax.estimation.pure import estimate_normals
from unips_jax.models import ops
from unips_jax.models.config_json import from_json, to_json
from unips_jax.models.fine import at_nodes
from unips_jax.models.network import UniversalNetwork, encode
from unips_jax.models.views import (
    detail_bands,
    make_views,
    normalize_images,
    photograph_views,
)

GROWN = dataclasses.replace(SHALLOW_OURS, fine_dim=5, light_tokens=True)


def grown_params(changed=False):
    """Those of the small network, with new parts as they begin, or changed."""
    old = lively_weights(SHALLOW_OURS)
    new = lively_weights(GROWN)
    fine, tokens = new["encoder"]["fine"], new["encoder"]["consensus"]["tokens"]
    if not changed:
        for part in (fine, tokens):
            part["change"] = jax.tree.map(jnp.zeros_like, part["change"])
    consensus = {**old["encoder"]["consensus"], "tokens": tokens}
    encoder = {**old["encoder"], "fine": fine, "consensus": consensus}
    return {**old, "encoder": encoder}


@pytest.fixture(scope="module")
def photographs():
    rng = np.random.default_rng(0)
    images = rng.uniform(0.1, 1, (3, 22, 34, 3)).astype(np.float32)
    mask = np.zeros((22, 34), bool)
    mask[2:20, 5:30] = rng.random((18, 25)) > 0.1
    return images, mask


def test_new_parts_begin_as_the_identity(photographs):
    images, mask = photographs
    before = UniversalNetwork(SHALLOW_OURS, lively_weights(SHALLOW_OURS))
    after = UniversalNetwork(GROWN, grown_params())
    plain = estimate_normals(before, images, mask)
    np.testing.assert_allclose(estimate_normals(after, images, mask), plain, atol=2e-5)
    acting = UniversalNetwork(GROWN, grown_params(changed=True))
    assert abs(estimate_normals(acting, images, mask) - plain).max() > 1e-2


def test_padding_of_sets_changes_nothing(photographs):
    images, mask = photographs
    network = UniversalNetwork(GROWN, grown_params(changed=True))
    padded = np.concatenate([images, 7 * images[:2]])
    valid = np.array([True] * 3 + [False] * 2)
    np.testing.assert_allclose(
        estimate_normals(network, padded, mask, valid=valid),
        estimate_normals(network, images, mask),
        atol=1e-4,
    )


def test_reading_between_nodes_is_reading_between_cells():
    cells = jax.random.normal(jax.random.key(0), (5, 3, 4))
    places = jax.random.uniform(jax.random.key(1), (2, 50), minval=-0.5, maxval=4.5)
    read = ops.bilinear_sample(cells, *places, zeros=False)
    nodes = ops.bilinear_sample(
        at_nodes(cells[None])[0], *(2 * places + 1), zeros=False
    )
    np.testing.assert_allclose(nodes, read, atol=1e-5)


def test_bands_are_the_details():
    """Of a ramp across columns, only their difference."""
    image = np.ones((4, 4, 4), np.float32)
    image[..., :3] = np.arange(4.0)[None, :, None]
    bands = detail_bands(image)
    np.testing.assert_array_equal(bands[..., :3], -1)
    np.testing.assert_array_equal(bands[..., 3:], 0)
    image[0, 1, 3] = 0  # one of the first four pixels is outside
    assert (detail_bands(image)[0, 0] == 0).all()
    np.testing.assert_array_equal(detail_bands(jnp.asarray(image)), detail_bands(image))


def test_views_of_photographs_are_those_of_arrays(photographs):
    images, mask = photographs
    on_host, _ = photograph_views(images, mask, lambda x: x, GROWN)
    in_jax = make_views(normalize_images(images, mask), jnp.asarray(mask), GROWN)
    assert on_host.images.shape[-1] == 13
    np.testing.assert_allclose(on_host.images, in_jax.images, atol=1e-5)
    plain = make_views(normalize_images(images, mask), jnp.asarray(mask), SHALLOW_OURS)
    np.testing.assert_allclose(in_jax.images[..., :4], plain.images, atol=1e-6)


def test_the_kinds_of_light_are_guessed(photographs):
    images, mask = photographs
    views = make_views(normalize_images(images, mask), jnp.asarray(mask), GROWN)
    run = jax.jit(encode)
    guesses = run(UniversalNetwork(GROWN, grown_params()), views).guesses
    assert guesses.kinds.harmonics.shape == (2, 3, 9, 3)
    assert (guesses.kinds.nearness >= 0).all()
    plain = UniversalNetwork(SHALLOW_OURS, lively_weights(SHALLOW_OURS))
    views = make_views(normalize_images(images, mask), jnp.asarray(mask), SHALLOW_OURS)
    np.testing.assert_allclose(
        guesses.lights, run(plain, views).guesses.lights, atol=1e-5
    )


def test_weights_without_them_keep_their_json():
    text = to_json(SHALLOW_OURS)
    assert "fine_dim" not in text and "light_tokens" not in text
    assert from_json(type(GROWN), to_json(GROWN)) == GROWN
