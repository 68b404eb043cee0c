"""Training on several devices and in several processes."""

import dataclasses
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from training_runs import (
    CONFIG,
    DATA,
    final_params,
    finish,
    flip_a_bit,
    largest_file,
    start,
    trained,
    write_objects,
)


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """A run on one device, on folders alone: rendering scenes takes long to compile."""
    root = write_objects(tmp_path_factory.mktemp("ps-wild"))
    workdir = tmp_path_factory.mktemp("single")
    data = dataclasses.replace(DATA, source="folders", root=root)
    steps = dataclasses.replace(CONFIG.train, steps=5, checkpoint_every=9)
    config = dataclasses.replace(CONFIG, data=data, train=steps)
    trained(workdir, config)
    return config, workdir


@pytest.fixture(scope="module")
def eight(single, tmp_path_factory):
    """The same on eight devices that split the parameters, with a checkpoint amid."""
    workdir = tmp_path_factory.mktemp("eight")
    finish(start(workdir, altered(single[0], fsdp=4, checkpoint_every=2, keep=9), "8"))
    return workdir


def altered(config, *, fsdp, **train):
    mesh = dataclasses.replace(config.mesh, fsdp=fsdp)
    train = dataclasses.replace(config.train, **train)
    return dataclasses.replace(config, mesh=mesh, train=train)


@pytest.mark.slow
def test_eight_devices_agree_with_one(single, eight):
    assert_close(final_params(eight), final_params(single[1]))


@pytest.mark.slow
def test_eight_devices_that_split_nothing_agree_with_one(single, tmp_path):
    config, whole = single
    finish(start(tmp_path, altered(config, fsdp=1), "8"))
    assert_close(final_params(tmp_path), final_params(whole))


@pytest.mark.slow
def test_a_run_goes_on_with_fewer_devices(single, eight, tmp_path):
    """On eight that split the parameters, then two, then one."""
    config, whole = single
    shutil.copytree(eight / "checkpoints" / "2", tmp_path / "checkpoints" / "2")
    printed = finish(start(tmp_path, altered(config, fsdp=2, steps=4), "2"))
    assert "going on after step 2" in printed
    assert "going on after step 4" in trained(tmp_path, config)
    assert_close(final_params(tmp_path), final_params(whole))


def test_two_hosts_begin_and_one_goes_on(single, tmp_path):
    """Each has four devices, and finds the other as SLURM tells it.

    They split the parameters. The one has a single device, and takes the batch in two
    parts.
    """
    config, whole = single
    workdir = tmp_path / "run"
    split = altered(config, fsdp=4)
    for process in start_slurm(tmp_path, workdir, split, "--train.steps", "3"):
        process.communicate(timeout=600)
        assert process.returncode == 0
    kept = {path.name for path in (workdir / "checkpoints").iterdir()}
    assert kept == {"1", "3"}
    mesh = dataclasses.replace(config.mesh, microbatches=2)
    printed = trained(workdir, dataclasses.replace(config, mesh=mesh))
    assert "going on after step 3" in printed
    assert_close(final_params(workdir), final_params(whole))


@pytest.mark.slow
def test_two_processes_give_a_damaged_checkpoint_up_together(single, tmp_path):
    config, whole = single
    often = dataclasses.replace(config.train, checkpoint_every=2)
    config = dataclasses.replace(config, train=often)
    for process in start_pair(tmp_path, config):
        finish(process)
    newest, before = (tmp_path / "checkpoints" / step for step in ("5", "4"))
    flip_a_bit(largest_file(newest), 0.3)
    printed = [finish(process) for process in start_pair(tmp_path, config)]
    assert [text.count("going on from checkpoint 4") for text in printed] == [1, 0]
    assert_close(final_params(tmp_path), final_params(whole))
    for folder in (newest, before):
        flip_a_bit(largest_file(folder), 0.3)
    for process in start_pair(tmp_path, config):
        _, errors = process.communicate(timeout=600)
        assert process.returncode != 0 and "InputError" in errors


@pytest.mark.slow
def test_sigterm_to_one_process_stops_both(single, tmp_path):
    config, _ = single
    steps = dataclasses.replace(config.train, steps=100_000, checkpoint_every=99_999)
    pair = start_pair(tmp_path, dataclasses.replace(config, train=steps))
    log = tmp_path / "metrics.jsonl"
    try:
        while pair[0].poll() is None and not (log.exists() and log.read_text()):
            time.sleep(0.05)
        pair[1].terminate()
        errors = [process.communicate(timeout=60)[1] for process in pair]
    finally:
        for process in pair:
            process.kill()
            process.communicate()
    assert [process.returncode for process in pair] == [0, 0], errors
    done = re.search(r"stopped by SIGTERM after step (\d+)", errors[0])
    kept = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    assert kept == {"1", done[1]}


def start_pair(workdir, config):
    """Starts a run in two processes on this machine."""
    address = f"127.0.0.1:{free_port()}"
    return [start(workdir, config, "2", address, str(i)) for i in range(2)]


def start_slurm(tmp_path, workdir, config, *options):
    """Starts `unips train` as docs/many-machines.md does, as if on two hosts."""
    text = json.dumps(dataclasses.asdict(config))
    (tmp_path / "config.json").write_text(text)
    (tmp_path / "mine.py").write_text(RECIPE)
    arguments = ("train", "--config", "mine.py", "--workdir", str(workdir))
    command = [sys.executable, "-m", "unips_jax", *arguments, "--distributed", *options]
    job = {
        "SLURM_JOB_ID": "7",
        "SLURM_STEP_NODELIST": "localhost,localhost",
        "SLURM_NTASKS": "2",
        "SLURM_LOCALID": "0",
        "JAX_COORDINATOR_PORT": str(free_port()),
        "JAX_NUM_CPU_DEVICES": "4",
        "JAX_PLATFORMS": "cpu",
    }
    return [
        subprocess.Popen(
            command, cwd=tmp_path, env={**os.environ, **job, "SLURM_PROCID": str(i)}
        )
        for i in range(2)
    ]


RECIPE = """
from pathlib import Path
from unips_jax.models.config_json import from_json
from unips_jax.training import Config, sharding

sharding._MIN_SPLIT = 8  # else the small network's arrays would not be split at all

def get_config():
    return from_json(Config, Path("config.json").read_text())
"""


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def assert_close(actual, expected):
    """Devices sum in another order, and Adam amplifies that where gradients vanish."""
    difference = np.concatenate([(actual[k] - v).ravel() for k, v in expected.items()])
    size = np.concatenate([v.ravel() for v in expected.values()])
    assert np.linalg.norm(difference) < 1e-3 * np.linalg.norm(size)
