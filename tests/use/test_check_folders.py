"""`unips check` goes on, whatever is wrong with one photograph or one folder."""

import json

import cv2
import numpy as np
import pytest
import tifffile
from plain_objects import photographs

from unips_jax.cli import main as cli


def kinds_of(report):
    return {finding["kind"]: finding for finding in report["findings"]}


def looked_at(capsys, *arguments, status=0):
    assert cli.main(["check", *map(str, arguments), "--json"]) == status
    out, err = capsys.readouterr()
    return json.loads(out), err


@pytest.fixture
def folder(tmp_path):
    """Six photographs, of which one is nearly black."""
    folder = tmp_path / "pot"
    folder.mkdir()
    images, _ = photographs(8, background=0.02, count=6)
    images[4] //= 9
    for index, image in enumerate(images):
        tifffile.imwrite(folder / f"{index}.tif", image, compression="zlib")
    return folder


def cut_short(folder):
    image = tifffile.imread(folder / "2.tif")
    (folder / "2.tif").unlink()
    data = cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()
    (folder / "2.jpg").write_bytes(data[: len(data) // 2])
    return "2.jpg"


def damaged(folder):
    data = bytearray((folder / "2.tif").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 400] = bytes(400)
    (folder / "2.tif").write_bytes(data)
    return "2.tif"


def blackened(folder):
    image = np.zeros_like(tifffile.imread(folder / "0.tif"))
    tifffile.imwrite(folder / "0.tif", image)
    return "0.tif"


@pytest.mark.parametrize("harm", [cut_short, damaged, blackened])
def test_one_photograph_that_cannot_be_used_hides_nothing(folder, capsys, harm):
    name = harm(folder)
    (report,), err = looked_at(capsys, folder)
    kinds = kinds_of(report)
    assert kinds.keys() == {"unusable", "underexposed"} and err == ""
    assert kinds["unusable"]["files"] == [name]
    assert kinds["unusable"]["text"].startswith(f"{folder / name}: expected ")
    assert kinds["underexposed"]["files"] == ["4.tif"]
    assert report["mask_suggested"]


def test_where_no_photograph_can_be_used_each_is_named(folder, capsys):
    for path in folder.iterdir():
        tifffile.imwrite(path, np.zeros((60, 80, 3), np.uint8))
    (report,), _ = looked_at(capsys, folder)
    found = [finding["files"] for finding in report["findings"]]
    assert found == [[f"{index}.tif"] for index in range(6)]
    assert "width" not in report


def test_findings_name_the_file_that_was_given(folder, capsys):
    pages = [tifffile.imread(path) for path in sorted(folder.iterdir())]
    pages[3] = pages[3][:100]
    stack = folder.parent / "stack.tif"
    with tifffile.TiffWriter(stack) as file:
        for page in pages[:2] + [0 * pages[2]] + pages[3:]:
            file.write(page, photometric="rgb")
    (report,), _ = looked_at(capsys, stack)
    kinds = kinds_of(report)
    assert kinds["unusable"]["text"].startswith(f"{stack} page_003: expected light")
    assert kinds.keys() == {"unusable", "mixed sizes", "underexposed"}
    assert "unips-" not in json.dumps(report)


def test_a_folder_that_is_none_hides_no_other(folder, capsys):
    other = folder.with_name("other")
    folder.with_name("empty").mkdir()
    other.mkdir()
    for path in folder.iterdir():
        (other / path.name).write_bytes(path.read_bytes())
    names = [folder, folder.with_name("missing"), folder.with_name("empty"), other]
    reports, err = looked_at(capsys, *names, status=2)
    assert [report["folder"] for report in reports] == [str(folder), str(other)]
    lines = err.splitlines()
    assert len(lines) == 3 and f"{names[1]}: expected a folder of phot" in lines[0]
    assert lines[2].startswith("error: 2 of 4 could not be looked at: ")
    assert cli.main(["check", *map(str, names)]) == 2
    assert f"{other}: 6 photographs" in capsys.readouterr().out
    assert cli.main(["check", str(names[1])]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("command", ["check", "estimate"])
@pytest.mark.parametrize("option", ["--include", "--exclude"])
def test_a_folder_is_no_pattern(folder, tmp_path, capsys, command, option):
    output = ["-o", str(tmp_path / "out")] if command == "estimate" else []
    arguments = [str(folder), option, "x*", str(folder), *output]
    assert cli.main([command, *arguments]) == 2
    said = f"error: {option} {folder}: expected a pattern of file names, got a folder;"
    assert capsys.readouterr().err.startswith(said)


@pytest.mark.parametrize("command", ["check", "estimate"])
@pytest.mark.parametrize("option", ["--include", "--exclude"])
def test_a_path_is_no_pattern(folder, tmp_path, capsys, command, option):
    output = ["-o", str(tmp_path / "out")] if command == "estimate" else []
    pattern = str(folder / "4.tif")
    assert cli.main([command, str(folder), option, "x*", pattern, *output]) == 2
    out, err = capsys.readouterr()
    assert err == (
        f"error: {option} {pattern}: expected a pattern of file names, got a path; "
        "leave out its folder\n"
    )
    assert out == ""


def test_a_pattern_that_fits_nothing_is_said(folder, capsys):
    assert cli.main(["check", str(folder), "--exclude", "4.tiff", "5.tif"]) == 0
    out = capsys.readouterr().out
    assert "4.tiff (by --exclude, which fits no file)" in out
    assert "5.tif (by --exclude)" in out


@pytest.fixture
def normal_map(tmp_path):
    """One on a background of a colour that is no normal's."""
    y, x = np.mgrid[-1:1:80j, -1:1:80j] / 0.7
    z = np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))
    values = np.dstack([x, -y, z]) * 127.5 + 127.5
    values[x**2 + y**2 > 1] = 255, 255, 255
    path = tmp_path / "map.png"
    cv2.imwrite(str(path), np.rint(values[..., ::-1]).clip(0, 255).astype(np.uint8))
    return path


def test_options_of_photographs_are_none_of_a_normal_map(normal_map, capsys):
    path = str(normal_map)
    given = ["--mask", "none", "--include", "a*", "--max-pixels", "9999"]
    assert cli.main(["check", path, *given]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err == (
        f"error: {path}: expected options of a normal map, got --mask, --include, "
        "--max-pixels, of photographs; leave them out, or name a folder\n"
    )
    assert cli.main(["check", path, "--normal-map", "opengl"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "--as-stored takes all" in out
    assert "named here are of `unips surface` and `unips relight`" in out
