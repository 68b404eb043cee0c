"""Files that are complete or absent."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_networks import lively_network

from unips_jax.baselines.gcnet.parameters import save_params
from unips_jax.errors import InputError
from unips_jax.evaluation.store import Store
from unips_jax.io import claims, door
from unips_jax.io.images import check_picture
from unips_jax.io.ps_wild import write_folder
from unips_jax.weights import save_weights

PARAMS = {"a": {"kernel": np.zeros(3, np.float32)}}
WRITERS = {
    "write_whole": lambda folder: door.write_whole(folder / "a", b"data"),
    "save_weights": lambda folder: save_weights(folder / "a", lively_network()),
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
    door.write_whole(path, b"old")
    seen = []
    monkeypatch.setattr(os, "fsync", lambda _: seen.append(path.read_bytes()))
    door.write_whole(path, b"new")
    assert seen == [b"old"] and path.read_bytes() == b"new"
    assert files(tmp_path) == {"file"}


def test_names_that_are_too_long_are_cut_and_stay_apart(tmp_path):
    first, second = "n" * 300, "n" * 299 + "m"
    names = {claims.slug(first), claims.slug(second)}
    assert len(names) == 2 and max(map(len, names)) < 150
    assert claims.slug("n" * 120) == "n" * 120
    door.write_whole(tmp_path / ("n" * 255), b"data")
    assert files(tmp_path) == {"n" * 255}


def test_folders_and_pictures_that_cannot_be_written_are_refused_first(
    tmp_path, monkeypatch
):
    (tmp_path / "a.png").write_bytes(b"")
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(InputError, match=r"^-o /.*: expected a folder that may be"):
        claims.make_folder(tmp_path, "-o")
    with pytest.raises(InputError, match=r"^--sheet /.*: expected a folder that may"):
        check_picture(tmp_path / "b.png", "--sheet")
    monkeypatch.setattr(os, "access", lambda path, mode: path == tmp_path)
    with pytest.raises(InputError, match=r"a\.png: expected a file that may be"):
        check_picture(tmp_path / "a.png", "--sheet")
    check_picture(tmp_path / "b.png", "--sheet")


@pytest.mark.parametrize("number", [0, 1, 4])
def test_a_full_disk_while_an_object_is_written(tmp_path, monkeypatch, number):
    left = [number]

    def replace(self, target):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", replace)
    truth = np.tile(np.float64([0, 0, 1]), (4, 4, 1))
    with pytest.raises(InputError, match=r"x\.data: cannot be written: No space left"):
        write_folder(
            tmp_path / "x.data",
            [truth] * 4,
            np.ones((4, 4), bool),
            truth,
            {},
            maps={"metal": truth},
        )
    assert not list(tmp_path.iterdir())
