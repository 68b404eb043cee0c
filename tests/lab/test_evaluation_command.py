"""`unips eval` as a command: what it refuses, what it writes."""

import dataclasses
import json

import evaluation_data as data
import numpy as np
import pytest
from scipy.io import loadmat

from unips_jax.cli import evaluate as evaluation
from unips_jax.evaluation import methods, publish, runner
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.store import Store


@pytest.fixture(scope="module")
def ps_wild(tmp_path_factory):
    return data.make_ps_wild(tmp_path_factory.mktemp("ps_wild"))


def run(benchmark, root, work, *rest):
    return evaluation.main(
        [
            "--benchmark",
            benchmark,
            "--root",
            str(root),
            "--workdir",
            str(work),
            "--no-pictures",
            *rest,
        ]
    )


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        (["--weights", "no-such"], "no-such"),
        (["--method", "phong"], "no method"),
        (["--method", "constant", "--num-images", "9"], "has 4 images"),
        (["--method", "constant", "--num-images", "0"], "expected 1 or more"),
        (["--method", "constant", "--objects", "x"], "no object 'x'"),
        (["--method", "constant", "--crop-size", "3"], "at least 8"),
        (["--protocol", "native", "--crop-size", "32"], "expected --protocol crop"),
        (["--method", "constant", "--seeds", "-1"], "--seeds: expected 0 or more"),
        (["--method", "constant", "--weights", "tiny"], "--weights: expected"),
        (["--method", "constant", "--canonical-size", "32"], "--canonical-size: exp"),
        (["--method", "constant", "--uniform-contexts"], "--uniform-contexts: exp"),
    ],
)
def test_bad_commands_stop_before_any_work(ps_wild, tmp_path, capsys, rest, message):
    assert run("ps-wild", ps_wild, tmp_path / "work", *rest) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "work").exists()


def test_work_folder_must_not_be_in_the_data_nor_a_file(ps_wild, tmp_path, capsys):
    inside = ps_wild / "results"
    assert run("ps-wild", ps_wild, inside, "--method", "constant") == 2
    assert "inside the data" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert run("ps-wild", ps_wild, tmp_path / "file", "--method", "constant") == 2
    assert "not a folder" in capsys.readouterr().err


def test_diligent102_writes_a_submission(tmp_path, capsys):
    data.make_diligent102(tmp_path / "data", objects=("NUT_AL",))
    work = tmp_path / "work"
    chosen = ["--objects", "NUT_AL", "--method", "constant"]
    (work / "submission/constant").mkdir(parents=True)
    (work / "submission/constant/GOLF_PP.mat").write_bytes(b"of an earlier command")
    assert run("diligent102", tmp_path / "data", work, *chosen) == 0
    stored = loadmat(work / "submission/constant/NUT_AL.mat")["Normal_est"]
    assert stored.shape == (1001, 1001, 3)
    mask, _ = data.sphere(1001, 1001)
    np.testing.assert_allclose(
        stored[mask], np.tile([0, 0, 1], (mask.sum(), 1)), atol=1e-4
    )
    assert "truth withheld" in (work / "tables/objects.csv").read_text()
    assert not (work / "submission/constant/GOLF_PP.mat").exists()
    capsys.readouterr()
    assert (
        run("diligent102", tmp_path / "data", work, *chosen, "--protocol", "crop") == 2
    )
    assert "native" in capsys.readouterr().err


def test_every_method_has_a_submission_of_its_own(tmp_path):
    labels = ["mpm", "mpm\N{DAGGER}", "我的", "他的", "l1:iterations=3"]
    store = Store(tmp_path)
    entries = runner.Result("NUT_AL", {}, [], "", None, 3, None, {}, "", "a")
    found = [dataclasses.replace(entries, label=label) for label in labels]
    normals = [[[0.6, -0.48, 0.64], [0, 0, 0]], [[0, 0.8, 0.6], [-1, 0, 0]]]
    store.commit("a", {}, np.float32(normals))
    results = Results(
        "diligent102", "native", dict.fromkeys(labels, ""), (None,), found
    )
    folder = publish.write_submissions(store, results)
    names = sorted(path.parent.name for path in folder.glob("*/NUT_AL.mat"))
    assert len(names) == 5 and "mpm" in names
    for path in folder.glob("*/NUT_AL.mat"):
        np.testing.assert_allclose(loadmat(path)["Normal_est"], normals, atol=4e-5)
    alone = dataclasses.replace(results, methods={labels[1]: ""})
    publish.write_submissions(store, alone)  # has the same name in any run
    assert sorted(path.name for path in folder.iterdir()) == names


def test_unips_runs_from_the_command_line(ps_wild, tmp_path):
    weights = data.small_weights(tmp_path / "w.safetensors")
    work = tmp_path / "work"
    chosen = ["--objects", "mixed/obj000", "--weights", str(weights)]
    assert run("ps-wild", ps_wild, work, *chosen, "--crop-size", "32") == 0
    rows = json.loads((work / "tables/tables.json").read_text())["summary"]["rows"]
    assert [row[0] for row in rows[:2]] == ["unips", "constant"]
    assert rows[0][-1] == "1 of 1" and 0 < rows[0][3] < 180


def test_help_names_every_method(capsys):
    with pytest.raises(SystemExit):
        evaluation.main(["--help"])
    text = "".join(capsys.readouterr().out.split())
    assert all(name in text for name in methods.NAMES)
    assert f"classical({','.join(methods.CLASSICAL)})" in text


def test_published_numbers_of_diligent_stand_beside_ours(tmp_path):
    data.make_diligent(tmp_path / "data", images=3)
    work = tmp_path / "work"
    assert run("diligent", tmp_path / "data", work, "--method", "constant") == 0
    stored = json.loads((work / "tables" / "tables.json").read_text())
    objects = stored["objects"]
    rows = [dict(zip(objects["columns"], row, strict=True)) for row in objects["rows"]]
    assert rows[8]["Object"] == "pot2"
    assert rows[8]["least squares (published)"] == 14.65
    assert rows[-1]["least squares (published)"] == 15.39
    mask, normals = data.sphere(12, 14)
    angles = np.rad2deg(np.arccos(normals[mask][:, 2]))
    angles[:7] = 90
    assert rows[8]["constant"] == pytest.approx(angles.mean(), abs=1e-3)
    remarks = stored["remarks"]["rows"]
    assert [
        "pot2",
        None,
        "7 true normals of zero length count as 90 degrees",
    ] in remarks
    assert ["bear", None, "the first 20 images are corrupt: dropped"] in remarks


def test_published_means_are_over_the_objects_evaluated(tmp_path):
    data.make_diligent(tmp_path / "data", images=3, objects=("ball", "cat"))
    work = tmp_path / "work"
    chosen = ("--method", "constant", "--objects", "ball", "cat")
    assert run("diligent", tmp_path / "data", work, *chosen) == 0
    rows = json.loads((work / "tables" / "tables.json").read_text())["summary"]["rows"]
    means = {row[0]: row[3] for row in rows}
    assert means["least squares"] == pytest.approx((4.10 + 8.41) / 2)
    assert "PS-FCN" not in means


@pytest.mark.parametrize("objects", [("Ball",), data.LUCES])
def test_means_alone_compare_with_all_objects_alone(tmp_path, objects):
    data.make_luces(tmp_path / "data", objects=objects)
    chosen = ("--method", "constant", "--objects", *objects)
    assert run("luces", tmp_path / "data", tmp_path / "work", *chosen) == 0
    stored = json.loads((tmp_path / "work" / "tables" / "tables.json").read_text())
    names = {row[0] for row in stored["summary"]["rows"]}
    assert ("LINO-UniPS" in names) == (objects == data.LUCES)
    assert "LINO-UniPS" in [row[1] for row in stored["published"]["rows"]]
