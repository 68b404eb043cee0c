"""Training steps: optimisers, accumulation, augmentation, non-finite losses."""

import dataclasses
import functools
import operator

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from training_runs import CONFIG, batch

from unips_jax.training.config import (
    Config,
    DataConfig,
    MeshConfig,
    OptimConfig,
    TrainConfig,
)
from unips_jax.training.loss import Objects
from unips_jax.training.optimizer import (
    _shorten_wide,
    make_optimizer,
    make_schedule,
)
from unips_jax.training.state import new_state
from unips_jax.training.step import _untrained, augment, batch_gradient, train_step


@pytest.mark.parametrize(
    "name", [pytest.param("adamw", marks=pytest.mark.slow), "muon"]
)
def test_loss_falls(name):
    config = dataclasses.replace(
        CONFIG, optim=dataclasses.replace(CONFIG.optim, name=name)
    )
    state = new_state(config, jax.random.key(0))
    step = jax.jit(train_step, static_argnames="config")
    data, losses = batch(), []

    def kernel(params):
        return np.asarray(params["encoder"]["fusion"]["fpn_bottleneck"]["kernel"])

    average = kernel(state.params)
    for k in range(30):
        state, metrics = step(state, data, jax.random.key(1), config=config)
        losses.append(float(metrics["loss"]))
        decay = min(0.9, (1 + k) / (10 + k))
        average = decay * average + (1 - decay) * kernel(state.params)
    np.testing.assert_allclose(kernel(state.ema_params), average, atol=1e-6)
    assert np.mean(losses[-5:]) < 0.5 * losses[0]
    assert int(state.step) == 30
    # Each step draws pixels and turns of its own.
    later = state._replace(step=state.step + 1)
    seen = [step(s, data, jax.random.key(1), config=config)[1] for s in (state, later)]
    assert seen[0]["mae_deg"] != seen[1]["mae_deg"]
    # Nothing passes a layer whose ReLUs are all off: here the last of the encoder.
    fusion = state.params["encoder"]["fusion"]["fpn_bottleneck"]
    fusion["bias"] -= 1e6
    before = metrics["untrained"]
    _, metrics = step(state, data, jax.random.key(1), config=config)
    sizes = jax.tree.map(jnp.size, state.params)
    encoder, decoder = (
        jax.tree.reduce(operator.add, sizes[half]) for half in ("encoder", "decoder")
    )
    assert before < 0.2
    assert metrics["untrained"] >= encoder / (encoder + decoder) > 0.5


def test_untrained_counts_the_outputs_without_gradient():
    kernel = jnp.asarray([[[0.0, 1.0]], [[0.0, 0.0]]])
    grads = {"kernel": kernel, "bias": jnp.asarray([0.0, 2.0]), "key": jnp.zeros(3)}
    assert _untrained(grads) == pytest.approx((2 + 1 + 3) / 9)


def test_schedules_are_those_of_their_names():
    cosine = OptimConfig(schedule="cosine", learning_rate=0.8, warmup_steps=10)
    rates = [float(make_schedule(cosine, 110)(step)) for step in (0, 5, 10, 60, 110)]
    np.testing.assert_allclose(rates, [0, 0.4, 0.8, 0.4, 0], atol=1e-6)
    level = OptimConfig(schedule="trapezoid", learning_rate=0.8, fall_steps=20)
    for warmup in (0, 10):
        rate = make_schedule(dataclasses.replace(level, warmup_steps=warmup), 110)
        rates = [float(rate(step)) for step in (10, 50, 90, 100, 110)]
        np.testing.assert_allclose(rates, [0.8, 0.8, 0.8, 0.4, 0], atol=1e-6)
        assert float(rate(5)) == pytest.approx(0.4 if warmup else 0.8)
        longer = make_schedule(dataclasses.replace(level, warmup_steps=warmup), 220)
        assert [float(longer(step)) for step in (5, 90)] == [float(rate(5)), rates[2]]
    steps = OptimConfig(schedule="step", learning_rate=0.5, decay_every=7)
    for warmup in (0, 3):
        rate = make_schedule(dataclasses.replace(steps, warmup_steps=warmup), 99)
        rates = [float(rate(warmup + step)) for step in (0, 6, 7, 14)]
        np.testing.assert_allclose(rates, [0.5, 0.5, 0.4, 0.32], rtol=1e-6)


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_kernels_alone_decay(name):
    config = OptimConfig(
        name=name, learning_rate=0.1, weight_decay=0.5, schedule="cosine"
    )
    params = {"a": {"kernel": jnp.ones((4, 3)), "bias": jnp.ones(3)}}
    params["table"] = jnp.ones((5, 3))
    optimizer = make_optimizer(Config(optim=config, train=TrainConfig(steps=10)))
    zeros = jax.tree.map(jnp.zeros_like, params)
    updates, _ = optimizer.update(zeros, optimizer.init(params), params)
    np.testing.assert_allclose(updates["a"]["kernel"], -0.05, rtol=1e-6)
    assert not np.any(updates["a"]["bias"]) and not np.any(updates["table"])


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_second_moments_of_biases_have_their_rate(name):
    params, moves = {"bias": jnp.ones(1)}, []
    for b2 in (0.5, 0.9):
        config = OptimConfig(name=name, b2=b2, warmup_steps=0, clip_norm=0)
        optimizer = make_optimizer(Config(optim=config, train=TrainConfig(steps=10)))
        state = optimizer.init(params)
        for gradient in (1.0, 0.1):
            given = {"bias": jnp.full(1, gradient)}
            updates, state = optimizer.update(given, state, params)
        moves.append(float(updates["bias"][0]))
    # The second one's mean square is (b2 + 0.01) / (1 + b2).
    expected = ((0.91 / 1.9) / (0.51 / 1.5)) ** 0.5
    assert moves[0] / moves[1] == pytest.approx(expected, rel=1e-4)


def test_large_sets_have_fewer_pixels():
    data = DataConfig(num_pixels=200, max_tokens=1000)
    assert [data.pixels_for(n) for n in (2, 5, 8, 10, 2000)] == [200, 200, 125, 100, 1]
    assert DataConfig(num_pixels=200, max_tokens=0).pixels_for(10) == 200


def test_a_step_moves_no_output_far():
    """Of a layer whose inputs all agree, however many they are."""
    config = OptimConfig(
        name="muon", learning_rate=1e-3, warmup_steps=0, weight_decay=0, clip_norm=0
    )
    for shape in ((64, 64), (3, 3, 384, 64)):
        kernel = jnp.zeros(shape)
        optimizer = make_optimizer(Config(optim=config, train=TrainConfig(steps=10)))
        inputs = np.ones(np.prod(shape[:-1]), np.float32)
        gradient = jnp.asarray(np.outer(inputs, np.ones(64)).reshape(shape))
        state = optimizer.init({"kernel": kernel})
        update, _ = optimizer.update({"kernel": gradient}, state, {"kernel": kernel})
        moved = inputs @ update["kernel"].reshape(-1, 64)
        assert 1e-3 < abs(moved).max() < 0.03


def test_steps_on_wide_convolutions_are_shortened_by_the_root():
    shapes = {"wide": (3, 3, 256, 2), "narrow": (3, 3, 28, 2), "matrix": (2304, 2)}
    found = _shorten_wide({name: np.ones(s) for name, s in shapes.items()}, None)
    assert found["wide"].max() == found["wide"].min() == pytest.approx(1 / 3)
    assert found["narrow"].min() == found["matrix"].min() == 1


def test_augmented_normals_stay_those_of_the_surface():
    """Images show the height of a plane: its slopes say what its normal must be."""
    row, column = np.mgrid[:5, :5]
    normal = np.array([0.2, 0.5, 0.8], np.float32)  # x right, y up
    height = 10 - (normal[0] * column - normal[1] * row) / normal[2]
    images = np.stack(3 * [height])[..., None] * np.array([1, 2, 4], np.float32)
    mask = height > 10.2
    # Longer where the plane is higher, so that every pixel differs.
    scene = Objects(images, mask, height[..., None] * normal, np.stack(3 * [normal]))
    many = jax.jit(jax.vmap(augment, (None, 0)))
    keys = jax.random.split(jax.random.key(0), 200)
    turns, orders = [], []
    augmented = map(np.asarray, many(scene, keys)[:4])
    for images, mask, normals, lights in zip(*augmented, strict=True):
        factors = images / images.min(-1, keepdims=True)
        orders += [tuple(each[0, 0].round().astype(int)) for each in factors]
        found = images.min(-1)
        np.testing.assert_allclose(found, np.stack(3 * [found[0]]), rtol=1e-6)
        np.testing.assert_array_equal(mask, found[0] > 10.2)
        unit = normals / found[0][..., None]
        np.testing.assert_allclose(unit, np.broadcast_to(unit[0, 0], unit.shape), 1e-5)
        down, right = (slope.mean() for slope in np.gradient(found[0]))
        expected = 0.8 * np.array([-right, down, 1])
        np.testing.assert_allclose(unit[0, 0], expected, atol=1e-4)
        np.testing.assert_allclose(lights, np.stack(3 * [expected]), atol=1e-4)
        turns.append(tuple(unit[0, 0].round(2)))
    # Two flips and a transposition, and of six orders of colours half the plain one.
    assert min(turns.count(turn) for turn in set(turns)) > 200 / 8 / 3
    assert (len(set(turns)), len(set(orders))) == (8, 6)
    assert orders.count((1, 2, 4)) / 600 == pytest.approx(1 / 2 + 1 / 12, abs=0.08)
    assert len({tuple(orders[i : i + 3]) for i in range(0, 600, 3)}) > 50


@pytest.mark.parametrize("wanted", [True, False])
def test_objects_are_augmented_if_asked_for(monkeypatch, wanted):
    from unips_jax.training import step as module

    monkeypatch.setattr(module, "training_loss", lambda _, objects, *__: objects)
    data = dataclasses.replace(CONFIG.data, augment=wanted)
    config = dataclasses.replace(CONFIG, data=data)
    given = batch(6, 2, 4)
    given["images"] *= jnp.arange(1, 17).reshape(4, 4, 1)
    keys = jax.random.split(jax.random.key(0), (2, 6))
    found = module.batch_loss({}, given, *keys, config=config)
    assert bool(jnp.any(found.images != given["images"])) == wanted


def test_nonfinite_loss_saves_the_batch(tmp_path, monkeypatch):
    from unips_jax.training import loop as module

    def broken(config, *_):
        while True:
            yield batch() | {"normals": batch()["normals"] * jnp.nan}

    monkeypatch.setattr(module, "make_batches", broken)
    with pytest.raises(FloatingPointError, match="step 1"):
        module.train(CONFIG, tmp_path)
    with np.load(tmp_path / "nonfinite_step1.npz") as saved:
        assert np.isnan(saved["normals"]).any()
    assert not list((tmp_path / "checkpoints").glob("[0-9]*"))


def test_microbatches_have_the_whole_batch_gradient_in_less_memory():
    """Of eight objects in four parts; another key gives another gradient."""
    params = new_state(CONFIG, jax.random.key(0)).params
    data = batch(8, 3, 16)
    # Objects that differ, so that parts of them do.
    data["images"] *= jnp.linspace(0.5, 2, 8)[:, None, None, None, None]
    data["mask"] &= jnp.arange(16)[:, None] >= jnp.arange(8)[:, None, None]

    def compiled(microbatches):
        mesh = MeshConfig(microbatches=microbatches)
        config = dataclasses.replace(CONFIG, mesh=mesh)
        gradient = jax.jit(functools.partial(batch_gradient, config=config))
        return gradient.lower(params, data, jax.random.key(2)).compile()

    whole, parts = compiled(1), compiled(4)
    expected, found, other = (
        jax.flatten_util.ravel_pytree(run(params, data, jax.random.key(key)))[0]
        for run, key in ((whole, 2), (parts, 2), (whole, 3))
    )
    size = jnp.linalg.norm(expected)
    assert jnp.linalg.norm(found - expected) < 1e-5 * size
    assert jnp.linalg.norm(other - expected) > 1e-3 * size
    memory = [run.memory_analysis().temp_size_in_bytes for run in (whole, parts)]
    assert memory[1] < 0.6 * memory[0], memory


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_gradients_are_clipped(name):
    def moved(clip, *gradients):
        config = OptimConfig(name=name, warmup_steps=0, clip_norm=clip, b2=0.9)
        optimizer = make_optimizer(Config(optim=config, train=TrainConfig(steps=10)))
        params = {"bias": jnp.ones(1)}
        state = optimizer.init(params)
        for gradient in gradients:
            given = {"bias": jnp.full(1, gradient)}
            updates, state = optimizer.update(given, state, params)
        return float(updates["bias"][0])

    shorter = moved(0, 0.1, 1.0)
    assert moved(1.0, 0.1, 100.0) == pytest.approx(shorter, rel=1e-4)
    assert moved(0, 0.1, 100.0) != pytest.approx(shorter, rel=0.01)
