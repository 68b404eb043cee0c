"""Files that are complete or absent."""

import errno
import os
import subprocess
import sys

import numpy as np
import pytest

from unips_jax.baselines.gcnet.parameters import save_params
from unips_jax.errors import InputError
from unips_jax.evaluation.store import Store
from unips_jax.io import claims
from unips_jax.models.config import ModelConfig
from unips_jax.weights import save_weights

PARAMS = {"a": {"kernel": np.zeros(3, np.float32)}}
WRITERS = {
    "write_whole": lambda folder: claims.write_whole(folder / "a", b"data"),
    "save_weights": lambda folder: save_weights(
        folder / "a", ModelConfig.tiny(), PARAMS
    ),
    "save_params": lambda folder: save_params(folder / "a", PARAMS, "lcnet"),
    "commit": lambda folder: Store(folder).commit("a", {}, None),
}


def files(folder):
    return {path.name for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_nothing(name, tmp_path, monkeypatch):
    def fill(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fill)
        with pytest.raises(InputError, match=r"/a.*: No space left on device; free"):
            WRITERS[name](tmp_path)
    assert not files(tmp_path)
    WRITERS[name](tmp_path)
    assert len(files(tmp_path)) == 1


def test_file_systems_without_locks_are_named(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with (
        pytest.raises(InputError, match=r"lock: .*lock.*: No locks available; choose"),
        claims.claim(tmp_path / "lock"),
    ):
        pass


HOLDER = """
import pathlib, sys, time
from unips_jax.io.claims import claim
with claim(pathlib.Path(sys.argv[1])) as ours:
    print(ours, flush=True)
    time.sleep(600)
"""


def test_a_killed_process_lets_go_of_its_claim(tmp_path):
    lock = tmp_path / "lock"
    command = [sys.executable, "-c", HOLDER, str(lock)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "True\n"
        with claims.claim(lock) as ours:
            assert not ours
        holder.kill()
        with claims.claim(lock, wait=True) as ours:
            assert ours
    with claims.claim(lock) as ours:
        assert ours


def test_what_others_claim_comes_last(tmp_path):
    with claims.claim(tmp_path / "1") as ours:
        assert ours
        items = claims.claimed([0, 1, 2], lambda item: tmp_path / str(item))
        assert [next(items), next(items)] == [0, 2]
    assert list(items) == [1]


def test_what_was_there_stays_until_the_new_is_whole(tmp_path, monkeypatch):
    path = tmp_path / "deep" / "file"
    claims.write_whole(path, b"old")
    seen = []
    monkeypatch.setattr(os, "fsync", lambda _: seen.append(path.read_bytes()))
    claims.write_whole(path, b"new")
    assert seen == [b"old"] and path.read_bytes() == b"new"
    assert files(tmp_path) == {"file"}
