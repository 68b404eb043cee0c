"""Photographs of several views in one folder, sorted by their EXIF times."""

import json

import numpy as np
import pytest
from estimate_runs import run
from picture_files import smooth
from PIL import Image, TiffImagePlugin

from unips_jax.capture.views import views_by_time
from unips_jax.errors import InputError
from unips_jax.io.formats.encoded import time_of
from unips_jax.io.images import image_header


def photograph(path, second, fraction="", seed=0):
    """A photograph taken that many seconds after ten o'clock."""
    exif = Image.Exif()
    exif[0x010F] = "camera"
    if second is not None:
        clock = f"{10 + second // 3600:02}:{second // 60 % 60:02}:{second % 60:02}"
        exif.get_ifd(0x8769).update({0x9003: f"2026:11:28 {clock}"})
        if fraction:
            exif.get_ifd(0x8769)[0x9291] = fraction
    path.parent.mkdir(exist_ok=True)
    picture = smooth(np.uint8, seed, height=40, width=48)
    if path.suffix == ".tif":
        tags = TiffImagePlugin.ImageFileDirectory_v2()
        tags[0x8769] = exif.get_ifd(0x8769) or {0xA001: 1}
        Image.fromarray(picture).save(path, tiffinfo=tags)
    else:
        Image.fromarray(picture).save(path, exif=exif)
    return path


@pytest.fixture
def folder(tmp_path):
    """Three views, named so that names mix them up."""
    folder = tmp_path / "vase.data"
    for index, second in enumerate((0, 3, 5, 70, 72, 200, 203, 260 + 3600)):
        name = f"L_{(index * 3) % 8}.jpg"
        photograph(folder / name, second, seed=index)
    return folder


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_times_are_read(tmp_path, suffix):
    path = photograph(tmp_path / f"a.{suffix}", 61, "25")
    ten = time_of("2026:11:28 10:00:00")
    assert image_header(path.read_bytes(), path).taken - ten == 61.25
    path = photograph(tmp_path / f"b.{suffix}", None)
    assert image_header(path.read_bytes(), path).taken == 0


@pytest.mark.parametrize("text", [None, "", "0000:00:00 00:00:00", "yesterday", 3])
def test_a_time_that_is_none_is_unknown(text):
    assert time_of(text) == 0


def test_a_pause_begins_a_view(folder):
    views = views_by_time(sorted(folder.iterdir()), 30)
    assert [len(view) for view in views] == [3, 2, 2, 1]
    names = [[file.name for file in view] for view in views]
    assert names[0] == ["L_0.jpg", "L_3.jpg", "L_6.jpg"]
    views = views_by_time(sorted(folder.iterdir()), 100)
    assert [len(view) for view in views] == [5, 2, 1]


def test_views_are_as_large_as_was_allowed(folder):
    files = sorted(folder.iterdir())
    with pytest.raises(InputError, match="raise --max-pixels"):
        views_by_time(files, 30, max_pixels=40 * 48 - 1)
    assert len(views_by_time(files, 30, max_pixels=40 * 48)) == 4


def test_views_have_results_of_their_own(folder, tmp_path, network_calls, capsys):
    out = tmp_path / "out"
    assert run(folder, "-o", out, "--pause", "100", "--mask", "none") == 0
    assert "3 views, of 5 + 2 + 1 photographs" in capsys.readouterr().out
    assert [len(call["images"]) for call in network_calls] == [5, 2, 1]
    results = sorted(out.iterdir())
    assert [path.name for path in results] == ["vase-00", "vase-01", "vase-02"]
    records = [json.loads((path / "normals.json").read_text()) for path in results]
    views = views_by_time(sorted(folder.iterdir()), 100)
    for record, view in zip(records, views, strict=True):
        assert set(record["images"]) == {file.name for file in view}
    assert run(folder, "-o", out, "--pause", "100", "--mask", "none") == 0
    assert len(network_calls) == 3  # up to date


def test_views_of_another_pause_are_named(folder, tmp_path, network_calls, capsys):
    out = tmp_path / "out"
    command = [folder, "-o", out, "--mask", "none", "--pause"]
    assert run(*command, "30") == 0 and len(network_calls) == 4
    single = photograph(tmp_path / "vase-07" / "a.jpg", 0).parent
    assert run(single, "-o", out, "--mask", "none") == 0
    (out / "vase-notes").mkdir()
    (out / "vase-09").mkdir()
    assert "earlier" not in capsys.readouterr().err
    assert run(*command, "100") == 0
    said = f"warning: {folder}: vase-03 in {out}: views of an earlier run, which this"
    assert said in capsys.readouterr().err
    assert (out / "vase-03" / "normals.json").is_file()


def test_what_cannot_be_told_apart_is_named(folder, tmp_path, network_calls, capsys):
    out = tmp_path / "out"
    assert run(folder, "-o", out, "--pause", "-1") == 2
    assert "--pause: expected seconds" in capsys.readouterr().err
    Image.fromarray(np.full((40, 48), 255, np.uint8)).save(folder / "mask.png")
    assert run(folder, "-o", out, "--pause", "30") == 2
    assert "mask.png: expected no mask with --pause" in capsys.readouterr().err
    (folder / "mask.png").unlink()
    photograph(folder / "L_9.jpg", None)
    with pytest.raises(InputError, match=r"L_9\.jpg: .* none in 1 of 9 photographs"):
        views_by_time(sorted(folder.iterdir()), 30)
    assert run(folder, "-o", out, "--pause", "30") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not out.exists() or not list(out.iterdir())
