"""Lights as somebody might know them, drawn to train with, and given to `unips`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import SHALLOW, SHALLOW_OURS, lively_network

from unips_jax.baselines.method import Lights, Observed, Unsupported
from unips_jax.errors import InputError
from unips_jax.estimation.pure import estimate_normals
from unips_jax.evaluation.methods import UnipsOptions, load_variants, roughly_known
from unips_jax.scenes.incident import IncidentLight
from unips_jax.training.config import Config, DataConfig
from unips_jax.training.known_lights import draw_known_lights
from unips_jax.weights import save_weights


def test_shares_and_errors_of_drawn_lights():
    sets, images = 4000, 4
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(images, 3))
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    share = np.array([1, 0.5, 0.1, 1])  # the third lamp is too weak
    known = np.array([True, True, True, False])
    incident = IncidentLight(
        None,
        *(jnp.asarray(x, jnp.float32) for x in (ways, share, 0 * share)),
        None,
        jnp.asarray(known),
    )
    keys = jax.random.split(jax.random.key(0), sets)
    drawn = np.asarray(
        jax.vmap(lambda key: draw_known_lights(incident, key, 0.3))(keys)
    )
    length = np.linalg.norm(drawn, axis=-1)
    assert (length[:, 2:] == 0).all()
    given = length[:, :2] > 0
    assert abs(given.any(axis=1).mean() - 0.3) < 0.03
    assert abs(given[given.any(axis=1)].mean() - 0.85) < 0.05  # half lack three in ten
    errors, expected = [], []
    for i in (0, 1):
        mine = length[:, i] > 0
        cosine = drawn[mine, i] @ ways[i] / length[mine, i]
        errors.append(np.arccos(np.clip(cosine, -1, 1)))
        expected.append(np.arccos(np.clip(length[mine, i], -1, 1)))
    errors, expected = np.concatenate(errors), np.concatenate(expected)
    exact = expected < 1e-3
    assert abs(exact.mean() - 0.4) < 0.05
    assert errors[exact].max() < 1e-3
    for low, high in ((0.05, 0.2), (0.3, 0.6)):
        some = (expected > low) & (expected < high)
        ratio = np.sqrt(np.mean(errors[some] ** 2) / np.mean(expected[some] ** 2))
        assert 0.8 < ratio < 1.1, (low, high, ratio)


def test_errors_of_lights_are_those_asked_for():
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(4000, 3))
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    rough = roughly_known(ways, 20)
    length = np.linalg.norm(rough, axis=-1)
    np.testing.assert_allclose(length, np.cos(np.radians(20)), atol=1e-6)
    error = np.degrees(np.arccos(np.sum(rough * ways, axis=-1) / length))
    assert abs(np.sqrt(np.mean(error**2)) - 20) < 2
    np.testing.assert_allclose(roughly_known(ways, 0), ways, atol=1e-6)


def test_unips_is_given_the_lights_of_a_benchmark(tmp_path):
    knowing = lively_network(dataclasses.replace(SHALLOW_OURS, known_lights=True))
    save_weights(tmp_path / "knowing.safetensors", knowing)
    save_weights(tmp_path / "other.safetensors", lively_network(SHALLOW))
    options = UnipsOptions([str(tmp_path / "knowing.safetensors")])
    (plain, _), (given, _), (roughly, _) = (
        load_variants([request], options)
        for request in ("unips", "unips:lights=true", "unips:lights=20,fast=true")
    )
    assert (given.label, roughly.label) == ("unips lights", "unips fast lights 20")
    assert len({str(variant.key) for variant in (plain, given, roughly)}) == 3
    rng = np.random.default_rng(0)
    images = rng.uniform(0.1, 1, (2, 12, 12, 3)).astype(np.float32)
    ways = np.array([[0.6, 0, 0.8], [0, -0.6, 0.8]])
    seen = Observed(images, np.ones((12, 12), bool), Lights(ways, np.ones((2, 3))))
    expected = estimate_normals(knowing, images, lights=ways.astype(np.float32))
    np.testing.assert_allclose(given.run(seen), expected, atol=5e-5)
    assert abs(given.run(seen) - plain.run(seen)).max() > 1e-2
    with pytest.raises(Unsupported, match="needs known lights"):
        given.run(seen._replace(lights=None))
    others = UnipsOptions([str(tmp_path / "other.safetensors")])
    with pytest.raises(InputError, match="expected weights of a network that"):
        load_variants(["unips:lights=true"], others)
    for wrong in ("lights=95", "lights=no", "fast=1.5", "size=3"):
        with pytest.raises(InputError, match="expected fast=true, lights=true"):
            load_variants([f"unips:{wrong}"], options)


def test_settings_of_known_lights_that_do_not_fit_are_refused():
    for data, wrong in (
        (dict(known_lights_rate=1.5), r"a share in \[0, 1\]"),
        (dict(known_lights_rate=0.3, source="scenes"), "no augment"),
        (dict(known_lights_rate=0.3, source="mixture"), "no augment"),
    ):
        with pytest.raises(ValueError, match=wrong):
            DataConfig(**data)
    data = DataConfig(known_lights_rate=0.3, augment=False, source="scenes")
    with pytest.raises(ValueError, match="a network that knows lights"):
        Config(model=SHALLOW_OURS, data=data)
