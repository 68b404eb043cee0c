"""The command `unips estimate`, with a stand-in for the network."""

import hashlib
import json
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from estimate_runs import run

from unips_jax import weights
from unips_jax.estimation import folders, streaming
from unips_jax.io.selection import select
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import UniversalNetwork

HEIGHT, WIDTH = 60, 80
EXAMPLES = 6


def photograph(index, dtype=np.uint8):
    """A bright spot that moves from picture to picture."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    angle = 2 * np.pi * index / EXAMPLES
    distance = np.hypot(x - 40 - 25 * np.cos(angle), y - 30 - 20 * np.sin(angle))
    picture = np.repeat(0.1 + 0.8 * np.exp(-((distance / 25) ** 2))[..., None], 3, -1)
    return (picture * np.iinfo(dtype).max).astype(dtype)


def write(path, image):
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def folder(tmp_path):
    """Six photographs, a mask that touches a border, and a normal map."""
    folder = tmp_path / "pot.data"
    folder.mkdir()
    for i in range(EXAMPLES):
        write(folder / f"L_{i}.png", photograph(i))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:50, 10:70] = 255
    write(folder / "mask.png", mask)
    write(folder / "normal.tif", photograph(0))
    return folder


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
    names = select(folder, max_images=4, seed=5).names
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


def test_a_failing_folder_does_not_lose_the_others(folder, tmp_path, calls, capsys):
    good, out = tmp_path / "good", tmp_path / "out"
    good.mkdir()
    for i in range(EXAMPLES):
        write(good / f"{i}.jpg", photograph(i))
    (folder / "L_3.png").write_bytes(b"")
    assert run(folder, tmp_path / "none", good, "-o", out) == 2
    # The good one has no mask, which is a warning.
    lines = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error")]
    assert len(lines) == 3
    assert "L_3.png" in lines[0] and "none: expected a folder" in lines[1]
    assert lines[2].startswith("error: 2 of 3 folders gave no normals: ")
    assert [p.name for p in out.iterdir()] == ["good"]


def test_a_crash_in_a_batch_is_one_line_too(folder, tmp_path, calls, monkeypatch):
    def crash(*args, **kwargs):
        raise RuntimeError("out of\nmemory")

    other = tmp_path / "other"
    folder.rename(other)
    monkeypatch.setattr(streaming, "estimate_with_lights", crash)
    out = tmp_path / "out"
    assert run(other, tmp_path / "none", "-o", out) == 2
    with pytest.raises(RuntimeError, match="memory"):
        run(other, "-o", out)
    assert not out.exists()


def test_normals_that_are_not_finite_are_not_written(
    folder, tmp_path, calls, monkeypatch, capsys
):
    def broken(network, images, mask, **options):
        normals = np.where(mask[..., None], np.nan, 0) * np.ones(3, np.float32)
        return streaming.NormalsAndLights(normals, None)

    monkeypatch.setattr(streaming, "estimate_with_lights", broken)
    assert run(folder, "-o", tmp_path / "out") == 2
    assert "not finite at" in capsys.readouterr().err.splitlines()[-1]
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


def truncate(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def replace(path, image):
    path.unlink()
    write(path, image)


def nan_image(folder):
    picture = photograph(0).astype(np.float32)
    picture[3, 40] = np.nan  # inside the mask
    replace(folder / "L_0.png", photograph(0))
    (folder / "L_0.png").unlink()
    write(folder / "L_0.tif", picture)


def jpeg_truncated(folder):
    write(folder / "L_9.jpg", photograph(0))
    truncate(folder / "L_9.jpg", 0.8)


def mask_turned(folder):
    replace(folder / "mask.png", np.full((WIDTH, HEIGHT), 255, np.uint8))


def remove_photographs(folder):
    for file in folder.glob("L*"):
        file.unlink()


def all_black(folder):
    replace(folder / "L_2.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))


def black_inside_the_mask(folder):
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[55:] = 255
    replace(folder / "L_2.png", picture)


BAD_INPUT = {
    "empty": (
        lambda f: (f / "L_1.png").write_bytes(b""),
        ["L_1.png", "empty file (0 bytes)"],
    ),
    "truncated": (lambda f: truncate(f / "L_1.png", 0.9), ["L_1.png", "truncated"]),
    "truncated jpeg": (jpeg_truncated, ["L_9.jpg", "truncated"]),
    "no image": (
        lambda f: (f / "L_1.png").write_text("hello" * 99),
        ["L_1.png", "damaged"],
    ),
    "other size": (
        lambda f: replace(f / "L_1.png", photograph(0)[:50]),
        ["L_1.png", "expected 80 x 60", "got 80 x 50"],
    ),
    "other depth": (
        lambda f: replace(f / "L_1.png", photograph(0, np.uint16)),
        ["L_1.png", "expected uint8", "got uint16"],
    ),
    "black": (all_black, ["L_2.png", "got 0 at all 3000 pixels inside"]),
    "black inside": (black_inside_the_mask, ["L_2.png", "inside the mask"]),
    "nan": (nan_image, ["L_0.tif", "got 3 NaN or infinite"]),
    "mask of another size": (
        lambda f: replace(f / "mask.png", np.ones((50, 50), np.uint8)),
        ["mask.png", "expected a mask of 80 x 60", "got 50 x 50"],
    ),
    "mask turned": (mask_turned, ["mask.png", "got 60 x 80", "turn it by 90"]),
    "mask empty": (
        lambda f: replace(f / "mask.png", np.zeros((HEIGHT, WIDTH), np.uint8)),
        ["mask.png", "bright on the object, got 0 at most"],
    ),
    "mask damaged": (lambda f: truncate(f / "mask.png", 0.5), ["mask.png", "damaged"]),
    "two masks": (
        lambda f: write(f / "mask.tif", photograph(0)),
        ["mask.png, mask.tif", "--mask"],
    ),
    "no photographs": (
        remove_photographs,
        ["pot.data: expected photographs", "1 left out (a map", "normal.tif"],
    ),
}


@pytest.mark.parametrize(
    ("case", "reader"),
    [(case, "plain") for case in BAD_INPUT]
    # The authors' reader scales every file by itself, so depths may differ.
    + [(case, "official") for case in BAD_INPUT if case != "other depth"],
)
def test_bad_input_is_one_line_and_writes_nothing(
    folder, tmp_path, calls, capfd, case, reader
):
    spoil, expected = BAD_INPUT[case]
    spoil(folder)
    before = sorted(p.name for p in tmp_path.rglob("*"))
    assert run(folder, "-o", tmp_path / "out", "--reader", reader) == 2
    err = capfd.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and err.endswith("\n")
    for text in expected:
        if reader == "plain" or "got 0 at all" not in text:
            assert text in err
    assert sorted(p.name for p in tmp_path.rglob("*")) == before
    assert calls == []


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("none", "none: expected a folder of photographs, got nothing of this name"),
        ("pot.data/L_1.png", "got a file; give its folder"),
        (".", "it has folders, give those: "),
    ],
)
def test_bad_places(folder, tmp_path, calls, capsys, path, expected):
    assert run(tmp_path / path, "-o", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert expected in err and err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_missing_mask_file(folder, tmp_path, calls, capsys):
    assert run(folder, "-o", tmp_path / "out", "--mask", tmp_path / "m.png") == 2
    assert "m.png: expected a mask's image file" in capsys.readouterr().err


def test_results_never_go_among_the_photographs(folder, tmp_path, calls, capsys):
    place = folder.rename(tmp_path / "pot")
    assert run(place, "-o", tmp_path) == 2
    assert "the photographs' own folder" in capsys.readouterr().err
    assert not (place / "normals.png").exists()


def test_module_runs_as_a_program():
    program = [sys.executable, "-m", "unips_jax.cli.estimate", "--help"]
    shown = subprocess.run(program, capture_output=True, text=True, check=True)
    assert "--normal-map" in shown.stdout


@pytest.mark.parametrize("name", ["L_9.png", "a.txt", "mask.jpg"])
def test_a_link_to_itself_is_one_line(folder, tmp_path, calls, capsys, name):
    (folder / name).symlink_to(name)
    expected = 0 if name == "a.txt" else 2
    assert run(folder, "-o", tmp_path / "out") == expected
    assert capsys.readouterr().err.count("\n") == (expected == 2)
    (tmp_path / "loop").symlink_to("loop")
    for arguments in (
        (tmp_path / "loop", "-o", tmp_path / "o"),
        (folder, "-o", "loop"),
    ):
        assert run(*arguments, "--mask", tmp_path / "loop") == 2
        assert capsys.readouterr().err.count("\n") == 1
