"""Training on a bad day: files that are none, kills at bad moments, other data."""

import dataclasses
import itertools
import json

import cv2
import jax
import numpy as np
import pytest
from evaluation_data import write_mask
from small_networks import SHALLOW_OURS
from training_runs import CONFIG, DATA, batch, trained, write_objects

from unips_jax.errors import InputError
from unips_jax.io.masks import read_mask
from unips_jax.io.normals import read_normals
from unips_jax.io.ps_wild import PSWildFolders, read_object
from unips_jax.models.config_json import to_json
from unips_jax.scenes import load_meshes
from unips_jax.train import main
from unips_jax.training import batches, checkpoints, loop, write_folder
from unips_jax.training.config import MeshConfig
from unips_jax.training.folders import names_hash
from unips_jax.training.safety import check_input
from unips_jax.training.sharding import make_mesh

CHOSEN = np.arange(2)


def first_object(root):
    return PSWildFolders(root, min_images=2)[0]


def test_photographs_that_encode_light_for_displays_are_refused(tmp_path):
    root = write_objects(tmp_path) and tmp_path
    folder = root / "object0.data"
    grey = np.full((16, 16, 3), 128, np.uint8)
    cv2.imwrite(str(folder / "000.jpg"), grey)
    (folder / "000.tif").unlink()
    with pytest.raises(
        InputError, match=r"000\.jpg: expected linear .* got sRGB \(JPE"
    ):
        read_object(first_object(root), CHOSEN, 16)
    (folder / "000.jpg").unlink()
    cv2.imwrite(str(folder / "000.png"), grey)  # untagged: by the layout's promise
    images = read_object(first_object(root), CHOSEN, 16)["images"]
    assert images[0].max() == pytest.approx(128 / 255)
    data = (folder / "000.png").read_bytes()
    chunk = bytes.fromhex("0000000173524742" + "00" + "aece1ce9")  # sRGB, perceptual
    (folder / "000.png").write_bytes(data[:33] + chunk + data[33:])
    with pytest.raises(InputError, match=r"got sRGB \(PNG, sRGB tag in the file"):
        read_object(first_object(root), CHOSEN, 16)


def test_a_mask_narrows_what_is_trained_on(tmp_path):
    root = write_objects(tmp_path) and tmp_path
    whole = read_object(first_object(root), CHOSEN, 16)["mask"]
    left = np.arange(16) < 8
    path = root / "object0.data" / "mask.png"
    write_mask(path, np.broadcast_to(left, (16, 16)))
    found = read_object(first_object(root), CHOSEN, 16)
    np.testing.assert_array_equal(found["mask"], whole & left)
    assert not found["images"][:, ~found["mask"]].any()
    write_mask(path, np.ones((16, 17), bool))
    with pytest.raises(InputError, match=r"mask\.png: expected \(16, 16\) pixels"):
        read_object(first_object(root), CHOSEN, 16)


def test_photographs_of_other_names_are_said_to_be_so(tmp_path):
    folder = tmp_path / "cup.data"
    write_objects(tmp_path)
    (tmp_path / "object0.data").rename(folder)
    for path in folder.glob("0*.tif"):
        path.rename(folder / f"IMG_{path.name}")
    with pytest.raises(InputError, match=r"cup\.data: expected photographs named 0\*"):
        PSWildFolders(tmp_path, min_images=2)


def test_a_mask_of_numbers_is_written_as_one_of_truths(tmp_path):
    mask = np.zeros((8, 8), np.uint8)
    mask[2:6, 2:6] = 255
    mask[2, 2:6] = 64  # an edge
    normals = np.broadcast_to(np.float32([0, 0, 1]), (8, 8, 3))
    images = np.full((3, 8, 8, 3), 0.5)
    write_folder(tmp_path / "a.data", images, mask, normals, {"light": "lamp"})
    np.testing.assert_array_equal(read_mask(tmp_path / "a.data" / "mask.png"), mask > 0)
    found = read_normals(tmp_path / "a.data" / "normal.tif").any(-1)
    np.testing.assert_array_equal(found, mask > 0)


def test_a_root_that_scenes_would_not_read_is_refused(tmp_path):
    data = dataclasses.replace(DATA, root=str(tmp_path))
    config = dataclasses.replace(CONFIG, data=data)
    with pytest.raises(InputError, match=r"--data\.root .* folders or mixture"):
        check_input(config, make_mesh(MeshConfig(data=1)))


@pytest.mark.parametrize("damage", ["half", "bit", "array"])
def test_a_damaged_file_of_meshes_is_named(tmp_path, damage):
    path = tmp_path / "shapes.npz"
    grids = np.random.default_rng(0).normal(size=(1, 9, 9, 9)).astype(np.float16)
    np.savez_compressed(path, distance=grids)
    content = bytearray(path.read_bytes())
    if damage == "half":
        content = content[: len(content) // 2]
    content[200] ^= 16
    path.write_bytes(content)
    if damage == "array":
        np.save(path.with_suffix(".npy"), grids)
        path.with_suffix(".npy").rename(path)
    scenes = dataclasses.replace(CONFIG.scenes, mesh_rate=0.5, mesh_file=str(path))
    with pytest.raises(InputError, match="mesh_file .*: expected a file by"):
        load_meshes(scenes)


def test_a_run_that_ends_before_its_first_checkpoint_was_due_goes_on(
    tmp_path, monkeypatch
):
    """It has validated, and kept the best weights so far."""
    train = dataclasses.replace(
        CONFIG.train, steps=5, checkpoint_every=100, validate_every=2
    )
    train = dataclasses.replace(train, validation_scenes=1)
    config = dataclasses.replace(CONFIG, train=train)
    scores = {"mae": 9.0, "constant": 40.0}
    monkeypatch.setattr(loop, "validate", lambda *args, **options: scores)
    monkeypatch.setattr(loop, "score_table", str)
    ends = iter([3, 99])

    def made(*args):
        end = next(ends)
        for step in itertools.count(args[3] + 1):
            if step == end:
                raise KeyboardInterrupt
            yield batch(8, 3)

    monkeypatch.setattr(loop, "make_batches", made)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, config)
    assert (tmp_path / "best.safetensors").exists()
    assert "going on after step 1" in trained(tmp_path, config)
    assert (tmp_path / "last.safetensors").exists()


def test_a_photograph_that_cannot_be_read_costs_no_step(tmp_path, monkeypatch):
    train = dataclasses.replace(CONFIG.train, steps=5, checkpoint_every=100)
    config = dataclasses.replace(CONFIG, train=train)

    def made(*args):
        for step in itertools.count(args[3] + 1):
            if step == 4 and args[3] == 0:
                raise InputError("cup.data/L_03.png: damaged")
            yield batch(8, 3)

    monkeypatch.setattr(loop, "make_batches", made)
    with pytest.raises(InputError, match="L_03"):
        trained(tmp_path, config)
    assert "going on after step 3" in trained(tmp_path, config)


def test_other_data_than_before_are_named(tmp_path, capsys):
    root = tmp_path / "set"
    root.mkdir()
    before = names_hash(write_objects(root), 2)
    assert names_hash(str(root.rename(tmp_path / "moved")), 2) == before
    (tmp_path / "moved" / "object4.data" / "003.tif").unlink()
    now = names_hash(str(tmp_path / "moved"), 2)
    assert now != before
    loop._say_what_changed({"folders": before}, {"folders": now, "renderer": "a"})
    loop._say_what_changed({"folders": now}, {"folders": now})
    (line,) = capsys.readouterr().err.splitlines()
    assert "the objects below --data.root changed since the checkpoint" in line


@pytest.mark.parametrize(
    ("schedule", "fall", "step", "steps", "jumps"),
    [
        ("trapezoid", 20, 50, 200, False),
        ("trapezoid", 20, 100, 200, True),
        ("trapezoid", 0, 100, 200, False),
        ("cosine", 0, 100, 200, True),
        ("cosine", 0, 60, 100, False),
        ("step", 0, 100, 200, False),
    ],
)
def test_a_rate_that_jumps_is_said(schedule, fall, step, steps, jumps):
    """A run of 100 steps that is given another length."""
    optim = dataclasses.replace(CONFIG.optim, schedule=schedule, fall_steps=fall)
    train = dataclasses.replace(CONFIG.train, steps=100)
    before = dataclasses.replace(CONFIG, optim=optim, train=train)
    after = dataclasses.replace(before, train=dataclasses.replace(train, steps=steps))
    line = checkpoints._jump(json.loads(to_json(before)), after, step)
    assert ("the learning rate goes from 0 to" in line) == jumps
    assert bool(line) == jumps


@pytest.mark.parametrize(
    ("source", "share", "model", "kinds"),
    [
        ("mixture", 0.3, SHALLOW_OURS, 2),
        ("mixture", 1.0, SHALLOW_OURS, 1),
        ("mixture", 0.3, CONFIG.model, 1),
        ("scenes", 0.5, SHALLOW_OURS, 1),
    ],
)
def test_mixtures_compile_for_two_kinds_of_batches(source, share, model, kinds):
    data = dataclasses.replace(DATA, source=source, scene_share=share)
    config = dataclasses.replace(CONFIG, data=data, model=model)
    assert batches.kinds_of_batches(config) == kinds


def test_out_of_memory_names_what_training_has(tmp_path, monkeypatch, capsys):
    def full(*args, **options):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    monkeypatch.setattr(loop, "train", full)
    given = ["--config", "tiny", "--workdir", str(tmp_path)]
    assert main(given) == 2
    assert "--mesh.microbatches 2 or more" in capsys.readouterr().err
