"""The command `unips estimate`, with a stand-in for the network."""

import hashlib
import json
import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
from estimate_runs import EXAMPLES, HEIGHT, WIDTH, photograph, pot, replace, run, write

from unips_jax import weights
from unips_jax.cli import main
from unips_jax.estimation import folders
from unips_jax.io.selection import drawn, select
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import UniversalNetwork


@pytest.fixture
def folder(tmp_path):
    return pot(tmp_path)


def test_results_lie_at_the_photographs_place(folder, tmp_path, network_calls, capsys):
    assert run(folder, "-o", tmp_path / "out", "--exr", "--mat") == 0
    place = tmp_path / "out" / "pot"
    files = ["normals.exr", "normals.json", "normals.mat", "normals.npy", "normals.png"]
    assert sorted(p.name for p in place.iterdir()) == [*files, "sheet.png"]
    normals = np.load(place / "normals.npy")
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[:50, 10:70] = True
    np.testing.assert_array_equal(normals.any(axis=-1), inside)
    png = cv2.imread(str(place / "normals.png"), -1)[..., ::-1] / 65535 * 2 - 1
    assert np.abs(png - normals).max() < 2e-5
    (call,) = network_calls
    assert call["images"].dtype == np.uint8
    assert call["transfer"] == "srgb" and call["frame"] == "mask"
    expected = np.stack([photograph(i) for i in range(EXAMPLES)])
    np.testing.assert_array_equal(call["images"], expected)
    record = json.loads((place / "normals.json").read_text())
    assert list(record["images"]) == [f"L_{i}.png" for i in range(EXAMPLES)]
    assert record["left_out"] == {"a map or output, by its name": ["normal.tif"]}
    shipped = weights.weights_hash(weights.load_weights("tiny"))
    assert record["weights"] == {"name": "tiny", "hash": shipped, "trained": True}
    assert sorted([*record["files"], "normals.json"]) == [*files, "sheet.png"]
    out, err = capsys.readouterr()
    assert err == ""
    for text in ("L_0.png, L_1.png", "normal.tif (a map or output", "srgb", "mask.png"):
        assert text in out


@pytest.mark.parametrize(
    ("dtype", "choice", "expected"),
    [
        (np.uint8, "auto", "srgb"),
        (np.uint8, "linear", "linear"),
        (np.uint16, "auto", "linear"),
        (np.uint16, "srgb", "srgb"),
    ],
)
def test_transfer(tmp_path, calls, dtype, choice, expected):
    for i in range(EXAMPLES):
        write(tmp_path / f"{i}.tif", photograph(i, dtype))
    assert run(tmp_path, "-o", tmp_path / "out", "--transfer", choice) == 0
    assert calls[0]["transfer"] == expected
    assert calls[0]["images"].dtype == dtype
    assert calls[0]["mask"].all()


def test_official_reader(folder, tmp_path, calls):
    arguments = ["--reader", "official", "--size", 32]
    assert run(folder, "-o", tmp_path / "out", *arguments) == 0
    (call,) = calls
    assert call["images"].shape == (EXAMPLES, 32, 32, 3)
    assert call["transfer"] == "linear" and call["frame"] == "image"
    means = call["images"][:, call["mask"]].mean(axis=(1, 2))
    np.testing.assert_allclose(means, 1, rtol=1e-5)
    assert np.load(tmp_path / "out/pot/normals.npy").shape == (32, 32, 3)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--reader", "official", "--transfer", "srgb"), "takes every file as linear"),
        (("--size", 32), "--size 32: results have the photographs' size"),
    ],
)
def test_options_of_the_other_reader_are_refused(
    folder, tmp_path, calls, capsys, arguments, expected
):
    assert run(folder, "-o", tmp_path / "out", *arguments) == 2
    assert expected in capsys.readouterr().err and calls == []


def test_a_negative_seed_is_refused(folder, tmp_path, capsys):
    assert run(folder, "-o", tmp_path / "out", "--max-images", 2, "--seed", -1) == 2
    assert "expected 0 or more, got -1" in capsys.readouterr().err


def test_drawn_images_are_printed(folder, tmp_path, calls, capsys):
    assert run(folder, "-o", tmp_path, "--max-images", 4, "--seed", 5) == 0
    names = drawn(select(folder), 4, seed=5).names
    assert ", ".join(names) in capsys.readouterr().out
    assert calls[0]["images"].shape[0] == 4


def test_warnings_go_to_standard_error(folder, tmp_path, calls, capsys):
    for i in range(3, EXAMPLES):
        (folder / f"L_{i}.png").unlink()
    assert run(folder, "-o", tmp_path) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and f"warning: {folder}: too few photographs: 3" in lines[0]


def test_random_weights_say_so(folder, tmp_path, calls, monkeypatch, capsys):
    monkeypatch.setattr(
        weights,
        "random_weights",
        lambda config, seed: UniversalNetwork(config, {"a": np.ones(3)}),
    )
    assert run(folder, "-o", tmp_path, "--random-weights") == 0
    assert "RANDOM WEIGHTS: an untrained network" in capsys.readouterr().out
    record = json.loads((tmp_path / "pot/normals.json").read_text())
    assert record["weights"]["trained"] is False
    assert record["weights"]["name"] == "random, seed 0"


def test_missing_weights_are_one_line(folder, tmp_path, capsys):
    assert run(folder, "-o", tmp_path / "out", "--weights", "no_such_weights") == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "no_such_weights" in err and "unips train" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="names are Unicode elsewhere")
def test_names_that_are_not_unicode(folder, tmp_path, network_calls):
    other = tmp_path / os.fsdecode(b"K\xf6nig")
    (folder / "L_0.png").rename(folder / os.fsdecode(b"L\xe4mpe.png"))
    folder.rename(other)
    assert run(other, "-o", tmp_path / "out") == 0
    written = tmp_path / "out" / "K\ufffdnig"
    assert len(list(written.iterdir())) == 4
    record = json.loads((written / "normals.json").read_text(encoding="utf-8"))
    assert [os.fsencode(x) for x in record["images"]][-1] == b"L\xe4mpe.png"


@pytest.fixture
def done(folder, tmp_path, calls):
    """A folder's results, and a function that runs again and says what was called."""
    run(folder, "-o", tmp_path / "out")
    calls.clear()

    def again(*arguments):
        status = run(folder, "-o", tmp_path / "out", *arguments)
        return status, len(calls)

    return again


def test_what_is_done_is_not_done_again(folder, tmp_path, done, capsys):
    record = (tmp_path / "out/pot/normals.json").read_bytes()
    os.utime(folder / "L_0.png")
    assert done() == (0, 0)
    assert (tmp_path / "out/pot/normals.json").read_bytes() == record
    assert "pot is up to date; --overwrite makes it anew" in capsys.readouterr().out
    assert done("--overwrite") == (0, 1)


def test_every_file_is_opened_once(folder, tmp_path, calls):
    names = [*(f"L_{i}.png" for i in range(EXAMPLES)), "mask.png"]
    opened = []

    def listen(event, arguments):
        if event == "open" and listening and isinstance(arguments[0], str):
            opened.append(os.path.basename(arguments[0]))

    listening = [True]
    sys.addaudithook(listen)
    assert run(folder, "-o", tmp_path / "out") == 0
    listening.clear()
    assert sorted(name for name in opened if name in names) == sorted(names)
    record = json.loads((tmp_path / "out/pot/normals.json").read_text())
    hashes = record["images"] | {"mask.png": record["mask_hash"]}
    for name in names:
        content = (folder / name).read_bytes()
        assert hashes[name] == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize(
    "change",
    [
        lambda folder, out: write(folder / "L_2.png", photograph(1)),
        lambda folder, out: write(folder / "L_9.png", photograph(1)),
        lambda folder, out: (folder / "L_0.png").rename(folder / "L_7.png"),
        lambda folder, out: (folder / "L_0.png").unlink(),
        lambda folder, out: (folder / "mask.png").unlink(),
        lambda folder, out: replace(folder / "mask.png", photograph(0)[..., 0]),
        lambda folder, out: (out / "normals.png").write_bytes(b"painted over"),
        lambda folder, out: (out / "normals.npy").unlink(),
        lambda folder, out: (out / "normals.json").write_text("{}"),
    ],
)
def test_what_has_changed_is_done_again(folder, tmp_path, done, change):
    change(folder, tmp_path / "out" / "pot")
    assert done() == (0, 1)
    assert done() == (0, 1)  # and then no more


@pytest.mark.parametrize(
    "arguments",
    [
        ["--exr"],
        ["--transfer", "linear"],
        ["--max-images", "5"],
        ["--normal-map", "directx"],
        ["--reader", "official"],
    ],
)
def test_other_options_are_done_again(done, arguments):
    assert done(*arguments) == (0, 1)


def test_other_weights_or_code_are_done_again(done, monkeypatch):
    params = {"a": {"kernel": np.ones(6, np.float32)}}
    other = UniversalNetwork(ModelConfig.small(), params)
    with monkeypatch.context() as patched:
        patched.setattr(weights, "load_weights", lambda name: other)
        assert done() == (0, 1)
    assert done() == (0, 2)
    monkeypatch.setattr(folders, "code_hash", lambda *modules: "another")
    assert done() == (0, 3)


def test_the_function_is_as_quiet_as_the_command_is_not(
    folder, tmp_path, calls, capsys
):
    network = folders.load_network("tiny")
    record = folders.estimate_folder(folder, tmp_path / "out", network)
    assert capsys.readouterr() == ("", "")
    assert record["mask_pixels"] == 3000 and record["transfer"] == "srgb"
    assert (tmp_path / "out" / "normals.npy").is_file()


def test_folders_of_one_name_are_refused(folder, tmp_path, calls, capsys):
    twin = tmp_path / "x" / "pot"
    twin.mkdir(parents=True)
    assert run(folder, twin, "-o", tmp_path / "out") == 2
    assert "folders of different names" in capsys.readouterr().err


def test_names_of_one_folder_in_macos_are_refused_there(
    folder, tmp_path, calls, capsys, monkeypatch
):
    others = []
    for index, name in enumerate(("POT", "bu\u0308ste", "Büste")):
        others.append(tmp_path / str(index) / name)
        shutil.copytree(folder, others[-1])
    monkeypatch.setattr(sys, "platform", "darwin")
    for pair in ((folder, others[0]), others[1:]):
        assert run(*pair, "-o", tmp_path / "out") == 2
        assert "folders of different names" in capsys.readouterr().err
    monkeypatch.setattr(sys, "platform", "linux")
    assert run(folder, others[0], "-o", tmp_path / "out") == 0


def test_patterns_are_expanded_as_shells_do(folder, tmp_path, calls, capsys):
    shutil.copytree(folder, tmp_path / "[1]")
    shutil.copytree(folder, tmp_path / "cup")
    out = tmp_path / "out"
    assert run(tmp_path / "[pc]*", tmp_path / "[1]", "-o", out) == 0
    assert sorted(path.name for path in out.iterdir()) == ["[1]", "cup", "pot"]
    assert main.main(["check", str(tmp_path / "*"), "--json"]) == 2  # out is no folder
    assert f"{out}: expected photographs" in capsys.readouterr().err
    assert run(tmp_path / "x*", "-o", out) == 2
    assert (
        "x*: expected a folder of photographs, got nothing" in capsys.readouterr().err
    )


def test_module_runs_as_a_program():
    program = [sys.executable, "-m", "unips_jax.cli.estimate", "--help"]
    shown = subprocess.run(program, capture_output=True, text=True, check=True)
    assert "--normal-map" in shown.stdout
