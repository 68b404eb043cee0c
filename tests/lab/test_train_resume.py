"""Training runs: stopping, resuming, starting from weights, refusals."""

import dataclasses
import json
import random
import re
import shutil
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from small_networks import SHALLOW_OURS
from training_runs import (
    CONFIG,
    DATA,
    final_params,
    flip_a_bit,
    largest_file,
    start,
    trained,
    write_objects,
)

from unips_jax.errors import InputError
from unips_jax.weights import load_weights, weights_record


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return write_objects(tmp_path_factory.mktemp("ps-wild"))


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory, folders):
    """A run on folders alone: rendering scenes takes long to compile."""
    workdir = tmp_path_factory.mktemp("whole")
    data = dataclasses.replace(DATA, source="folders", root=folders)
    # Enough steps to be killed in thrice; checkpoints fall between the log's lines.
    steps = dataclasses.replace(CONFIG.train, steps=40, log_every=2)
    config = dataclasses.replace(CONFIG, data=data, train=steps)
    trained(workdir, config)
    return config, workdir


def kill_while_writing(workdir, config, complete):
    """Kills a run while it writes a checkpoint; again until nothing else was hit.

    Args:
        workdir: of a run that has begun or not.
        config: of the run.
        complete: how many checkpoints it completes before.
    """
    checkpoints, log = workdir / "checkpoints", workdir / "metrics.jsonl"
    for _ in range(10):
        process, before = start(workdir, config), names(checkpoints)
        written: set[str] = set()
        while process.poll() is None:
            written |= {name for name in names(checkpoints) - before if name.isdigit()}
            if len(written) >= complete and partial(checkpoints):
                break
            # To look closely while it starts would cost as much as the start.
            time.sleep(0.001 if log.exists() else 0.05)
        time.sleep(random.random() * 0.1)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
        if partial(checkpoints):
            return
    raise AssertionError("no kill fell into the writing of a checkpoint")


def names(folder):
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def partial(checkpoints):
    return any(".partial" in name for name in names(checkpoints))


def assert_same_end(workdir, whole):
    expected, actual = final_params(whole), final_params(workdir)
    assert set(expected) == set(actual)
    for name, value in expected.items():
        np.testing.assert_array_equal(actual[name], value, err_msg=name)
    assert losses(workdir) == losses(whole)


def losses(workdir):
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


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
        # Scenes tell where their lights are, folders do not.
        config = dataclasses.replace(CONFIG, data=data, model=SHALLOW_OURS)
        whole = tmp_path / "whole"
        trained(whole, config)
    kill_while_writing(workdir, config, complete=1)
    printed = trained(workdir, config)
    assert "damaged" not in printed and "going on after step" in printed
    assert_same_end(workdir, whole)


@pytest.mark.slow
@pytest.mark.parametrize("complete", range(10))
def test_killed_while_writing_any_checkpoint(uninterrupted, tmp_path, complete):
    config, whole = uninterrupted
    workdir = tmp_path / "killed"
    kill_while_writing(workdir, config, complete)
    trained(workdir, config)
    assert_same_end(workdir, whole)


def test_a_damaged_checkpoint_gives_way_to_the_one_before(uninterrupted, tmp_path):
    config, whole = uninterrupted
    workdir = tmp_path / "damaged"
    shutil.copytree(whole, workdir)
    newest = workdir / "checkpoints" / "40"
    flip_a_bit(largest_file(newest), 0.3)
    printed = trained(workdir, config)
    assert printed.count("damaged (") == 1 and "going on from checkpoint 39" in printed
    assert newest.with_name("40.damaged").is_dir()
    assert_same_end(workdir, whole)


CONFIGURATION = """
from pathlib import Path
from unips_jax.models.config_json import from_json
from unips_jax.training.config import Config

def get_config():
    return from_json(Config, Path(__file__).with_name("config.json").read_text())
"""


def test_sigterm_saves_and_shows_in_the_exit_status(uninterrupted, tmp_path):
    config, _ = uninterrupted
    long = dataclasses.replace(config.train, steps=100_000, checkpoint_every=99_999)
    text = json.dumps(dataclasses.asdict(dataclasses.replace(config, train=long)))
    (tmp_path / "config.json").write_text(text)
    (tmp_path / "config.py").write_text(CONFIGURATION)
    command = [sys.executable, "-m", "unips_jax.train", "--workdir", str(tmp_path)]
    command += ["--config", str(tmp_path / "config.py")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "metrics.jsonl"
    while process.poll() is None and not (log.exists() and log.read_text()):
        time.sleep(0.05)
    process.terminate()
    _, printed = process.communicate(timeout=600)
    assert process.returncode == 143, printed
    assert "stopped by SIGTERM" in printed
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] != []
    first, *others = re.findall(r"step +(\d+)/100000  .* s/step, .* left", printed)
    assert (first, others[:1]) == ("1", ["2"])
    assert re.search(r"compiled in \d+ (s|min)\n", printed)


@pytest.mark.slow
def test_starts_from_weights(uninterrupted, tmp_path):
    from unips_jax.training.loop import train

    config, whole = uninterrupted
    rate, optim = 1e-3, dataclasses.replace(config.optim, learning_rate=1e-3)
    steps = dataclasses.replace(config.train, steps=1)
    model = dataclasses.replace(config.model, dropout_rate=0.1, remat=True)
    config = dataclasses.replace(config, model=model, optim=optim, train=steps)
    train(config, tmp_path, init_weights=str(whole / "last.safetensors"))
    before, after = final_params(whole), final_params(tmp_path)
    for name, value in before.items():
        assert np.max(np.abs(after[name] - value)) <= 1.1 * rate
    assert any(np.any(after[name] != value) for name, value in before.items())


def test_other_configuration_is_refused(uninterrupted):
    from unips_jax.training.loop import train

    config, workdir = uninterrupted
    optim = dataclasses.replace(config.optim, learning_rate=1e-3)
    with pytest.raises(InputError, match="learning_rate"):
        train(dataclasses.replace(config, optim=optim), workdir)


def test_a_resumed_run_knows_its_best_and_what_it_began_with(
    uninterrupted, tmp_path, monkeypatch
):
    from unips_jax.training import loop

    errors = iter([30.0, 40.0, 50.0])
    monkeypatch.setattr(
        loop, "validate", lambda *_, **__: {"mae": next(errors), "constant": 60.0}
    )
    config, whole = uninterrupted
    for steps in (4, 6):
        times = dict(validate_every=2, validation_scenes=1, steps=steps)
        train = dataclasses.replace(config.train, **times)
        state = loop.train(dataclasses.replace(config, train=train), tmp_path)
    assert weights_record(tmp_path / "best.safetensors")["step"] == 2
    # What is released is the average.
    released = load_weights(tmp_path / "last.safetensors").params
    jax.tree.map(
        np.testing.assert_array_equal, released, jax.device_get(state.ema_params)
    )
    pairs = zip(*map(jax.tree.leaves, (released, state.params)), strict=True)
    assert any(np.any(average != last) for average, last in pairs)
    others = str(whole / "last.safetensors")
    with pytest.raises(InputError, match="began with, drawn ones"):
        loop.train(
            dataclasses.replace(config, train=train), tmp_path, init_weights=others
        )
