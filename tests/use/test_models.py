"""Modules: invariances, padding of sets, variants, gradients."""

import dataclasses
import functools
import itertools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_networks
from flax.traverse_util import flatten_dict
from small_networks import lively

from unips_jax.models.chunks import in_pieces
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import EncoderDecoder, init_params
from unips_jax.models.self_calibrating import Observation, image_ratios
from unips_jax.models.set_attention import PMA, SAB, dot_product_attention

LARGER = dict(
    canonical_size=20,
    depths=(1, 2),
    window_size=3,
    aggregation_layers=2,
    drop_path_rate=ModelConfig.drop_path_rate,
    dropout_rate=ModelConfig.dropout_rate,
)
SMALL = dataclasses.replace(small_networks.SMALL, **LARGER)
OURS = dataclasses.replace(small_networks.SMALL_OURS, **LARGER)
SHALLOW = dataclasses.replace(SMALL, depths=(1, 1), aggregation_layers=1)
SHALLOW_OURS = dataclasses.replace(OURS, depths=(1, 1), aggregation_layers=1)


def inputs(n=3, size=20, pixels=17):
    keys = jax.random.split(jax.random.key(7), 3)
    images = jax.random.uniform(keys[0], (n, size, size, 4))
    observed = jax.random.uniform(keys[1], (pixels, n, 3))
    rows, columns = jax.random.uniform(keys[2], (2, pixels)) * 4
    return images, observed, rows, columns


def make(config, n=3):
    network = EncoderDecoder(config)
    arguments = inputs(n, config.canonical_size)
    return network, lively(network.init, *arguments)["params"], arguments


# Every value once; the other pairs are slow tests.
_IN_CI = {("pre_norm", "pre"), ("pre_norm", "post")}
_IN_CI |= {("released", "none"), ("released", "during")}
VARIANTS = [
    pytest.param(
        {"attention": attention, "communication": communication},
        marks=() if (attention, communication) in _IN_CI else pytest.mark.slow,
    )
    for attention, communication in itertools.product(
        ("pre_norm", "released"), ("none", "during", "pre", "post")
    )
] + [
    {"aggregation": "max"},
    {"context_sampling": "corner"},
    {"network": "ours"},
]


@pytest.mark.parametrize(
    "variant", VARIANTS, ids=lambda v: "-".join(map(str, v.values()))
)
def test_order_and_padding_of_images_do_not_matter(variant):
    ours = variant == {"network": "ours"}
    config = SHALLOW_OURS if ours else dataclasses.replace(SHALLOW, **variant)
    network, params, (images, observed, *places) = make(config)
    apply = jax.jit(network.apply)
    plain = apply({"params": params}, images, observed, *places)
    np.testing.assert_allclose(np.linalg.norm(plain, axis=-1), 1, atol=1e-6)
    order = jnp.array([2, 0, 1])
    permuted = apply({"params": params}, images[order], observed[:, order], *places)
    np.testing.assert_allclose(permuted, plain, atol=1e-5)

    padded = apply(
        {"params": params},
        jnp.concatenate([images, jnp.full((2, *images.shape[1:]), 9.0)]),
        jnp.concatenate([observed, jnp.full((17, 2, 3), 9.0)], axis=1),
        *places,
        jnp.array([True, True, True, False, False]),
    )
    np.testing.assert_allclose(padded, plain, atol=1e-5)


@pytest.mark.parametrize("attention", ["pre_norm", "released"])
def test_communication_changes_the_result(attention):
    network, params, (images, observed, *places) = make(
        dataclasses.replace(SHALLOW, attention=attention)
    )
    encode = jax.jit(
        functools.partial(network.apply, {"params": params}, method="encode")
    )
    contexts, changed = encode(images)[0], encode(images.at[1].mul(2))[0]
    assert abs(contexts[0] - changed[0]).max() > 1e-3


@pytest.mark.parametrize("attention", ["pre_norm", "released"])
def test_pooling_equals_the_plain_block(attention):
    """The folded products of PMA against a literal softmax attention."""
    y = jax.random.normal(jax.random.key(1), (5, 4, 12))
    module = PMA(12, 3, 7, attention)
    params = lively(module.init, y, None, True)["params"]
    actual = module.apply({"params": params}, y, None, True)

    def norm(x, p):
        x = (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + 1e-5)
        return x * p["scale"] + p["bias"]

    def linear(x, p):
        return x @ p["kernel"] + p["bias"]

    pre_norm = attention == "pre_norm"
    seeds = params["seeds"]
    q = linear(norm(seeds, params["norm"]) if pre_norm else seeds, params["query"])
    keys = norm(y, params["norm_set"]) if pre_norm else y
    k, v = linear(keys, params["key"]), linear(keys, params["value"])
    parts = []
    for head in range(3):
        part = slice(4 * head, 4 * head + 4)
        scale = (4 if pre_norm else 12) ** -0.5
        weights = jax.nn.softmax(q[:, part] @ jnp.swapaxes(k[..., part], 1, 2) * scale)
        parts.append(weights @ v[..., part])
    attended = jnp.concatenate(parts, -1)
    x = seeds + linear(attended, params["out"]) if pre_norm else q + attended
    hidden = norm(x, params["mlp"]["norm"]) if pre_norm else x
    hidden = jax.nn.gelu(linear(hidden, params["mlp"]["fc1"]), approximate=False)
    expected = x + linear(hidden, params["mlp"]["fc2"])
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)


def test_attention_of_a_large_set_in_pieces_is_that_of_the_whole():
    """And so is its gradient."""
    x = jax.random.normal(jax.random.key(1), (2, 11, 12))
    valid = jnp.arange(11) != 4
    whole = SAB(12, 3, 7, "pre_norm")
    params = lively(whole.init, x, valid, True)
    pieces = SAB(12, 3, 7, "pre_norm", query_chunk=4)

    def run(module):
        def loss(x):
            y = module.apply(params, x, valid, True)
            return jnp.sum(y[..., 0] ** 2), y

        return jax.jit(jax.grad(loss, has_aux=True))(x)

    for a, b in zip(run(pieces), run(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    jaxpr = str(jax.make_jaxpr(lambda x: pieces.apply(params, x, valid, True))(x))
    assert "f32[2,3,4,11]" in jaxpr and "f32[2,3,11,11]" not in jaxpr


@pytest.mark.parametrize("members", [5, 20])  # fewer and more than a head's channels
def test_attention_is_a_softmax_per_head(members):
    rng = np.random.default_rng(members)
    q, k, v = rng.normal(size=(3, 2, members, 16))
    bias = np.where(np.arange(members) < 4, 0, -np.inf)
    kept = rng.random((2, members, members)) < 0.7  # of each head
    result = dot_product_attention(
        *map(jnp.float32, (100 * q, k, v)),
        num_heads=2,
        scale=0.5,
        bias=bias,
        dropout=lambda weights: jnp.where(kept, weights, 0),
    )
    for head in (0, 1):
        own = slice(8 * head, 8 * head + 8)
        logits = 50 * q[..., own] @ k[..., own].swapaxes(-1, -2) + bias
        weights = np.exp(logits - logits.max(-1, keepdims=True))
        weights *= kept[head] / weights.sum(-1, keepdims=True)
        np.testing.assert_allclose(result[..., own], weights @ v[..., own], atol=1e-4)


@pytest.mark.parametrize("config", [SHALLOW, SHALLOW_OURS], ids=["paper", "ours"])
def test_every_parameter_is_reached_and_remat_changes_nothing(config):
    network, params, arguments = make(config)
    again = EncoderDecoder(dataclasses.replace(config, remat=True))

    def loss(params, network):
        normals = network.apply({"params": params}, *arguments)
        return jnp.sum(normals * jnp.array([1.0, 2.0, 3.0]))

    plain = jax.jit(jax.grad(loss), static_argnums=1)(params, network)
    remat = jax.jit(jax.grad(loss), static_argnums=1)(params, again)
    # A constant added to all keys of a set drops out of the softmax.
    for name, gradient in flatten_dict(plain, sep="/").items():
        guess = name.startswith(
            ("encoder/consensus/normals", "encoder/consensus/lights")
        )
        if not name.endswith("key/bias") and not guess:
            assert np.abs(gradient).max() > 0, name
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5),
        plain,
        remat,
    )


def test_observations_begin_as_the_identity_and_change_the_result():
    pixels, contexts = jax.random.uniform(jax.random.key(0), (2, 5, 4, 3))
    observation = Observation(7)
    params = observation.init(jax.random.key(1), pixels, contexts, None)["params"]
    begun = observation.apply({"params": params}, pixels, contexts, None)
    np.testing.assert_array_equal(begun, contexts)
    params["change"]["bias"] = jnp.ones(6)
    changed = observation.apply({"params": params}, pixels, contexts, None)
    np.testing.assert_allclose(changed, 2 * contexts + 1, rtol=1e-6)


def test_ratios_to_the_mean_of_the_set_are_free_of_albedo():
    shading = np.array([5.0, 10.0, 30.0, 7.0])[:, None, None]
    albedo = np.array([[1.0, 2.0], [0.5, 4.0]])
    images = np.ones((4, 2, 2, 4))
    images[..., :3] = (shading * albedo)[..., None] * (0.5, 1.0, 1.5)
    images[:, 1, 1] = 0  # outside the mask
    valid = jnp.array([True, True, True, False])  # their mean is 15
    ratio, logarithm, mean = np.moveaxis(image_ratios(images, valid), -1, 0)
    inside = images[..., 3] == 1
    expected = np.broadcast_to(shading / 15, inside.shape)[inside]
    np.testing.assert_allclose(ratio[inside], expected, rtol=0.01)
    np.testing.assert_allclose(logarithm[inside], np.log(expected), atol=0.01)
    expected = np.broadcast_to(np.log(15 * albedo), inside.shape)[inside]
    np.testing.assert_allclose(mean[inside], expected, atol=0.01)
    for appended in (ratio, logarithm, mean):
        assert not np.any(appended[~inside])


def test_ratios_begin_as_nothing_and_change_the_result():
    network, params, arguments = make(SHALLOW_OURS)
    part = jax.jit(lambda key: init_params(SHALLOW_OURS, key)["encoder"]["ratio_embed"])
    begun = part(jax.random.key(0))
    embed = network.bind({"params": {"encoder": {"ratio_embed": begun}}}).encoder
    assert not np.any(embed.ratio_embed(arguments[0]))
    nothing = params | {"encoder": params["encoder"] | {"ratio_embed": begun}}
    apply = jax.jit(network.apply)
    expected = apply({"params": nothing}, *arguments)
    changed = apply({"params": params}, *arguments)
    assert abs(changed - expected).max() > 1e-3


@pytest.mark.parametrize("config", [SHALLOW, SHALLOW_OURS], ids=["paper", "ours"])
def test_linear_pooling_cannot_cut_off_the_coarsest_stage(config):
    linear = config is SHALLOW_OURS
    network, params, arguments = make(config)
    bottleneck = params["encoder"]["fusion"]["ppm_bottleneck"]
    bottleneck |= {"kernel": bottleneck["kernel"] * 1e-3, "bias": jnp.full(8, -0.1)}
    branch = params["encoder"]["fusion"]["ppm0"]
    branch["bias"] -= 1e3

    @jax.jit
    @jax.grad
    def slope(params):
        return network.apply({"params": params}, *arguments)[..., 0].sum()

    def reached(part):
        gradient = slope(params)["encoder"]
        return [np.any(leaf) for leaf in jax.tree.leaves(part(gradient))]

    stage = reached(lambda gradient: gradient["stages_1"])
    assert all(stage) if linear else not any(stage)
    bottleneck["bias"] += 1e2
    pooled = reached(lambda gradient: gradient["fusion"]["ppm0"])
    assert all(pooled) if linear else not any(pooled)


def test_dropout_acts_in_training_only():
    config = dataclasses.replace(SMALL, dropout_rate=0.5, drop_path_rate=0.5)
    network, params, arguments = make(config)

    @jax.jit
    def run(key):
        return network.apply(
            {"params": params}, *arguments, None, False, rngs={"dropout": key}
        )

    first, second = run(jax.random.key(0)), run(jax.random.key(1))
    assert abs(first - second).max() > 1e-3
    np.testing.assert_array_equal(first, run(jax.random.key(0)))


def test_every_piece_has_its_own_dropout():
    """Images in pieces: no two pieces of equal images drop the same entries."""

    class Drops(nn.Module):
        @nn.compact
        def __call__(self, x):
            return in_pieces(2)(nn.Dropout(0.5, deterministic=False), x)

    run = jax.jit(
        lambda key: Drops().apply({}, jnp.ones((6, 40)), rngs={"dropout": key})
    )
    first, second, third = np.split(np.asarray(run(jax.random.key(0))), 3)
    for one, other in ((first, second), (second, third), (first, third)):
        assert 0.2 < np.mean(one != other) < 0.8
    assert set(np.unique(first)) == {0, 2}


def test_bfloat16_stays_near():
    network, params, arguments = make(SMALL)
    half = EncoderDecoder(dataclasses.replace(SMALL, dtype="bfloat16"))
    exact = jax.jit(network.apply)({"params": params}, *arguments)
    rounded = jax.jit(half.apply)({"params": params}, *arguments)
    assert rounded.dtype == jnp.float32
    assert abs(exact - rounded).mean() < 0.05


def test_paper_size():
    def count(config):
        arguments = inputs(2, config.canonical_size)
        shapes = jax.eval_shape(
            EncoderDecoder(config).init, jax.random.key(0), *arguments
        )
        return sum(x.size for x in jax.tree.leaves(shapes))

    official = ModelConfig.released()
    assert count(official) == 69_400_883
    assert count(dataclasses.replace(official, communication="none")) < 69_400_883
