"""Folders of results: whole or absent, whatever happens while they are written."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest

from unips_jax.errors import InputError
from unips_jax.io.results import (
    appearing_at_once,
    check_target,
    clear_leftovers,
    read_record,
    write_record,
)

NAMES = ("normals.npy", "normals.png", "sheet.png")

WRITER = """
import sys
from pathlib import Path
from unips_jax.io.results import appearing_at_once, write_record
for version in range(int(sys.argv[2]), 10**9):
    with appearing_at_once(Path(sys.argv[1])) as place:
        for name in ("normals.npy", "normals.png", "sheet.png"):
            (place / name).write_text(f"{version}" * 1000)
        write_record(place, {"version": version})
    print(version, flush=True)
"""

# Dies before the rename of that number.
DYING = """
import os, signal, sys
from pathlib import Path
rename, left = Path.rename, [int(sys.argv.pop())]
def dying(self, target):
    left[0] -= 1
    if left[0] < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return rename(self, target)
Path.rename = dying
"""


def write(target, version):
    with appearing_at_once(target) as place:
        for name in NAMES:
            (place / name).write_text(f"{version}" * 1000)
        write_record(place, {"version": version})


def version_of(target):
    """The version that all files are of."""
    record = read_record(target)
    assert record is not None, "the files are not those of the record"
    for name in NAMES:
        assert (target / name).read_text() == f"{record['version']}" * 1000
    return record["version"]


def test_killed_at_any_moment_a_folder_is_of_one_run(tmp_path):
    target = tmp_path / "out" / "pot"
    write(target, 0)
    (target / "notes.txt").write_text("the user's")
    moments = random.Random(7)
    version = 0
    for _ in range(10):
        start = str(version + 1)
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(target), start], stdout=subprocess.PIPE
        ) as writer:
            done = [int(writer.stdout.readline())]  # it is at work
            time.sleep(moments.uniform(0, 0.02))
            writer.kill()
            done += map(int, writer.stdout.read().split())
        if target.exists():  # as another program would see it
            version_of(target)
        clear_leftovers(target.parent)
        found = version_of(target)
        assert found in (done[-1], done[-1] + 1) and found > version
        version = found
        assert [p.name for p in target.parent.iterdir()] == ["pot"]
        assert (target / "notes.txt").read_text() == "the user's"


@pytest.mark.parametrize(("renames", "expected"), [(0, 1), (1, 1), (2, 1), (3, 2)])
def test_killed_between_renames_the_earlier_results_come_back(
    tmp_path, renames, expected
):
    target = tmp_path / "pot"
    write(target, 1)
    program = [sys.executable, "-c", DYING + WRITER, str(target), "2", str(renames)]
    ended = subprocess.run(program, capture_output=True)
    assert ended.returncode == -signal.SIGKILL
    assert target.exists() == (renames != 2)
    write(tmp_path / "other", 5)  # any later run puts things right
    assert version_of(target) == expected
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other", "pot"]


def test_what_is_being_written_is_no_leftover(tmp_path):
    with appearing_at_once(tmp_path / "pot") as place:
        clear_leftovers(tmp_path)
        write(tmp_path / "other", 1)
        (place / "normals.png").write_text("still here")
    assert (tmp_path / "pot" / "normals.png").read_text() == "still here"


def test_the_users_files_are_kept(tmp_path):
    target = tmp_path / "pot"
    write(target, 1)
    (target / "mine" / "normals.png").parent.mkdir()
    (target / "mine" / "normals.png").write_text("not ours")
    (target / "link").symlink_to("nowhere")
    with appearing_at_once(target) as place:
        (place / "normals.png").write_text("new")
        (place / "truth.png").write_text("new")
        write_record(place, {})
    write(target, 3)
    assert (target / "mine" / "normals.png").read_text() == "not ours"
    assert os.readlink(target / "link") == "nowhere"
    names = sorted(p.name for p in target.iterdir())
    assert names == sorted([*NAMES, "normals.json", "link", "mine"])


@pytest.mark.parametrize("mended", [False, True])
def test_a_mask_that_was_mended_is_kept(tmp_path, mended):
    target = tmp_path / "pot"
    with appearing_at_once(target) as place:
        (place / "mask.png").write_text("found")
        write_record(place, {})
    if mended:
        (target / "mask.png").write_text("mended")
    for step in (1, 2):
        write(target, step)
        assert (target / "mask.png").exists() == mended
    assert version_of(target) == 2
    if mended:
        assert (target / "mask.png").read_text() == "mended"


@pytest.mark.parametrize("notes", ["{}", '{"notes": []}'])
def test_a_page_with_notes_is_kept(tmp_path, notes):
    """Listed or not, unless there is a new one, which has them too."""
    target = tmp_path / "pot"
    page = f'<script type="application/json" id="notes">{notes}</script>'
    write(target, 1)
    (target / "view.html").write_text(page)
    write(target, 2)
    assert (target / "view.html").exists() == (notes != "{}")
    with appearing_at_once(target) as place:
        (place / "view.html").write_text("new")
        write_record(place, {})
    assert (target / "view.html").read_text() == "new"


def test_without_a_record_nothing_is_ours(tmp_path):
    """As where another program puts its normals beside photographs of ours."""
    (tmp_path / "pot").mkdir()
    (tmp_path / "pot" / "normals.npy").write_text("another program's")
    with appearing_at_once(tmp_path / "pot", ours=["*.png"]) as place:
        (place / "photograph.png").write_text("")
    assert (tmp_path / "pot" / "normals.npy").read_text() == "another program's"


def test_results_are_known_by_their_own_record(tmp_path):
    for name in ("mesh.ply", "depth.exr"):
        with appearing_at_once(tmp_path / "cup", record="surface.json") as place:
            (place / name).write_text("")
            (place / "surface.json").write_text(f'{{"files": ["{name}"]}}')
    check_target(tmp_path / "cup", tmp_path, record="surface.json")
    with pytest.raises(InputError, match="results .normals.json., got one with other"):
        check_target(tmp_path / "cup", tmp_path)
    names = sorted(p.name for p in (tmp_path / "cup").iterdir())
    assert names == ["depth.exr", "surface.json"]


def test_a_linked_folder_stays_linked(tmp_path):
    write(tmp_path / "real", 1)
    (tmp_path / "link").symlink_to("real")
    write(tmp_path / "link", 2)
    assert (tmp_path / "link").is_symlink() and version_of(tmp_path / "real") == 2


def test_a_full_disk_is_one_line_and_changes_nothing(tmp_path):
    target = tmp_path / "pot"
    write(target, 1)
    with (
        pytest.raises(InputError, match=r"pot: cannot be written: No space left"),
        appearing_at_once(target) as place,
    ):
        (place / "normals.png").write_text("x")
        raise OSError(28, "No space left on device", str(place / "normals.npy"))
    assert version_of(target) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["pot"]


def test_changed_results_are_not_taken_for_written_ones(tmp_path):
    write(tmp_path / "pot", 1)
    assert read_record(tmp_path / "pot") is not None
    assert read_record(tmp_path / "none") is None
    (tmp_path / "pot" / "sheet.png").write_text("painted over")
    assert read_record(tmp_path / "pot") is None
    (tmp_path / "pot" / "sheet.png").unlink()
    assert read_record(tmp_path / "pot") is None
    for text in ("", "[]", "{}", '{"files": 3}', '{"files": {"a": 1}}', "\0"):
        (tmp_path / "pot" / "normals.json").write_text(text)
        assert read_record(tmp_path / "pot") is None


def test_names_as_long_as_names_can_be(tmp_path):
    target = tmp_path / ("n" * 255)
    check_target(target, tmp_path / "in")
    write(target, 1)
    write(target, 2)
    assert version_of(target) == 2
    with pytest.raises(InputError, match=r"nn: cannot become .*: File name too long;"):
        check_target(tmp_path / ("n" * 256), tmp_path / "in")
    deep = tmp_path.joinpath(*["d" * 200] * 30)
    with pytest.raises(InputError, match=r"cannot become .*: File name too long;"):
        check_target(deep, tmp_path / "in")


def test_places_that_cannot_be_written(tmp_path, monkeypatch):
    source = tmp_path / "in"
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("file", "loop", "loop/out", "file/out/pot"):
        with pytest.raises(InputError, match=f"{name.split('/')[0]}"):
            check_target(tmp_path / name, source)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "loop"]
    (tmp_path / "sealed").mkdir()

    def access(path, mode):
        return "sealed" not in str(path)

    monkeypatch.setattr(os, "access", access)
    with pytest.raises(InputError, match="sealed is a file or may not be written to"):
        check_target(tmp_path / "sealed" / "out" / "pot", source)
