"""Checkpoints: which are kept, and what is done about damaged ones and full disks."""

import dataclasses
import os
import shutil
import subprocess

import jax
import numpy as np
import pytest
from small_disk import small_disk
from training_runs import CONFIG, flip_a_bit, largest_file

from unips_jax.errors import InputError
from unips_jax.training.checkpoints import Checkpoints
from unips_jax.training.config import MeshConfig
from unips_jax.training.sharding import make_mesh, replicated

SHARDING = replicated(make_mesh(MeshConfig(data=1)))
SHAPES = {
    "a": jax.ShapeDtypeStruct((1000,), np.float32, sharding=SHARDING),
    "step": jax.ShapeDtypeStruct((), np.int32, sharding=SHARDING),
}


def state(step):
    values = np.random.default_rng(step).normal(size=1000)
    return {"a": np.float32(values), "step": np.asarray(step, np.int32)}


@pytest.fixture
def run(tmp_path):
    """A run's folder with checkpoints 3 and 6."""
    with Checkpoints(tmp_path, CONFIG) as checkpoints:
        for step in (3, 6):
            checkpoints.save(step, state(step), {"best": -step})
    return tmp_path


def restored(workdir):
    """The step, if what was saved with it comes back."""
    with Checkpoints(workdir, CONFIG) as checkpoints:
        step = checkpoints.latest_step()
        found, record = checkpoints.restore(SHAPES)
    np.testing.assert_array_equal(found["a"], state(step)["a"])
    assert (int(found["step"]), record) == (step, {"best": -step})
    return step


def test_parameters_of_another_version_are_one_line(run):
    other = {name: SHAPES["a"] for name in ("a", "b", "step")}
    with (
        Checkpoints(run, CONFIG) as checkpoints,
        pytest.raises(InputError, match="the version that wrote them, or choose") as e,
    ):
        checkpoints.restore(other)
    assert "\n" not in str(e.value)


def test_the_newest_are_kept(tmp_path):
    kept = dataclasses.replace(CONFIG.train, keep=2)
    config = dataclasses.replace(CONFIG, train=kept)
    with Checkpoints(tmp_path, config) as checkpoints:
        assert checkpoints.latest_step() is None
        for step in (3, 6, 9, 10):
            checkpoints.save(step, state(step), {"best": -step})
    names = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    assert names == {"9", "10"}
    assert restored(tmp_path) == 10


def test_the_checksums_are_those_that_the_system_computes(run):
    command = ["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"]
    if shutil.which(command[0]) is None:
        pytest.skip("there is no sha256sum")
    subprocess.run(command, cwd=run / "checkpoints" / "6", check=True)


DAMAGES = {
    "a bit at 10%": lambda folder: flip_a_bit(largest_file(folder), 0.1),
    "a bit at 30%": lambda folder: flip_a_bit(largest_file(folder), 0.3),
    "a bit of the metadata": lambda folder: flip_a_bit(
        folder / "_CHECKPOINT_METADATA", 0.9
    ),
    "a bit of a checksum": lambda folder: flip_a_bit(folder / "SHA256SUMS", 0.02),
    "a cut file": lambda folder: os.truncate(largest_file(folder), 100),
    "an empty file": lambda folder: os.truncate(largest_file(folder), 0),
    "empty metadata": lambda folder: os.truncate(folder / "_CHECKPOINT_METADATA", 0),
    "a file gone": lambda folder: largest_file(folder).unlink(),
    "no state": lambda folder: shutil.rmtree(folder / "state"),
    "no checksums": lambda folder: (folder / "SHA256SUMS").unlink(),
    "cut checksums": lambda folder: os.truncate(folder / "SHA256SUMS", 200),
    "empty checksums": lambda folder: os.truncate(folder / "SHA256SUMS", 0),
    "bytes for checksums": lambda folder: (folder / "SHA256SUMS").write_bytes(b"\xff"),
    "nothing": lambda folder: [shutil.rmtree(folder), folder.mkdir()],
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_checkpoint_is_set_aside(run, name, capsys):
    folder = run / "checkpoints" / "6"
    DAMAGES[name](folder)
    assert restored(run) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "checkpoint 6 is damaged (" in line and "from checkpoint 3" in line
    assert not folder.exists() and folder.with_name("6.damaged").is_dir()
    with Checkpoints(run, CONFIG) as checkpoints:
        checkpoints.save(6, state(6), {"best": -6})
    assert restored(run) == 6


def test_swapped_checkpoints_are_set_aside(run, capsys):
    """Both are whole, but neither is of its folder's step."""
    folder = run / "checkpoints"
    (folder / "3").rename(folder / "9")
    (folder / "6").rename(folder / "3")
    (folder / "9").rename(folder / "6")
    with pytest.raises(InputError, match="6: it was written at step 3; 3: .* step 6"):
        Checkpoints(run, CONFIG)


@pytest.mark.parametrize("name", ["99", "1" * 21, str(2**31)])
def test_a_copy_under_another_step_is_set_aside(run, name, capsys):
    folder = run / "checkpoints"
    shutil.copytree(folder / "6", folder / name)
    assert restored(run) == 6
    (line,) = capsys.readouterr().err.splitlines()
    assert f"checkpoint {name} is damaged (" in line and "from checkpoint 6" in line


def test_every_bit_counts(run, capsys):
    folder = run / "checkpoints" / "6"
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = file.read_bytes()
        for share in (0, 0.5, 0.99) if content else ():
            flip_a_bit(file, share)
            assert restored(run) == 3, (file, share)
            folder.with_name("6.damaged").rename(folder)
            file.write_bytes(content)
    assert restored(run) == 6


def test_without_an_intact_checkpoint_training_does_not_begin_anew(run):
    for step in "36":
        flip_a_bit(largest_file(run / "checkpoints" / step), 0.3)
    for _ in range(2):  # nor at the second attempt
        with pytest.raises(InputError, match=r"got none \(6: .*; 3: .* --workdir"):
            Checkpoints(run, CONFIG)


def test_what_was_not_completed_is_removed(run):
    folder = run / "checkpoints"
    shutil.copytree(folder / "6", folder / "9.partial")
    shutil.copytree(folder / "6", folder / "9.partial.orbax-checkpoint-tmp")
    assert restored(run) == 6
    assert {path.name for path in folder.iterdir()} == {"3", "6"}


def test_files_of_the_system_are_no_damage(run):
    (run / "checkpoints" / "6" / "state" / ".DS_Store").touch()
    assert restored(run) == 6


def test_a_full_disk_is_one_line(tmp_path, capfd):
    large = {"a": np.random.default_rng(0).normal(size=2**20)}
    with small_disk(tmp_path / "disk", 3 * 2**20) as workdir:
        with pytest.raises(InputError, match=r"checkpoints/6.* No space left") as told:
            with Checkpoints(workdir, CONFIG) as checkpoints:
                checkpoints.save(3, state(3), {"best": -3})
                checkpoints.save(6, large, {})
        assert "\n" not in str(told.value) and len(str(told.value)) < 400
        assert {path.name for path in (workdir / "checkpoints").iterdir()} == {"3"}
        assert restored(workdir) == 3
    assert capfd.readouterr().err == ""
