"""Training: steps, resuming after a kill, devices, folders, refusals."""

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import SMALL

from unips_jax.command import InputError
from unips_jax.config import Config, DataConfig, OptimConfig, TrainConfig
from unips_jax.train_state import init_state
from unips_jax.train_step import augment, train_step

DATA = DataConfig(
    source="scenes", image_size=16, batch_size=8, num_images=(3,), num_pixels=40
)
CONFIG = Config(
    model=dataclasses.replace(SMALL, depths=(1,), num_heads=(2,)),
    data=DATA,
    optim=OptimConfig(learning_rate=1e-2, ema_decay=0.9),
    train=TrainConfig(steps=12, log_every=1, checkpoint_every=2, validate_every=100),
)


def batch(count=8, n=3, size=16):
    """Spheres under directional light."""
    generator = np.random.default_rng(0)
    y, x = np.mgrid[1 : -1 : size * 1j, -1 : 1 : size * 1j]
    mask = x**2 + y**2 < 0.9
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normals = np.stack([x, y, z], -1) * mask[..., None]
    lights = generator.normal(size=(count, n, 3)) + [0, 0, 2]
    images = np.maximum(np.einsum("hwk,bnk->bnhw", normals, lights), 0)
    return {
        "images": jnp.asarray(np.repeat(images[..., None], 3, -1), jnp.float32),
        "mask": jnp.asarray(np.broadcast_to(mask, (count, size, size))),
        "normals": jnp.asarray(
            np.broadcast_to(normals, (count, size, size, 3)), jnp.float32
        ),
    }


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_loss_falls(name):
    config = dataclasses.replace(
        CONFIG, optim=dataclasses.replace(CONFIG.optim, name=name)
    )
    state = jax.jit(init_state, static_argnums=0)(config, jax.random.key(0))
    step = jax.jit(train_step, static_argnames="config")
    data, losses = batch(), []
    for _ in range(30):
        state, metrics = step(state, data, jax.random.key(1), config=config)
        losses.append(float(metrics["loss"]))
    assert np.mean(losses[-5:]) < 0.5 * losses[0]
    assert int(state.step) == 30


def test_accumulation_is_the_mean_of_its_parts():
    state = jax.jit(init_state, static_argnums=0)(CONFIG, jax.random.key(0))
    optim = dataclasses.replace(CONFIG.optim, accumulate=4)
    data = dataclasses.replace(DATA, augment=False, num_pixels=256)
    whole = dataclasses.replace(CONFIG, data=data)
    parts = dataclasses.replace(whole, optim=optim)
    step = jax.jit(train_step, static_argnames="config")
    _, one = step(state, batch(), jax.random.key(1), config=whole)
    _, four = step(state, batch(), jax.random.key(1), config=parts)
    np.testing.assert_allclose(one["loss"], four["loss"], rtol=1e-5)
    np.testing.assert_allclose(one["grad_norm"], four["grad_norm"], rtol=1e-4)


def test_augmentation_keeps_shading():
    """n . l stays right under one light once the light turns with the normals."""
    scene = {k: v[0] for k, v in batch(1).items()}
    light = np.linalg.lstsq(
        np.asarray(scene["normals"][scene["mask"]]),
        np.asarray(scene["images"][0][scene["mask"]][:, 0]),
        rcond=None,
    )[0]
    seen = set()
    for seed in range(40):
        images, mask, normals = augment(
            scene["images"], scene["mask"], scene["normals"], jax.random.key(seed)
        )
        fitted, residual = np.linalg.lstsq(
            np.asarray(normals[mask]), np.asarray(images[0][mask][:, 0]), rcond=None
        )[:2]
        plain = np.linalg.lstsq(
            np.asarray(scene["normals"][scene["mask"]]),
            np.asarray(scene["images"][0][scene["mask"]][:, 0]),
            rcond=None,
        )[1]
        np.testing.assert_allclose(residual, plain, rtol=1e-3, atol=1e-6)
        seen.add(tuple(np.round(fitted, 3)))
        np.testing.assert_allclose(abs(fitted[2]), abs(light[2]), rtol=1e-4)
    assert len(seen) == 8  # two flips and a transposition


RUN = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[2]))
from unips_jax import config as c
from unips_jax.train import train
config = c.from_json(c.Config, Path(sys.argv[1], "config.json").read_text())
if len(sys.argv) > 3:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(sys.argv[3], 2, int(sys.argv[4]))
train(config, Path(sys.argv[1]))
"""


def start(workdir: Path, config: Config, *arguments: str) -> subprocess.Popen:
    workdir.mkdir(exist_ok=True)
    text = json.dumps(dataclasses.asdict(config))
    (workdir / "config.json").write_text(text)
    command = [sys.executable, "-c", RUN, str(workdir), *(arguments or ("1",))]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)


def finish(process: subprocess.Popen) -> str:
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    return errors


def final_params(workdir: Path) -> dict[str, np.ndarray]:
    from safetensors.numpy import load_file

    return load_file(workdir / "last.safetensors")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Five objects with four photographs each, in PS-Wild's layout."""
    root = tmp_path_factory.mktemp("ps-wild")
    for index in range(5):
        folder = root / f"object{index}.data"
        folder.mkdir()
        scene = {k: np.asarray(v[0]) for k, v in batch(1, 4).items()}
        for i, image in enumerate(scene["images"] * (1 + index)):
            image = np.clip(image / 20, 0, 1) * 65535
            cv2.imwrite(str(folder / f"{i:03}.tif"), image.astype(np.uint16))
        normals = np.round((scene["normals"] + 1) / 2 * 65535).astype(np.uint16)
        cv2.imwrite(str(folder / "normal.tif"), normals[..., ::-1])
    return str(root)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, folders):
    """A run on folders alone: rendering scenes takes long to compile."""
    workdir = tmp_path_factory.mktemp("whole")
    data = dataclasses.replace(DATA, source="folders", root=folders)
    config = dataclasses.replace(CONFIG, data=data)
    finish(start(workdir, config))
    return config, workdir


@pytest.mark.parametrize(
    "source", ["folders", pytest.param("mixture", marks=pytest.mark.slow)]
)
def test_killed_and_resumed_is_bit_for_bit_the_same(
    uninterrupted, folders, tmp_path, source
):
    config, whole = uninterrupted
    workdir = tmp_path / "killed"
    if source == "mixture":  # with scenes, which take long to compile
        data = dataclasses.replace(
            DATA, source="mixture", root=folders, num_images=(2, 3)
        )
        config, whole = dataclasses.replace(CONFIG, data=data), tmp_path / "whole"
        finish(start(whole, config))
    generator = random.Random(os.urandom(8))
    kills = 0
    while kills < 3:
        process = start(workdir, config)
        log = workdir / "metrics.jsonl"
        before = log.read_text() if log.exists() else ""
        # Kill after a random part of the steps, or of the compilation.
        target = generator.randrange(1, 4)
        while process.poll() is None:
            lines = log.read_text() if log.exists() else ""
            if lines.count("\n") >= before.count("\n") + target:
                break
            time.sleep(0.02)
        time.sleep(generator.random() * 0.3)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        kills += 1
    finish(start(workdir, config))
    expected, actual = final_params(whole), final_params(workdir)
    assert set(expected) == set(actual)
    for name, value in expected.items():
        np.testing.assert_array_equal(actual[name], value, err_msg=name)

    def losses(workdir):
        lines = (workdir / "metrics.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines]

    assert losses(workdir) == losses(whole)


def test_sigterm_saves(uninterrupted, tmp_path):
    config, _ = uninterrupted
    long = dataclasses.replace(config.train, steps=100_000, checkpoint_every=99_999)
    process = start(tmp_path, dataclasses.replace(config, train=long))
    log = tmp_path / "metrics.jsonl"
    while process.poll() is None and not (log.exists() and log.read_text()):
        time.sleep(0.05)
    process.terminate()
    assert "stopped by SIGTERM" in finish(process)
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] != []


@pytest.mark.parametrize("fsdp", [1, 4])
def test_eight_devices_agree_with_one(uninterrupted, tmp_path, fsdp):
    config, whole = uninterrupted
    mesh = dataclasses.replace(config.mesh, fsdp=fsdp)
    finish(start(tmp_path, dataclasses.replace(config, mesh=mesh), "8"))
    assert_close(final_params(tmp_path), final_params(whole))


def test_two_processes_agree_with_one(uninterrupted, tmp_path):
    import socket

    config, whole = uninterrupted
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    pair = [start(tmp_path, config, "2", address, str(i)) for i in range(2)]
    for process in pair:
        finish(process)
    assert_close(final_params(tmp_path), final_params(whole))


def assert_close(actual, expected):
    """Devices sum in another order, and Adam amplifies that where gradients vanish."""
    difference = np.concatenate([(actual[k] - v).ravel() for k, v in expected.items()])
    size = np.concatenate([v.ravel() for v in expected.values()])
    assert np.linalg.norm(difference) < 1e-3 * np.linalg.norm(size)


def test_starts_from_weights(uninterrupted, tmp_path):
    from unips_jax.train import train

    config, whole = uninterrupted
    rate, optim = 1e-3, dataclasses.replace(config.optim, learning_rate=1e-3)
    steps = dataclasses.replace(config.train, steps=1)
    config = dataclasses.replace(config, optim=optim, train=steps)
    train(config, tmp_path, init_weights=str(whole / "last.safetensors"))
    before, after = final_params(whole), final_params(tmp_path)
    for name, value in before.items():
        assert np.max(np.abs(after[name] - value)) <= 1.1 * rate
    assert any(np.any(after[name] != value) for name, value in before.items())


def test_other_configuration_is_refused(uninterrupted):
    from unips_jax.train import train

    config, workdir = uninterrupted
    optim = dataclasses.replace(config.optim, learning_rate=1e-3)
    with pytest.raises(InputError, match="learning_rate"):
        train(dataclasses.replace(config, optim=optim), workdir)


def test_nonfinite_loss_saves_the_batch(tmp_path, monkeypatch):
    from unips_jax import train as module

    def broken(config, *_):
        while True:
            yield batch() | {"normals": batch()["normals"] * jnp.nan}

    monkeypatch.setattr(module, "_batches", broken)
    with pytest.raises(FloatingPointError, match="step 1"):
        module.train(CONFIG, tmp_path)
    with np.load(tmp_path / "nonfinite_step1.npz") as saved:
        assert np.isnan(saved["normals"]).any()
    assert not list((tmp_path / "checkpoints").glob("[0-9]*"))
