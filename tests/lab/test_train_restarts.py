"""A run on CPU starts its process again where its steps then take less time."""

import dataclasses
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from training_runs import CONFIG

from unips_jax.training import restarts
from unips_jax.training.restarts import Restarts
from unips_jax.weights import load_weights

ARGUMENTS = ["--config", "tiny", "--workdir", "runs/tiny"]
SETTINGS = ("MALLOC_ARENA_MAX", "MALLOC_MMAP_MAX_", "MALLOC_TRIM_THRESHOLD_")


@pytest.fixture
def started(monkeypatch):
    """What processes would have been started: their command and environment."""
    calls = []
    for name in (*SETTINGS, "UNIPS_TRAIN_COMPILED"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(restarts.platform, "libc_ver", lambda: ("glibc", "2.36"))
    monkeypatch.setattr(os, "execve", lambda *call: calls.append(call[1:]))
    command = [sys.executable, "-m", "unips_jax", "train", *ARGUMENTS]
    monkeypatch.setattr(sys, "orig_argv", command)
    return calls


def compile_something():
    jax.monitoring.record_event("/jax/compilation_cache/cache_misses")


def test_first_with_settings_then_once_when_compiled(started, monkeypatch):
    first = Restarts(ARGUMENTS)
    first.with_settings()
    [(command, environment)] = started
    assert command == sys.orig_argv
    assert [environment[name] for name in SETTINGS] == ["1", "0", "-1"]
    compile_something()
    assert not first.compiled_all(1000)  # this process has not the settings

    for name in SETTINGS:
        monkeypatch.setenv(name, environment[name])
    second = Restarts(ARGUMENTS)
    second.with_settings()
    assert len(started) == 1 and not second.compiled_all(1000)
    compile_something()
    assert not second.compiled_all(99) and not second.due
    assert second.compiled_all(100) and second.due
    second.start()
    command, environment = started[1]
    assert command == sys.orig_argv and environment["MALLOC_ARENA_MAX"] == "1"

    monkeypatch.setenv("UNIPS_TRAIN_COMPILED", environment["UNIPS_TRAIN_COMPILED"])
    third = Restarts(ARGUMENTS)
    third.with_settings()
    compile_something()
    assert not third.compiled_all(1000) and len(started) == 2


@pytest.mark.parametrize("why", ["notebook", "script", "system", "own settings"])
def test_other_processes_are_left_alone(started, monkeypatch, why):
    if why == "notebook":
        monkeypatch.setattr(sys, "orig_argv", [sys.executable, "-m", "ipykernel"])
    if why == "script":
        command = [sys.executable, "mine.py", *ARGUMENTS]
        monkeypatch.setattr(sys, "orig_argv", command)
    if why == "system":
        monkeypatch.setattr(restarts.platform, "libc_ver", lambda: ("musl", "1.2"))
    if why == "own settings":
        monkeypatch.setenv("MALLOC_ARENA_MAX", "4")
    process = Restarts(ARGUMENTS)
    process.with_settings()
    compile_something()
    assert not process.compiled_all(1000) and not process.due and not started


CONFIGURATION = """
from pathlib import Path
from unips_jax.models.config_json import from_json
from unips_jax.training.config import Config

def get_config():
    return from_json(Config, Path(__file__).with_name("config.json").read_text())
"""


@pytest.mark.slow
def test_a_run_that_starts_again_ends_as_one_that_does_not(tmp_path):
    train = dataclasses.replace(CONFIG.train, steps=110, checkpoint_every=1000)
    config = dataclasses.replace(CONFIG, train=train)
    (tmp_path / "config.json").write_text(json.dumps(dataclasses.asdict(config)))
    (tmp_path / "config.py").write_text(CONFIGURATION)
    command = [sys.executable, "-m", "unips_jax", "train"]
    command += ["--config", str(tmp_path / "config.py"), "--workdir"]
    plain = {k: v for k, v in os.environ.items() if k not in SETTINGS}
    plain["JAX_COMPILATION_CACHE_DIR"] = str(tmp_path / "cache")
    # Some setting of one's own: nothing starts again.
    own = plain | {"MALLOC_ARENA_MAX": "4", "JAX_COMPILATION_CACHE_DIR": "/dev/null/no"}
    ends = []
    for name, environment in (("again", plain), ("once", own)):
        workdir = tmp_path / name
        run = subprocess.run(
            [*command, str(workdir)], env=environment, capture_output=True, text=True
        )
        assert run.returncode == 0, run.stderr
        expected = int(name == "again")
        assert run.stderr.count("starting again after step 1:") == expected
        assert run.stderr.count("going on after step 1\n") == expected
        assert run.stdout.startswith("step 110 after ")
        lines = (workdir / "metrics.jsonl").read_text().splitlines()
        assert [json.loads(line)["step"] for line in lines] == list(range(1, 111))
        ends.append(load_weights(workdir / "last.safetensors").params)
    jax.tree.map(np.testing.assert_array_equal, *ends)
