"""Sets of photographs on a bad day: lists of others, EXIF's turns, odd companions."""

import cv2
import numpy as np
import pytest
from picture_files import with_orientation
from plain_objects import hemisphere

from unips_jax import estimate_lights
from unips_jax.capture import registration, unpack
from unips_jax.capture.advice import look_at_values
from unips_jax.cli import estimate as command
from unips_jax.errors import InputError
from unips_jax.estimation import folders
from unips_jax.estimation.options import FolderOptions
from unips_jax.io import naming
from unips_jax.io.door import NotWritten
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select
from unips_jax.lighting.harmonics import harmonics
from unips_jax.lighting.known import read_known_lights
from unips_jax.lighting.light_files import write_lights
from unips_jax.lighting.rig import read_rig, turned_to

NORMALS, MASK, _ = hemisphere(40)
TURNS = {1: [1, 0], 3: [-1, 0], 6: [0, -1], 8: [0, 1]}  # where x, as stored, goes


def touched(folder, names):
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


def numbered(first, last):
    return [f"IMG_{i:04}.jpg" for i in range(first, last + 1)]


def test_a_list_of_other_photographs_takes_none_away(tmp_path):
    """A rig's, whose camera went on counting."""
    folder = touched(tmp_path / "coin", numbered(11, 26))
    lines = [f"{name} 0 0 1" for name in numbered(1, 16)]
    (folder / "dome.lp").write_text("\n".join(lines))
    found = select(folder)
    assert list(found.names) == numbered(11, 26)
    assert found.left_out == {"a list of 16 lights, 6 of photographs here": ["dome.lp"]}
    with pytest.raises(InputError, match="got 6 of 16 by name"):
        read_known_lights([str(folder / "dome.lp")], found.names)
    with pytest.raises(
        InputError, match="got 16, 6 of them by name, none for IMG_0017"
    ):
        read_rig(folder / "dome.lp", found.names)


@pytest.mark.parametrize("kept", [range(3, 26), range(11, 27)])
def test_a_list_of_these_photographs_still_chooses(tmp_path, kept):
    """Where some are gone, and previews lie beside them."""
    folder = touched(tmp_path / "coin", [f"IMG_{i:04}.jpg" for i in kept])
    lines = [f"IMG_{i:04}.jpg 0 0 1" for i in range(min(kept) - 2, max(kept) + 1)]
    (folder / "dome.lp").write_text("\n".join(lines))
    touched(folder, ["preview.jpg"])
    found = select(folder)
    assert "preview.jpg" not in found.names and len(found.names) == len(kept)


def test_one_picture_beside_a_series_is_not_the_photographs(tmp_path):
    series = [f"metal_bowl_{i}.png" for i in range(8)]
    folder = touched(tmp_path / "a", [*series, "dark.png"])
    found = select(folder)
    assert list(found.names) == series
    assert found.left_out == {"beside the series of metal_bowl_0.png": ["dark.png"]}
    pair = touched(tmp_path / "b", [*series, "a_1.png", "a_2.png", "normal.png"])
    assert select(pair).names == ("a_1.png", "a_2.png")
    maps = touched(tmp_path / "c", ["a.png", *(f"normal_{i}.png" for i in range(6))])
    assert select(maps).names == ("a.png",)


def test_heic_pictures_come_first_where_they_are_read(tmp_path, monkeypatch):
    names = [f"IMG_{i}{suffix}" for i in range(4) for suffix in (".HEIC", ".jpg")]
    folder = touched(tmp_path / "a", names)
    for there, expected in ((True, ".HEIC"), (False, ".jpg")):
        spec = object() if there else None
        monkeypatch.setattr(naming.importlib.util, "find_spec", lambda _, s=spec: s)
        assert {path.suffix for path in select(folder).files} == {expected}


@pytest.mark.parametrize("before", TURNS)
@pytest.mark.parametrize("now", TURNS)
def test_a_rigs_lights_are_turned_as_the_photographs_are(tmp_path, before, now):
    """Stored alike; the camera looked down, and had two ideas of which way is up."""
    stored = np.array(
        [[0.5, 0.2, 0.8], [-0.6, 0.1, 0.7], [0, 0.7, 0.6], [0.1, -0.5, 1]]
    )
    stored /= np.linalg.norm(stored, axis=1, keepdims=True)

    def shown(vectors, orientation):
        x, y = TURNS[orientation]
        return vectors @ np.array([[x, y, 0], [-y, x, 0], [0, 0, 1.0]])

    directions = shown(stored, before)
    images = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, directions), 0)
    images = np.repeat(images[..., None], 3, -1).astype(np.float32)
    lights = estimate_lights(images, NORMALS, MASK, guesses=directions)
    names = [f"{i}.png" for i in range(4)]
    write_lights(tmp_path, names, lights, orientation=before)
    found = turned_to(read_rig(tmp_path, names), tmp_path, now)
    expected = shown(stored, now)
    np.testing.assert_allclose(found.directions, expected, atol=2e-6)
    # All light, at any direction: that of the direction before.
    looked = np.random.default_rng(1).normal(size=(5, 3))
    looked /= np.linalg.norm(looked, axis=1, keepdims=True)
    for index in range(4):
        light = harmonics(shown(looked, now)) @ found.harmonics[index]
        known = harmonics(shown(looked, before)) @ lights.harmonics[index]
        np.testing.assert_allclose(light, known, atol=2e-5)


def test_turns_are_those_of_pixels():
    """What `TURNS` says of directions is what EXIF does to pictures."""
    from unips_jax.io.images import turned

    for orientation, (x, y) in TURNS.items():
        picture = np.zeros((9, 9))
        picture[4, 8] = 1  # to the right
        row, column = np.argwhere(turned(picture, orientation))[0]
        assert ((column - 4) / 4, (4 - row) / 4) == (x, y)


def test_a_list_for_photographs_that_exif_turns_is_remarked():
    for given in (
        {"known_lights": ("dome.lp",)},
        {"lights_from": folders.Path("dome.lp"), "base_color": True},
    ):
        (line,) = folders._of_lists(FolderOptions(**given), 6)
        assert line.startswith("directions of dome.lp are taken as in the photographs")
        assert not folders._of_lists(FolderOptions(**given), 1)
    by_hand = FolderOptions(known_lights=("1: upper left",))
    assert not folders._of_lists(by_hand, 6)


def test_photographs_that_are_turned_say_which_the_mask_fits(tmp_path):
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (60, 80, 3), np.uint8), (0, 0), 3)
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), cv2.convertScaleAbs(image, alpha=1 + i))
    turned = tmp_path / "1.jpg"
    turned.write_bytes(with_orientation(turned.read_bytes(), 3))
    assert "the mask" not in read_capture(select(tmp_path)).notes[0]
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((60, 80), 255, np.uint8))
    (note,) = read_capture(select(tmp_path)).notes
    assert note.endswith("fit; the mask must be one of 0.jpg as it is shown")


@pytest.mark.parametrize(
    ("dtype", "top", "dark"),
    [
        (np.uint8, 20, True),
        (np.uint8, 60, False),
        (np.uint16, 300, True),
        (np.uint16, 2000, False),
    ],
)
def test_photographs_of_16_bits_may_be_too_dark_too(dtype, top, dark):
    rng = np.random.default_rng(0)
    images = (rng.random((6, 50, 50, 3)) * top).astype(dtype)
    found = look_at_values(images, np.ones((50, 50), bool), list("abcdef"))
    assert any(f.kind == "underexposed" for f in found) == dark


def test_a_full_temporary_folder_is_named(tmp_path, monkeypatch):
    def full(path, folder, pixels):
        raise NotWritten(
            folder / "page_001.tif", OSError(28, "No space left on device")
        )

    monkeypatch.setattr(unpack, "_unpack_pages", full)
    path = tmp_path / "stack.tif"
    with pytest.raises(InputError) as caught:
        with unpack.unpacked(path, frames=3, max_pixels=1000):
            pass
    text = str(caught.value)
    assert text.startswith(f"{unpack.tempfile.gettempdir()}: cannot hold what {path}")
    assert "No space left on device" in text and "TMPDIR" in text


def test_a_photograph_without_content_is_not_moved():
    places = np.array([[x, y] for x in (0, 9, 18) for y in (0, 9, 18)], float)
    shifts = np.random.default_rng(0).normal(size=(9, 2))
    found = registration._similarity(places, shifts, np.full(9, -1e-8))
    np.testing.assert_allclose(found, np.eye(2, 3), atol=1e-6)


def test_a_folder_without_times_does_not_keep_the_others_from_views(
    tmp_path, monkeypatch, capsys
):
    done = []
    monkeypatch.setattr(command, "start_jax", lambda: None)
    monkeypatch.setattr(command, "_network", lambda options: None)
    monkeypatch.setattr(
        command, "estimate_folder", lambda *args, **options: done.append(args[1].name)
    )
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        for i in range(2):
            path = tmp_path / name / f"{i}.tif"
            cv2.imwrite(str(path), np.full((8, 9, 3), 90, np.uint8))

    def by_time(files, pause, *, max_pixels):
        if files[0].parent.name == "b":
            raise InputError(f"{files[0]}: expected a time, got none")
        return [files]

    monkeypatch.setattr(command, "views_by_time", by_time)
    given = [str(tmp_path / name) for name in "abc"]
    out = ["-o", str(tmp_path / "out"), "--pause", "30"]
    assert command.main([*given, *out]) == 2
    assert done == ["a-00", "c-00"]
    error = capsys.readouterr().err
    assert "expected a time" in error and "1 of 3 folders gave no normals" in error
    assert command.main([given[1], *out]) == 2
    assert capsys.readouterr().err.count("\n") == 1
