"""What `unips estimate` refuses: one line, nothing written, other folders kept."""

import numpy as np
import pytest
from estimate_runs import EXAMPLES, HEIGHT, WIDTH, photograph, pot, replace, run, write

from unips_jax.estimation import streaming


@pytest.fixture
def folder(tmp_path):
    return pot(tmp_path)


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


def truncate(path, keep):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


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
