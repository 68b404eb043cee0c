"""`unips estimate` once more: other options, files that moved or were mended since."""

import json

import cv2
import numpy as np
import pytest
import tifffile
from estimate_runs import photograph, pot, run, write
from plain_objects import photographs
from test_views import photograph as taken

from unips_jax.cli import main as cli
from unips_jax.errors import InputError
from unips_jax.estimation.options import FolderOptions
from unips_jax.io.results import results_of
from unips_jax.viewer.result import read_result


@pytest.fixture
def folder(tmp_path):
    return pot(tmp_path)


@pytest.fixture
def maskless(tmp_path):
    """A pot before a black background: its mask is looked for."""
    folder = tmp_path / "pot"
    folder.mkdir()
    images, _ = photographs(8, background=0.02, count=3)
    for index, image in enumerate(images):
        write(folder / f"{index}.png", image[..., ::-1])
    return folder


def record_of(folder):
    return json.loads((folder / "normals.json").read_text())


def test_a_mask_that_was_found_can_be_given(maskless, tmp_path, calls):
    out = tmp_path / "out"
    assert run(maskless, "-o", out) == 0
    mask = out / "pot" / "mask.png"
    found = mask.read_bytes()
    for options in ([], ["--mat"], []):
        assert run(maskless, "-o", out, "--mask", mask, *options) == 0
        assert mask.read_bytes() == found
        assert record_of(out / "pot")["mask"] == str(mask)
    assert len(calls) == 4
    assert run(maskless, "-o", out, "--mask", mask) == 0
    assert len(calls) == 4  # up to date


def test_a_mask_that_was_mended_is_not_replaced(maskless, tmp_path, calls, capsys):
    out = tmp_path / "out"
    assert run(maskless, "-o", out) == 0
    mask = out / "pot" / "mask.png"
    mended = np.zeros_like(cv2.imread(str(mask), 0))
    mended[60:120, 60:120] = 255
    write(mask, mended)
    for _ in range(2):  # also when it has been given
        before = mask.read_bytes()
        capsys.readouterr()
        assert run(maskless, "-o", out) == 2
        error = capsys.readouterr().err
        assert "mask.png: was changed since it was written" in error
        assert error.count("\n") == 1 and mask.read_bytes() == before
        assert run(maskless, "-o", out, "--mask", mask) == 0
        assert mask.read_bytes() == before
    mask.unlink()
    assert run(maskless, "-o", out) == 0
    assert (cv2.imread(str(mask), 0) != mended).any()


def test_photographs_are_found_from_anywhere(folder, tmp_path, calls, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(folder.name, "-o", "out") == 0
    monkeypatch.chdir(tmp_path / "out")
    assert len(read_result(tmp_path / "out" / "pot").photographs) == 6
    moved = tmp_path / "elsewhere" / "pot.data"
    moved.parent.mkdir()
    folder.rename(moved)
    assert run(moved, "-o", tmp_path / "out") == 0
    assert len(calls) == 1  # up to date
    assert record_of(tmp_path / "out" / "pot")["folder"] == str(moved)
    assert len(read_result(tmp_path / "out" / "pot").photographs) == 6


def test_a_page_that_was_deleted_is_made_again(folder, tmp_path, calls):
    results = tmp_path / "out" / "pot"
    command = [folder, "-o", results.parent, "--view"]
    assert run(*command) == 0
    (results / "view.html").unlink()
    # Until then the others are results.
    archive = [results, "-o", tmp_path / "archive", "--export", "archive"]
    assert cli.main(["surface", *map(str, archive)]) == 0
    assert results / "view.html" not in results_of(results)
    assert len(read_result(results).photographs) == 6
    assert run(*command) == 0
    assert len(calls) == 2 and (results / "view.html").is_file()
    (results / "view.html").write_text("with notes")
    assert run(*command) == 0
    assert len(calls) == 2  # up to date


@pytest.mark.parametrize("seed", range(4))
def test_the_dark_frame_is_not_drawn(folder, tmp_path, calls, seed):
    write(folder / "L_9.png", photograph(0) // 9)
    options = ["--dark", "L_9.png", "--max-images", 5, "--seed", seed]
    assert run(folder, "-o", tmp_path / "out", *options) == 0
    assert len(calls[0]["images"]) == 5
    left_out = record_of(tmp_path / "out" / "pot")["left_out"]
    assert [reason for reason, names in left_out.items() if "L_9.png" in names] == (
        ["by --dark"]
    )


def test_the_dark_frame_is_no_view(tmp_path, network_calls):
    folder = tmp_path / "vase"
    taken(folder / "dark.jpg", 0)
    dark = cv2.imread(str(folder / "dark.jpg"))
    for index, second in enumerate((60, 61, 62, 160, 161)):
        taken(folder / f"{index}.jpg", second, seed=index)
    black = np.zeros_like(dark)
    header = (folder / "dark.jpg").read_bytes()
    cut = cv2.imencode(".jpg", black)[1].tobytes()
    size = int.from_bytes(header[4:6], "big")
    (folder / "dark.jpg").write_bytes(header[: 4 + size] + cut[2:])
    options = ["--pause", 30, "--dark", "dark.jpg", "--mask", "none"]
    assert run(folder, "-o", tmp_path / "out", *options) == 0
    assert [len(call["images"]) for call in network_calls] == [3, 2]
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["vase-00", "vase-01"]


def test_pages_have_no_times(tmp_path, capsys):
    pages = np.stack([photograph(i) for i in range(3)])
    tifffile.imwrite(tmp_path / "stack.tif", pages, imagej=True)
    assert run(tmp_path / "stack.tif", "-o", tmp_path / "out", "--pause", 30) == 2
    assert "--pause: expected a folder of photographs" in capsys.readouterr().err


def test_check_takes_the_stacks_that_estimate_takes(tmp_path, capsys):
    pages = np.stack([photograph(i) for i in range(6)])
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, pages, imagej=True, truncate=True)  # one page for all
    assert cli.main(["check", str(path)]) in (0, 1)
    out, err = capsys.readouterr()
    assert "6 photographs" in out and err == ""


@pytest.mark.parametrize("focal", ["1200", "exif"])
def test_all_has_a_depth_for_a_focal_length(focal):
    FolderOptions(all=True, focal=focal).check()
    with pytest.raises(InputError, match="add --depth"):
        FolderOptions(focal=focal).check()


def test_the_whole_image_is_the_whole_image(folder, tmp_path, calls):
    """By the authors' reader too, which has a mask in `normal.tif`."""
    (folder / "mask.png").unlink()
    options = ["--reader", "official", "--size", 64, "--mask", "none"]
    assert run(folder, "-o", tmp_path / "out", *options) == 0
    assert calls[0]["mask"].all()


def test_a_lamps_distance_is_in_widths_of_a_photograph():
    options = FolderOptions(reader="official", lamp_distance=2.0, lights=True)
    with pytest.raises(InputError, match="--lamp-distance: the authors' reader"):
        options.check()


def test_another_objects_results_stay(folder, tmp_path, calls, capsys):
    """Of folders of one name; the same photographs may have moved or be fewer."""
    assert run(folder, "-o", tmp_path / "out") == 0
    result = tmp_path / "out" / "pot" / "normals.npy"
    before = result.read_bytes()
    (tmp_path / "b").mkdir()
    other = pot(tmp_path / "b")
    for file in other.glob("L*"):
        write(file, cv2.imread(str(file)) // 2)
    assert run(other, "-o", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert f"expected results of {other}, got those of {folder}" in error
    assert error.count("\n") == 1 and result.read_bytes() == before
    assert len(calls) == 1
    assert run(other, "-o", tmp_path / "out", "--overwrite") == 0
    # Taken anew in the same place it is the same object.
    for file in other.glob("L*"):
        write(file, cv2.imread(str(file)) // 2)
    assert run(other, "-o", tmp_path / "out") == 0 and len(calls) == 3
