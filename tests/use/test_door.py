"""The door through which files are written."""

import contextlib
import json
import os
import sys

import numpy as np
import pytest
from small_disk import small_disk

from unips_jax.io import door
from unips_jax.io.results import clear_leftovers, link_or_copy, workspace


def test_lines_are_added_whole_or_not_at_all(tmp_path):
    line = "x" * 999
    with small_disk(tmp_path / "disk", 4096) as place:
        path = place / "lines"
        for _ in range(4):
            door.append_line(path, line)
        with pytest.raises(door.NotWritten, match="lines: cannot be written: No space"):
            door.append_line(path, line)
        assert path.read_text() == 4 * f"{line}\n"
    door.append_line(tmp_path / "new", "a")
    door.append_line(tmp_path / "new", "b")
    assert (tmp_path / "new").read_text() == "a\nb\n"


def test_the_outermost_place_is_named(tmp_path):
    with (
        pytest.raises(door.NotWritten) as caught,
        door.writing(tmp_path / "thing"),
        door.new_file(tmp_path / "part"),
    ):
        raise OSError(28, "No space left on device", "inside")
    expected = f"{tmp_path}/thing: cannot be written: No space left on device; free"
    assert str(caught.value).startswith(expected) and caught.value.errno == 28
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("by_name", [False, True])
def test_what_fails_leaves_what_was_there(by_name, tmp_path):
    path = tmp_path / "file.npz"
    door.write_whole(path, b"old")
    with pytest.raises(ZeroDivisionError):
        if by_name:
            with door.new_path(path) as part:
                assert part.suffix == ".npz" and part.parent == tmp_path
                part.write_bytes(b"half")
                raise ZeroDivisionError
        with door.new_file(path) as file:
            np.savez(file, a=np.zeros(9))
            raise ZeroDivisionError
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1


def test_records_hold_names_that_are_not_unicode(tmp_path):
    door.write_json(tmp_path / "a.json", {"name": "caf\udce9 é"}, indent=1)
    data = (tmp_path / "a.json").read_bytes()
    assert json.loads(data)["name"] == "caf\udce9 é" and "é".encode() in data


def test_devices_and_pipes_are_never_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(door.NotWritten, match="a device or a pipe, not a file"):
        door.write_whole(pipe, b"data")
    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]


def test_what_was_killed_long_ago_is_removed(tmp_path):
    with pytest.raises(ZeroDivisionError), door.new_path(tmp_path / "a.png") as part:
        name = part.name
        raise ZeroDivisionError
    old, new = tmp_path / name, tmp_path / name.replace(".tmp", "9.tmp")
    theirs = [
        tmp_path / ".a.tmp",
        tmp_path / "0123456789ab.1-1.tmp",
        tmp_path / "a.png",
    ]
    for path in (old, new, *theirs):
        path.write_bytes(b"")
        if path != new:
            os.utime(path, (0, 0))
    clear_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted([new, *theirs])
    clear_leftovers(tmp_path / "nowhere")
    door.clear_parts(tmp_path / "nowhere")


@pytest.mark.parametrize("code, there", [(32, b"new"), (5, b"new"), (1314, b"old")])
def test_what_windows_finds_in_use_is_tried_again(code, there, tmp_path, monkeypatch):
    path = tmp_path / "a"
    door.write_whole(path, b"old")
    replace, tries = type(path).replace, []

    def in_use_at_first(self, target):
        tries.append(target)
        if len(tries) < 3:
            error = PermissionError(13, "used by another process")
            error.winerror = code
            raise error
        return replace(self, target)

    monkeypatch.setattr(type(path), "replace", in_use_at_first)
    with (
        contextlib.nullcontext() if there == b"new" else pytest.raises(door.NotWritten)
    ):
        door.write_whole(path, b"new")
    assert path.read_bytes() == there and list(tmp_path.iterdir()) == [path]
    monkeypatch.setattr(door, "_PATIENCE_S", 0)
    tries.clear()
    with pytest.raises(door.NotWritten, match="used by another process"):
        door.write_whole(path, b"newer")
    assert path.read_bytes() == there


def test_under_windows_results_are_not_made_private(tmp_path, monkeypatch):
    modes, mkdir = [], type(tmp_path).mkdir

    def noted(self, mode=0o777, **how):
        modes.extend([mode] if self.name.startswith(".unips-") else [])
        mkdir(self, mode, **how)

    monkeypatch.setattr(type(tmp_path), "mkdir", noted)
    for system in ("linux", "win32"):
        monkeypatch.setattr(sys, "platform", system)
        with workspace(tmp_path):
            pass
    assert modes == [0o700, 0o777]


def test_files_are_copied_where_links_have_no_such_option(tmp_path, monkeypatch):
    def no_such_option(*_, **__):
        raise NotImplementedError("link: follow_symlinks unavailable on this platform")

    (tmp_path / "a").write_bytes(b"data")
    monkeypatch.setattr(os, "link", no_such_option)
    link_or_copy(str(tmp_path / "a"), str(tmp_path / "b"))
    assert (tmp_path / "b").read_bytes() == b"data"
