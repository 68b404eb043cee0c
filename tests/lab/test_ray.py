"""Objects spread over two nodes, whose workers die: the results of one machine."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from evaluation_data import make_diligent

from unips_jax.cli import cluster, estimate, evaluate
from unips_jax.errors import InputError

HERE = Path(__file__).parents[1]
SAMPLE = HERE.parent / "unips_jax" / "assets" / "sample" / "obj000.data"


def on_cluster(kills, *arguments):
    run = subprocess.run(
        [sys.executable, HERE / "ray_cluster.py", str(kills), *map(str, arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, "RAY_DEDUP_LOGS": "0"},
        timeout=900,
    )
    return run.returncode, run.stdout, run.stderr


def files_of(folder):
    found = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in found
        if not path.name.startswith(".") and ".locks" not in path.parts
    }


def test_an_evaluation_on_two_nodes_is_that_of_one(tmp_path):
    pytest.importorskip("ray", reason="ray is not installed")
    make_diligent(tmp_path / "data")
    data = ["--benchmark", "diligent", "--root", str(tmp_path / "data")]
    data += ["--objects", "ball", "cat"]
    chosen = ["-m", "constant", "least-squares", "--no-pictures", "--workdir"]
    assert evaluate.main([*data, *chosen, str(tmp_path / "one")]) == 0
    status, out, error = on_cluster(1, "eval", *data, *chosen, tmp_path / "many")
    assert status == 0, error
    assert "killed 1" in out
    one, many = files_of(tmp_path / "one"), files_of(tmp_path / "many")
    assert one.keys() == many.keys() and len(one) > 4
    assert [name for name in one if one[name] != many[name]] == []


def test_bad_options_are_one_line(tmp_path, capsys, monkeypatch):
    arguments = [str(SAMPLE), "-o", str(tmp_path), "--ray", "local"]
    assert estimate.main([*arguments, "--ray-cores", "0"]) == 2
    assert "--ray-cores: expected at least 1, got 0" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "ray", None)
    assert estimate.main(arguments) == 2
    assert "expected Ray, found none; pip install" in capsys.readouterr().err


@pytest.mark.slow
def test_estimates_with_five_workers_killed(tmp_path):
    folders = []
    for index in range(4):
        folders.append(tmp_path / f"object{index}.data")
        shutil.copytree(SAMPLE, folders[-1])
    folders.append(tmp_path / "empty.data")
    folders[-1].mkdir()
    one, many = tmp_path / "one", tmp_path / "many"
    assert estimate.main([*map(str, folders), "-o", str(one)]) == 2
    status, printed, error = on_cluster(5, "estimate", *folders, "-o", many)
    assert status == 2 and "1 of 5 folders gave no normals" in error
    assert "empty.data" in error and "killed 5" in printed
    one, many = files_of(one), files_of(many)
    assert one.keys() == many.keys()
    for name in one:
        if name.endswith(".json"):
            records = [json.loads(data[name]) for data in (one, many)]
            for record in records:
                record.pop("date", None), record.pop("seconds", None)
            assert records[0] == records[1]
        else:
            assert one[name] == many[name], name


def test_what_dies_for_good_is_told(monkeypatch):
    monkeypatch.setattr(cluster, "_finished", lambda *_: iter([("a", ""), ("b", "x")]))
    assert cluster.spread(print, [("a", 1), ("b", 2)], cluster.RayOptions(), "") == {
        "b": "x"
    }
    with pytest.raises(InputError, match="at least 1"):
        cluster.RayOptions(ray_cores=0).check()
