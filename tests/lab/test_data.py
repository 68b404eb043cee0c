"""Batches from folders: the same whoever reads them, and few read ahead."""

import contextlib
import dataclasses
import itertools
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_data import encode16, to16, write_image
from training_runs import CONFIG, write_objects

from unips_jax.errors import InputError
from unips_jax.io.ps_wild import PSWildFolders, read_object
from unips_jax.training import batches, folders
from unips_jax.training.sharding import make_mesh

OPTIONS = {"size": 16, "batch_size": 4, "num_images": (2, 3), "seed": 5}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_objects(tmp_path_factory.mktemp("ps-wild"))


def read(root, count, **options):
    batches = folders.folder_batches(root, **{**OPTIONS, "first": 0, **options})
    return list(itertools.islice(batches, count))


def assert_equal(actual, expected):
    assert len(actual) == len(expected)
    for a, e in zip(actual, expected, strict=True):
        assert set(a) == set(e)
        for name, value in e.items():
            np.testing.assert_array_equal(a[name], value)


def test_batches(root):
    batches = read(root, 6)
    assert {batch["images"].shape[1] for batch in batches} == {2, 3}
    assert all(batch["images"].shape[0] == 4 for batch in batches)
    assert batches[0]["normals"].shape == (4, 16, 16, 3)


def test_resumed_reading_goes_on(root):
    assert_equal(read(root, 3, first=2), read(root, 5)[2:])


def test_processes_share_a_batch(root):
    halves = [read(root, 4, process=(i, 2)) for i in range(2)]
    joined = [
        {name: np.concatenate([left[name], right[name]]) for name in left}
        for left, right in zip(*halves, strict=True)
    ]
    assert_equal(joined, read(root, 4))


def test_folders_are_found_through_links(root, tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "lighting").symlink_to(root, target_is_directory=True)
    found = PSWildFolders(tmp_path / "set", min_images=3)
    assert len(found) == len(PSWildFolders(Path(root), min_images=3)) == 5


def test_workers_read_the_same(root):
    assert_equal(read(root, 5, first=1, workers=2), read(root, 6)[1:])


@pytest.mark.skipif(not hasattr(os, "setpgid"), reason="no groups of processes")
def test_workers_are_not_of_the_jobs_group(root):
    """A signal to all of the job is the training process' to answer."""
    reading = folders.folder_batches(root, **OPTIONS, first=0, workers=1)
    next(reading)
    (worker,) = multiprocessing.active_children()
    assert os.getpgid(worker.pid) == worker.pid != os.getpgid(0)
    worker.kill()
    with pytest.raises(
        InputError, match=r"--data\.workers 1: a process that reads was"
    ):
        for _ in range(1000):
            batches._next(reading, 1)


PARENT = """
import multiprocessing, sys, time
sys.path[:0] = sys.argv[2:]
from unips_jax.training import folders

if __name__ == "__main__":
    reading = folders.folder_batches(
        sys.argv[1], size=16, batch_size=2, num_images=(2,), seed=0, first=0, workers=1
    )
    next(reading)
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="no list of processes")
def test_workers_go_with_the_training_process(root, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    command = [sys.executable, script, root, *sys.path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        (worker,) = map(int, parent.stdout.readline().split())
        parent.kill()
    alive = Path(f"/proc/{worker}/status")
    for _ in range(100):
        if not alive.exists() or "State:\tZ" in alive.read_text():
            return
        time.sleep(0.1)
    pytest.fail("a reading process outlives the training")


def test_few_batches_are_read_ahead(root, monkeypatch):
    sizes = []

    def counted(files, chosen, size):
        sizes.append(size)
        return original(files, chosen, size)

    original = folders.read_object
    monkeypatch.setattr(folders, "read_object", counted)
    batches = folders.folder_batches(root, **{**OPTIONS, "size": 8}, first=0)
    next(batches)
    time.sleep(0.3)
    # Threads of other tests may still be reading, at another size.
    assert sizes.count(8) <= 8 * OPTIONS["batch_size"]


RIGHT, UP, FRONT = [0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1]


@pytest.fixture
def quarters(tmp_path):
    """Photographs of 4 x 4 pixels: 4, 3, 1 and 4 of each quarter on the object."""
    normals = np.zeros((4, 4, 3))
    normals[:2, :2] = RIGHT
    normals[:2, 2:] = UP
    normals[2:, 2:] = [[UP, FRONT], [UP, FRONT]]
    normals[1, 3] = 0
    normals[2, 0] = FRONT
    folder = tmp_path / "x.data"
    write_image(folder / "normal.tif", encode16(normals))
    ramp = np.arange(16).reshape(4, 4, 1) / 20
    write_image(folder / "000.tif", to16(ramp * [0.5, 1.0, 0.25]))
    write_image(folder / "L01.png", (10 * ramp[..., 0] * 20).astype(np.uint8))
    write_image(folder / "L02.tif", to16(0 * ramp + [0.1, 0.2, 0.3]))
    write_image(folder / "baseColor.tif", to16(np.ones((4, 4, 3))))
    (files,) = PSWildFolders(tmp_path, min_images=3)
    return files


def test_an_object_is_averaged_over_its_own_pixels(quarters):
    found = read_object(quarters, np.array([2, 0]), 2)
    np.testing.assert_array_equal(found["mask"], [[True, True], [False, True]])
    np.testing.assert_allclose(found["images"][0, 0, 1], [0.1, 0.2, 0.3], atol=1e-5)
    # Means of the pixels 0, 1, 4, 5; of 2, 3, 6; and of 10, 11, 14, 15.
    means = np.array([[2.5, 11 / 3], [0, 12.5]])[..., None] / 20
    np.testing.assert_allclose(found["images"][1], means * [0.5, 1.0, 0.25], atol=1e-5)
    between = np.array([0, 0.3, 0.9]) / np.hypot(0.3, 0.9)
    expected = [[RIGHT, UP], [[0, 0, 0], between]]
    np.testing.assert_allclose(found["normals"], expected, atol=1e-4)


def test_an_object_at_its_own_size_is_read_as_it_is(quarters):
    found = read_object(quarters, np.array([1, 0]), 4)
    mask = found["mask"]
    assert mask.sum() == 12 and not mask[1, 3] and mask[2, 0]
    grey, colour = found["images"] * 20
    expected = np.arange(16).reshape(4, 4, 1) * mask[..., None]
    np.testing.assert_allclose(grey, np.tile(expected * 200 / 255, 3), atol=1e-4)
    np.testing.assert_allclose(colour, expected * [0.5, 1.0, 0.25], atol=1e-3)
    np.testing.assert_allclose(found["normals"][2, 2:], [UP, FRONT], atol=1e-4)


@pytest.mark.parametrize("turned", [False, True])
def test_a_square_is_made_of_an_object_that_is_none(quarters, tmp_path, turned):
    square = read_object(quarters, np.array([2, 0]), 2)
    for path in (*quarters.photographs, quarters.normals):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        empty = np.zeros_like(image)
        image = np.concatenate([image, empty], 0 if turned else 1)
        cv2.imwrite(str(path), image)
    found = read_object(quarters, np.array([2, 0]), 4)
    more, none = (0, 2), (0, 0)
    for name, widths in {
        "mask": [more, more],
        "normals": [more, more, none],
        "images": [none, more, more, none],
    }.items():
        np.testing.assert_array_equal(found[name], np.pad(square[name], widths))


def test_photographs_are_drawn_anew_for_every_object_without_repetition(root):
    known = {}
    for number, files in enumerate(PSWildFolders(Path(root), min_images=4)):
        images = read_object(files, np.arange(4), 16)["images"]
        known |= {image.tobytes(): (number, i) for i, image in enumerate(images)}
    assert len(known) == 20
    drawn = []
    for batch in read(root, 5, num_images=(3,)):
        found = [[known[x.tobytes()] for x in images] for images in batch["images"]]
        for images in found:
            assert len(set(images)) == 3
            assert len({number for number, _ in images}) == 1
        drawn.append([tuple(i for _, i in images) for images in found])
    # Of 24 orders each.
    assert all(len(set(orders)) > 1 for orders in drawn)
    assert len(set(sum(drawn, []))) > 10


def test_scenes_and_folders_mix_in_sets_of_all_sizes(root, monkeypatch):
    """Scenes are made up here: one number each."""

    def scenes(keys, *, size, num_images, **_):
        shape = len(keys), num_images, size, size, 3
        number = 2 + jax.vmap(jax.random.uniform)(keys)
        images = jnp.broadcast_to(number[:, None, None, None, None], shape)
        mask = jnp.ones(shape[:1] + shape[2:4], bool)
        return SimpleNamespace(images=images, mask=mask, normals=images[:, 0])

    monkeypatch.setattr(batches, "render_batch", scenes)
    data = dataclasses.replace(
        CONFIG.data,
        **dict(source="mixture", root=str(root), scene_share=0.75),
        **dict(batch_size=4, num_images=(2, 3), workers=0),
    )
    config = dataclasses.replace(CONFIG, data=data)

    def made(first, count):
        found = batches.make_batches(
            config,
            jax.random.key(0),
            make_mesh(config.mesh),
            first,
            lambda what: contextlib.nullcontext(),
        )
        return [np.asarray(b["images"]) for b in itertools.islice(found, count)]

    whole = made(0, 24)
    drawn = [images for images in whole if images.min() >= 2]
    assert 12 < len(drawn) < 24
    numbers = {x for images in drawn for x in images[:, 0, 0, 0, 0]}
    assert len(numbers) == 4 * len(drawn)  # every object is new
    for kind in (drawn, [images for images in whole if images.min() < 2]):
        assert {images.shape[1] for images in kind} == {2, 3}
    assert whole[5].min() < 2  # the batch before is one of folders
    for rest, images in zip(made(6, 5), whole[6:], strict=False):
        np.testing.assert_array_equal(rest, images)
