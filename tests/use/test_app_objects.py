"""The application's objects: folders on disk, and their names."""

import errno
import os
import re
import shutil
import time

import pytest
from small_disk import files_below, fill_after

from unips_jax.app.objects import Photograph, clean, opened, unused
from unips_jax.errors import InputError
from unips_jax.io.door import NotWritten


@pytest.mark.parametrize(
    ("name", "cleaned"),
    [
        ("../../a b/../x y.png", "x_y.png"),
        ("..\\..\\y.png", "y.png"),
        (".hidden.png", "hidden.png"),
        ("ä" * 300 + ".jpeg", "ä" * 47 + ".jpeg"),
        ("𝔘" * 300 + ".jpeg", None),
        ("photo", "photo"),
        ("Bu\u0308ste.png", "Büste.png"),
        ("nul.png", "nul_.png"),
        ("COM1", "COM_1"),
        ("console.png", "console.png"),
        ("\U0001f4f7.jpg", "photograph.jpg"),
        ("!.png", "photograph.png"),
    ],
)
def test_names_are_cleaned(name, cleaned):
    found = clean(name)
    assert cleaned is None or found == cleaned
    assert len(found.encode()) <= 100 and "/" not in found


def test_equal_names_get_numbers():
    assert unused("a.png", set()) == "a.png"
    assert unused("a.png", {"A.png", "a-2.png"}) == "a-3.png"


def test_objects_are_what_is_on_disk(tmp_path):
    with opened(tmp_path, days=30) as objects:
        item = objects.begin()
        (item.inbox / "a.png").write_bytes(b"1")
        item.photographs.append(Photograph("a.png", "ä.png", 1, "used"))
        item.drawn.write_bytes(b"mask")
        item.state, item.mask, item.options = "running", "drawn", {"mesh": False}
        item.save()
        damaged = objects.begin()
        (damaged.folder / "object.json").write_text("{")
        with pytest.raises(InputError, match="another `unips app` uses this folder"):
            with opened(tmp_path, days=30):
                pass
    assert (tmp_path / ".app").stat().st_mode & 0o77 == 0
    with opened(tmp_path, days=30) as objects:
        (found,) = objects.all()
        assert found.state == "interrupted"  # a server ended during its estimate
        assert found.photographs == item.photographs and found.mask == "drawn"
        copy = objects.again(found)
        assert copy.id != found.id and copy.state == "draft"
        assert copy.options == {"mesh": False} and copy.mask == "drawn"
        assert (copy.inbox / "a.png").read_bytes() == b"1"
        assert copy.drawn.read_bytes() == b"mask"
        copy.drawn.write_bytes(b"other")
        assert found.drawn.read_bytes() == b"mask"


def test_a_copied_folder_is_no_object(tmp_path):
    with opened(tmp_path, days=30) as objects:
        item = objects.begin()
        shutil.copytree(item.folder, objects.place / f"{item.id} (copy)")
    with opened(tmp_path, days=30) as objects:
        (found,) = objects.all()
        assert found.folder == item.folder


def test_a_file_that_never_came_is_forgotten(tmp_path):
    with opened(tmp_path, days=30) as objects:
        item = objects.begin()
        item.photographs.append(Photograph("a.png", "a.png", 1, "used"))
        item.photographs.append(Photograph("b.png", "b.png", 9, "receiving"))
        item.save()
    with opened(tmp_path, days=30) as objects:
        (found,) = objects.all()
        assert [photo.file for photo in found.photographs] == ["a.png"]


def test_targets_are_new_folders(tmp_path):
    with opened(tmp_path, days=30) as objects:
        first = objects.target_for("my cat/..")
        assert re.fullmatch(r"object-\d{4}-\d\d-\d\d", first.name) or (
            first.parent == tmp_path
        )
        first.mkdir()
        second = objects.target_for("my cat/..")
        assert second.name == f"{first.name}-2"
        objects.begin().target = str(second)  # what waits has no folder yet
        assert objects.target_for("my cat/..").name == f"{first.name}-3"


def test_old_drafts_and_removed_objects_are_cleared(tmp_path):
    with opened(tmp_path, days=30) as objects:
        kept, old, removed, done = (objects.begin() for _ in range(4))
        past = time.time() - 40 * 86_400
        removed.removed, done.state = past, "done"
        removed.save()
        done.save()
        for item in (old, done):
            os.utime(item.folder / "object.json", (past, past))
        newer, half = objects.begin(), objects.place / "half"
        (newer.folder / "object.json").write_text('{"a field of another version": 1}')
        half.mkdir()
        for folder in (newer.folder, half):
            os.utime(folder, (past, past))
    with opened(tmp_path, days=30) as objects:
        assert {item.id for item in objects.all()} == {kept.id, done.id}
        assert not old.folder.exists() and not removed.folder.exists()
        assert newer.inbox.is_dir() and not half.exists()


@pytest.mark.parametrize("count", [0, 1, 3])
def test_on_a_full_disk_an_object_is_whole_or_none(count, tmp_path, monkeypatch):
    photographs = {f"{index}.png": b"photograph" for index in range(4)}
    with opened(tmp_path, days=30) as objects:
        earlier = objects.begin("pot", photographs)
        earlier.drawn.write_bytes(b"mask")
        (earlier.pictures / "small.jpg").write_bytes(b"thumbnail")
        there = files_below(tmp_path)
        with monkeypatch.context() as patch:
            fill_after(patch, count)
            for make in (
                lambda: objects.begin("pot", photographs),
                lambda: objects.again(earlier),
            ):
                with pytest.raises(NotWritten, match="No space left") as caught:
                    make()
                assert caught.value.errno == errno.ENOSPC
        assert files_below(tmp_path) == there and objects.all() == [earlier]
        copy = objects.again(earlier)
        assert copy.photographs == earlier.photographs
        assert len(files_below(copy.folder)) == 9
    with opened(tmp_path, days=30) as objects:
        assert {item.id for item in objects.all()} == {earlier.id, copy.id}
