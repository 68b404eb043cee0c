"""Full disks in the laboratory: one line, exit status 2, and nothing half-written."""

import json
from types import SimpleNamespace

import cv2
import evaluation_data as data
import numpy as np
import pytest
from small_disk import files_below, fill_after, small_disk

from unips_jax.cli.evaluate import main as evaluate
from unips_jax.evaluation import publish
from unips_jax.evaluation.store import Store
from unips_jax.io.door import NotWritten
from unips_jax.io.ps_wild import write_folder


@pytest.mark.parametrize("options", [[], ["--write-inputs"]])
@pytest.mark.parametrize("kilobytes", [8, 24])
def test_an_evaluation(options, kilobytes, tmp_path, capsys):
    data.make_folder(tmp_path / "bench")
    arguments = ["--benchmark", "folder", "--root", str(tmp_path / "bench")]
    arguments += ["-m", "constant", *options]
    with small_disk(tmp_path / "disk", kilobytes * 1024) as place:
        assert evaluate([*arguments, "--workdir", str(place / "out")]) == 2
        error = capsys.readouterr().err
        lines = [line for line in error.splitlines() if line.startswith("error: ")]
        assert len(lines) == 1 and "cannot be written: No space left" in lines[0]
        assert not list(place.rglob("*.tmp*"))
        for path in place.rglob("*.json"):
            json.loads(path.read_bytes())
        for path in place.rglob("*.png"):
            assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None


@pytest.mark.parametrize("count", [0, 2, 8])
def test_inputs_are_whole_objects(count, tmp_path, capsys, monkeypatch):
    data.make_folder(tmp_path / "bench")
    arguments = ["--benchmark", "folder", "--root", str(tmp_path / "bench")]
    arguments += [
        "-m",
        "constant",
        "--write-inputs",
        "--workdir",
        str(tmp_path / "out"),
    ]
    inputs = tmp_path / "out" / "inputs"
    with monkeypatch.context() as patch:
        fill_after(patch, count)
        assert evaluate(arguments) == 2
    assert "cannot be written: No space left" in capsys.readouterr().err
    first = {path.name: files_below(path) for path in inputs.iterdir()}
    assert evaluate(arguments) == 0
    folders = sorted(inputs.iterdir())
    whole = {path.name: files_below(path) for path in folders}
    assert len(whole) > len(first) == (count == 8)
    assert first.items() <= whole.items()
    # An earlier command showed more images; and a file of the user's.
    for folder in folders:
        (folder / "L_099.png").write_bytes(b"earlier")
        (folder / "notes.txt").write_bytes(b"mine")
    with monkeypatch.context() as patch:
        fill_after(patch, 1)
        assert evaluate(arguments) == 2
    for folder in folders:
        extra = {"L_099.png": b"earlier", "notes.txt": b"mine"}
        assert files_below(folder) == whole[folder.name] | extra
    assert evaluate(arguments) == 0
    for folder in folders:
        assert files_below(folder) == whole[folder.name] | {"notes.txt": b"mine"}


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "work")


@pytest.mark.parametrize("count", [0, 1, 2])
def test_submissions_and_tables_are_of_one_run(count, store, monkeypatch):
    results = [
        SimpleNamespace(name=name, entry=name, label="ours", unsupported="")
        for name in ("BALL", "CUBE", "GOLF")
    ]

    class Results:
        labels, main_count, seeds = ["ours"], None, (0,)

        def each(self, *_):
            return results

    version = b"first"
    monkeypatch.setattr(Store, "normals", lambda *_: None)
    monkeypatch.setattr(publish, "submission_bytes", lambda _: version)
    names = ("objects.csv", "objects.md", "objects.tex")
    monkeypatch.setattr(publish, "files_of", lambda _: dict.fromkeys(names, version))
    submission = publish.write_submissions(store, Results())
    tables = publish.write_tables(store, [])
    there = files_below(submission), files_below(tables)
    assert [len(found) for found in there] == [4, 3]
    del results[0]
    version = b"second"
    with monkeypatch.context() as patch:
        fill_after(patch, min(count, 1))
        with pytest.raises(NotWritten, match="No space left"):
            publish.write_submissions(store, Results())
        fill_after(patch, count)
        with pytest.raises(NotWritten, match="No space left"):
            publish.write_tables(store, [])
    assert (files_below(submission), files_below(tables)) == there
    publish.write_submissions(store, Results())
    publish.write_tables(store, [])
    assert files_below(submission / "ours") == dict.fromkeys(
        ("CUBE.mat", "GOLF.mat"), version
    )
    assert files_below(tables) == dict.fromkeys(names, version)


@pytest.mark.parametrize("count", [0, 2, 4])
def test_a_rendered_object_is_whole(count, tmp_path, monkeypatch):
    images, mask = np.zeros((2, 4, 5, 3)), np.ones((4, 5), bool)
    normals = np.broadcast_to([0.0, 0, 1], (4, 5, 3))
    with monkeypatch.context() as patch:
        fill_after(patch, count)
        with pytest.raises(NotWritten, match="No space left"):
            write_folder(tmp_path / "a.data", images, mask, normals, {})
    assert not [*tmp_path.iterdir()]
    write_folder(tmp_path / "a.data", images, mask, normals, {})
    assert len([*(tmp_path / "a.data").iterdir()]) == 5
