"""Photographs of a folder, prepared and looked at as an estimate does."""

import dataclasses

import cv2
import numpy as np
import pytest
from picture_files import png_with_orientation
from plain_objects import HARD, photographs

from unips_jax.capture import prepare
from unips_jax.capture.motion import Motion
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.reading import chosen_photographs, read_and_look
from unips_jax.io.photographs import Capture
from unips_jax.io.record import HashingReader

ROOM = 3  # levels


def looked_at(folder, **options):
    how = FolderOptions(**options)
    selection = chosen_photographs(folder, how)
    return read_and_look(selection, how, HashingReader(), verbose=False)


def write(folder, images, mask=None):
    folder.mkdir()
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / f"{index}.png"), image[..., ::-1])
    if mask is not None:
        cv2.imwrite(str(folder / "mask.png"), 255 * mask.astype(np.uint8))
    return folder


def test_what_is_transparent_is_left_out_however_small(tmp_path):
    images, mask = photographs(4)
    row, column = np.argwhere(mask).mean(axis=0).astype(int)
    mask[row : row + 3, column : column + 3] = False
    alpha = np.full(mask.shape, 255, np.uint8)
    alpha[row : row + 3, column : column + 3] = 0
    (tmp_path / "pot").mkdir()
    for index, image in enumerate(images):
        layers = np.dstack([image[..., ::-1], alpha])
        cv2.imwrite(str(tmp_path / "pot" / f"{index}.png"), layers)
    capture = looked_at(tmp_path / "pot").capture
    assert capture.mask_rule and not capture.mask[alpha == 0].any()
    assert (capture.mask & mask).sum() > 0.97 * mask.sum()


def test_highlights_alone_are_not_taken_without_a_word(tmp_path):
    folder = write(tmp_path / "pot", photographs(3, **HARD["mirror on black"])[0])
    looked = looked_at(folder)
    assert looked.capture.mask.mean() < 0.5
    said = "no object found: all that is not black is taken as one surface"
    assert looked.facts["findings"][0]["text"].startswith(said)


@pytest.mark.parametrize(
    ("scale", "srgb", "kind"),
    [
        (2.5, True, "saturated"),
        (0.1, True, "underexposed"),
        (1.0, False, "probably linear"),
        (1.0, True, None),
    ],
)
def test_a_dark_frame_hides_neither_exposure_nor_encoding(tmp_path, scale, srgb, kind):
    images, mask = photographs(3, srgb=srgb)
    room = np.full(images.shape[1:], ROOM, np.uint8)
    images = np.clip(images * scale + ROOM, 0, 255).astype(np.uint8)
    folder = write(tmp_path / "pot", [*images, room], mask)
    looked = looked_at(folder, dark="8.png")
    assert looked.capture.images.dtype == np.uint16
    found = [finding["kind"] for finding in looked.facts["findings"]]
    assert found == ([kind] if kind else [])


def test_where_nothing_would_be_left_nothing_is_moved_back(tmp_path, monkeypatch):
    images, _ = photographs(3, background=0.1)
    mask = np.zeros(images.shape[1:3], bool)
    mask[:, :4] = True
    folder = write(tmp_path / "pot", images, mask)
    offsets = np.zeros((8, 2))
    offsets[2] = -20, 0
    motion = Motion(offsets, np.ones(8), 0, 1.5)
    monkeypatch.setattr(prepare, "find_motion", lambda *_: motion)
    looked = looked_at(folder, register=True)
    assert looked.facts["moved_back"] == {}
    (moved,) = [f for f in looked.facts["findings"] if f["kind"] == "moved"]
    assert moved["files"] == ["2.png"]
    wide = dataclasses.replace(motion, offsets=offsets / 8)
    monkeypatch.setattr(prepare, "find_motion", lambda *_: wide)
    looked = looked_at(folder, register=True)
    assert [*looked.facts["moved_back"]] == ["2.png"]
    assert "moved" not in [f["kind"] for f in looked.facts["findings"]]


@pytest.mark.parametrize("tag", [1, 6])
def test_the_record_says_how_exif_turned_photographs(tmp_path, tag):
    folder = write(tmp_path / "pot", photographs(3, count=2)[0])
    for path in folder.iterdir():
        path.write_bytes(png_with_orientation(path.read_bytes(), tag))
    assert looked_at(folder, mask="none").facts["orientation"] == tag


def test_how_far_a_photograph_moved_is_measured_at_the_middle(monkeypatch):
    """A turn about it moves nothing there."""
    images, whole = np.zeros((2, 40, 60, 3), np.uint8), np.ones((40, 60), bool)
    turn, middle = np.array([[0.8, -0.6], [0.6, 0.8]]), np.array([29.5, 19.5])
    shift = middle - turn @ middle + (3, -2)
    maps = np.stack([np.eye(2, 3), np.column_stack([turn, shift])])
    motion = Motion(np.zeros((2, 2)), np.ones(2), 0, 1.5)
    monkeypatch.setattr(prepare, "find_motion", lambda *_: motion)
    monkeypatch.setattr(prepare, "register", lambda *_: (images, whole, maps))
    _, found = prepare.in_place(Capture(images, whole, "srgb"))
    np.testing.assert_allclose(found.offsets, [[0, 0], [3, -2]], atol=1e-9)
