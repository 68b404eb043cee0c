"""What a network with heads says beside the normals, and how it learns to."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import SMALL_OURS, lively_weights

from unips_jax import (
    estimate_maps,
    estimate_normals,
    estimate_photograph_maps,
    load_weights,
)
from unips_jax.models.heads import Maps
from unips_jax.scenes.config import SceneConfig
from unips_jax.training import loss as losses
from unips_jax.training import map_scores
from unips_jax.training.config import Config, DataConfig, OptimConfig, TrainConfig
from unips_jax.training.loop import train
from unips_jax.training.optimizer import make_optimizer
from unips_jax.weights import save_weights

CONFIG = dataclasses.replace(SMALL_OURS, head_dim=6)


@pytest.fixture(scope="module")
def params():
    return lively_weights(CONFIG)


def photographs():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:19, :27]
    mask = ((x - 12) / 10) ** 2 + ((y - 9) / 8) ** 2 < 1
    return rng.random((3, 19, 27, 3)).astype(np.float32), mask


def test_maps_have_their_ranges_and_change_no_normal(params):
    images, mask = photographs()
    maps = estimate_maps(params, images, mask, config=CONFIG)
    plain = {name: params[name] for name in ("encoder", "decoder")}
    normals = estimate_normals(plain, images, mask, config=SMALL_OURS)
    np.testing.assert_allclose(maps.normals, normals, atol=1e-6)
    assert maps.error.shape == mask.shape and maps.base_color.shape == (*mask.shape, 3)
    assert np.all((maps.error[mask] > 0) & (maps.error[mask] <= 180))
    for name in ("base_color", "roughness", "metallic"):
        values = np.asarray(getattr(maps, name))
        assert np.all((values[mask] > 0) & (values[mask] < 1)), name
        assert np.std(values[mask]) > 1e-4 and not np.any(values[~mask]), name


def test_photographs_have_the_maps_of_arrays(params):
    images, mask = photographs()
    expected = estimate_maps(params, images, mask, config=CONFIG)
    maps = estimate_photograph_maps(params, images, mask, config=CONFIG)
    for name, value in maps._asdict().items():
        np.testing.assert_allclose(
            value, getattr(expected, name), atol=2e-4, rtol=1e-4, err_msg=name
        )
    empty = estimate_photograph_maps(params, images, mask & False, config=CONFIG)
    assert all(not np.any(value) for value in empty)


def test_mirrored_photographs_have_mirrored_maps(params):
    images, mask = photographs()
    maps = estimate_maps(params, images, mask, config=CONFIG)
    other = estimate_maps(params, images[:, :, ::-1], mask[:, ::-1], config=CONFIG)
    np.testing.assert_allclose(other.error[:, ::-1], maps.error, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(other.base_color[:, ::-1], maps.base_color, atol=1e-4)


def test_padded_sets_have_the_same_maps(params):
    images, mask = photographs()
    maps = estimate_maps(params, images, mask, config=CONFIG)
    padded = np.concatenate([images, 9 + 0 * images[:1]])
    valid = np.array([True, True, True, False])
    again = estimate_maps(params, padded, mask, config=CONFIG, valid=valid)
    np.testing.assert_allclose(again.error, maps.error, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(again.roughness, maps.roughness, atol=1e-4)


def test_a_network_without_heads_says_so():
    images, mask = photographs()
    with pytest.raises(ValueError, match="expected a network with heads"):
        estimate_maps({}, images, mask, config=SMALL_OURS)
    with pytest.raises(ValueError, match="heads_only: expected a network with heads"):
        Config(model=SMALL_OURS, train=TrainConfig(heads_only=True))


def test_the_least_loss_is_that_of_nine_errors_in_ten():
    degrees = jnp.exp(jnp.linspace(0, 4, 1001))
    material = jnp.full((1001, 5), -1.0)

    def loss(said):
        maps = Maps(jnp.full(1001, said), material[:, :3], *material[:, 3:].T)
        each = losses.head_losses(maps, degrees, material)
        assert not np.any(each["material"])  # unknown
        return float(jnp.mean(each["error"]))

    said = np.exp(np.linspace(0, 4, 401))
    best = said[np.argmin([loss(value) for value in said])]
    assert np.mean(np.asarray(degrees) < best) == pytest.approx(0.9, abs=0.01)


def test_heads_send_no_gradient_to_the_normals(params):
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.random((2, 3, 16, 16, 3)), jnp.float32)
    normals = rng.normal(size=(2, 16, 16, 3))
    normals = jnp.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
    material = jnp.asarray(rng.random((2, 16, 16, 5)), jnp.float32)

    def gradient(params, config, **options):
        def loss(params):
            keys = jax.random.split(jax.random.key(1), 2)
            value, _ = losses.training_loss(
                params,
                images,
                jnp.ones((2, 16, 16), bool),
                normals.astype(jnp.float32),
                keys,
                config=config,
                num_pixels=50,
                grid_loss=False,
                **options,
            )
            return value

        return jax.jit(jax.grad(loss))(params)

    with_heads = gradient(params, CONFIG, material=material)
    plain = {name: params[name] for name in ("encoder", "decoder")}
    without = gradient(plain, SMALL_OURS)
    own = with_heads.pop("heads")
    assert all(np.any(x) for x in jax.tree.leaves(own))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6),
        with_heads,
        without,
    )
    only = gradient(params, CONFIG, material=material, heads_only=True)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6),
        only.pop("heads"),
        own,
    )
    assert not any(np.any(x) for x in jax.tree.leaves(only))


def heads_alone(steps):
    return Config(
        model=CONFIG,
        data=DataConfig(
            source="scenes",
            image_size=16,
            batch_size=2,
            num_images=(2,),
            num_pixels=64,
            grid_loss=False,
            augment=False,
        ),
        optim=OptimConfig(name="muon", learning_rate=3e-4, heads_rate=10, ema_decay=0),
        train=TrainConfig(
            steps=steps, heads_only=True, log_every=5, validation_scenes=0
        ),
    )


def test_the_optimiser_moves_the_heads_alone_and_faster():
    layer = {"kernel": jnp.ones((4, 3)), "bias": jnp.ones(3)}
    params = {name: layer for name in ("encoder", "decoder", "heads")}
    gradients = jax.tree.map(jnp.ones_like, params)

    def moved(config):
        optimizer = make_optimizer(config)
        state = optimizer.init(params)
        return optimizer.update(gradients, state, params)[0]

    config = heads_alone(10)
    alone = moved(config)
    slower = moved(
        dataclasses.replace(
            config, optim=dataclasses.replace(config.optim, heads_rate=1)
        )
    )
    jax.tree.map(
        lambda fast, slow: np.testing.assert_allclose(fast, 10 * slow, rtol=1e-4),
        alone.pop("heads"),
        slower["heads"],
    )
    assert not any(np.any(x) for x in jax.tree.leaves(alone))
    train_all = dataclasses.replace(config.train, heads_only=False)
    whole = moved(dataclasses.replace(config, train=train_all))
    assert all(np.any(x) for x in jax.tree.leaves(whole))


@pytest.mark.slow
def test_heads_begin_on_weights_that_have_none(tmp_path):
    """They alone are trained, and what they say gets better."""
    plain = lively_weights(SMALL_OURS)
    save_weights(tmp_path / "plain.safetensors", SMALL_OURS, plain)
    source = str(tmp_path / "plain.safetensors")
    train(heads_alone(30), tmp_path / "run", init_weights=source)
    model, trained = load_weights(tmp_path / "run" / "last.safetensors")
    assert model == CONFIG
    heads = trained.pop("heads")
    jax.tree.map(np.testing.assert_array_equal, trained, plain)
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    first, *_, last = map(json.loads, lines)
    assert last["error"] < first["error"] and last["material"] < first["material"]
    assert (
        heads.keys() == jax.eval_shape(lambda: lively_weights(CONFIG))["heads"].keys()
    )


def test_scores_of_what_is_said():
    rng = np.random.default_rng(0)
    said = rng.uniform(1, 60, 40_000)
    # Of an exponential distribution nine in ten are below ln 10 of its means.
    errors = rng.exponential(said / np.log(10))
    found = map_scores.calibration(said, errors)
    np.testing.assert_allclose(found["right"], 90, atol=1.5)
    assert sum(found["pixels"][:-1]) == pytest.approx(100)
    assert found["ninth"][0] < 5 and 10 < found["ninth"][2] < 20
    kept = map_scores.sparsification(said, errors)
    assert kept["kept 100%"] == pytest.approx(errors.mean())
    assert kept["best 50%"] < kept["kept 50%"] < 0.7 * errors.mean()
    blind = map_scores.sparsification(rng.random(said.size), errors)
    assert blind["kept 50%"] == pytest.approx(errors.mean(), rel=0.05)


def test_colours_count_up_to_scale():
    true = np.random.default_rng(1).random((500, 3))
    assert map_scores.color_psnr(true * 7, true) > 90
    off = true + np.where(np.arange(500) % 2, 0.1, -0.1)[:, None]
    assert map_scores.color_psnr(off, true) == pytest.approx(20, abs=0.5)
    assert map_scores.color_psnr(0 * true, true) < 6


def test_maps_are_scored_beside_floors(params):
    found = map_scores.score_maps(
        params, CONFIG, SceneConfig(), count=1, num_images=2, size=16
    )
    assert found["base_color"].keys() == {"maps", "mean photograph", "one grey"}
    assert all(
        np.isfinite(list(found[name].values())).all()
        for name in found
        if name != "calibration"
    )
