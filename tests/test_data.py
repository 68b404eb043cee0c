"""Batches from folders: the same whoever reads them, and few read ahead."""

import itertools
import time

import numpy as np
import pytest
from training_runs import write_objects

from unips_jax.data import pipeline

OPTIONS = {"size": 16, "batch_size": 4, "num_images": (2, 3), "seed": 5}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_objects(tmp_path_factory.mktemp("ps-wild"))


def read(root, count, **options):
    batches = pipeline.folder_batches(root, **{**OPTIONS, "first": 0, **options})
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


def test_few_batches_are_read_ahead(root, monkeypatch):
    sizes = []

    def counted(files, chosen, size):
        sizes.append(size)
        return original(files, chosen, size)

    original = pipeline.read_object
    monkeypatch.setattr(pipeline, "read_object", counted)
    batches = pipeline.folder_batches(root, **{**OPTIONS, "size": 8}, first=0)
    next(batches)
    time.sleep(0.3)
    # Threads of other tests may still be reading, at another size.
    assert sizes.count(8) <= 8 * OPTIONS["batch_size"]
