"""A frame without the lamp."""

import dataclasses
import struct

import cv2
import numpy as np
import OpenEXR
import pytest
from estimate_runs import run
from picture_files import png, save, with_orientation
from plain_objects import photographs

from unips_jax.capture.prepare import without_ambient
from unips_jax.errors import InputError
from unips_jax.io.color import Encoding, as_linear, srgb_encode
from unips_jax.io.images import read_image, read_image_file
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select


@pytest.fixture
def folder(tmp_path):
    """Photographs in a room that is not dark, without a tag; and the room's light."""
    folder = tmp_path / "pot"
    folder.mkdir()
    images, mask = photographs(3, noise=0.0)
    ambient = np.full((*mask.shape, 3), [0.02, 0.03, 0.05], np.float32)
    ambient[:, 100:] *= 2
    lit = as_linear(images, "srgb") * 0.8
    for name, light in (*enumerate(lit + ambient), ("room", ambient)):
        picture = np.rint(srgb_encode(light) * 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{name}.png"), picture[..., ::-1])
    cv2.imwrite(str(folder / "mask.png"), mask.astype(np.uint8) * 255)
    return folder, lit


def test_a_dark_frame_is_subtracted(folder, tmp_path, calls, capsys):
    folder, lit = folder
    assert run(folder, "-o", tmp_path / "out", "--dark", "room.png") == 0
    out, _ = capsys.readouterr()
    assert "room.png (by --dark)" in out
    (call,) = calls
    assert call["images"].dtype == np.uint16 and call["transfer"] == "srgb"
    read = as_linear(call["images"], "srgb")
    assert read.shape == lit.shape and np.abs(read - lit).max() < 0.01
    assert run(folder, "-o", tmp_path / "out", "--dark", folder / "room.png") == 0
    assert len(calls) == 1
    assert run(folder, "-o", tmp_path / "out", "--dark", folder / "none.png") == 2
    assert "expected a photograph without the lamp" in capsys.readouterr().err


def test_a_dark_frame_of_floats_that_encode_light(folder):
    folder, lit = folder
    capture = read_capture(select(folder, exclude=["room*"]))
    room = read_image_file(folder / "room.png")
    floats = dataclasses.replace(capture, images=capture.images / np.float32(255))
    dark = dataclasses.replace(room, pixels=room.pixels / np.float32(255))
    images = without_ambient(floats, dark, [*"01234567"]).images
    assert images.dtype == np.float32
    assert np.abs(as_linear(images, "srgb") - lit).max() < 0.01


def test_dark_frames_that_do_not_fit(folder):
    folder, _ = folder
    capture = read_capture(select(folder, exclude=["room*"]))
    names = [str(i) for i in range(8)]
    cv2.imwrite(str(folder / "small.png"), np.zeros((20, 30), np.uint8))
    cv2.imwrite(str(folder / "white.png"), np.full((180, 220), 255, np.uint8))
    for name, said in (("small", "expected a dark frame as"), ("white", "less light")):
        with pytest.raises(InputError, match=rf"{name}\.png: .*{said}"):
            without_ambient(capture, read_image_file(folder / f"{name}.png"), names)
    inside = np.where(capture.mask, 255, 0).astype(np.uint8)  # darker beside the object
    cv2.imwrite(str(folder / "inside.png"), inside)
    with pytest.raises(InputError, match="expected less light than in 0"):
        without_ambient(capture, read_image_file(folder / "inside.png"), names)


def test_a_dark_frame_turns_with_the_photographs(tmp_path):
    """A camera that looks down from a tripod does not know what is up."""
    light = np.full((60, 80, 3), 0.05, np.float32)
    light[:, 50:] = 0.3  # from one side
    lamp = np.zeros_like(light)
    lamp[20:40, 20:60] = [[[0.4], [0.3], [0.2]][i % 3] for i in range(40)]
    for name, linear, tag in (("a", light + lamp, 1), ("dark", light, 3)):
        pixels = np.rint(srgb_encode(linear) * 255).astype(np.uint8)
        path = save(tmp_path / f"{name}.jpg", pixels)
        path.write_bytes(with_orientation(path.read_bytes(), tag))
    capture = read_capture(select(tmp_path, exclude=["dark*"]))
    dark = read_image_file(tmp_path / "dark.jpg")
    (left,) = as_linear(without_ambient(capture, dark, ["a.jpg"]).images, "srgb")
    assert np.abs(left - lamp).max() < 0.02


def test_dark_frames_of_another_encoding_or_without_a_value(folder, tmp_path):
    folder, _ = folder
    capture = read_capture(select(folder, exclude=["room*"]))
    (tmp_path / "dark").mkdir()
    path = tmp_path / "dark" / "linear.png"
    room = read_image(folder / "room.png")
    path.write_bytes(png(room, 2, 8, {b"gAMA": struct.pack(">I", 100_000)}))
    with pytest.raises(InputError, match=r"linear\.png: expected srgb values as the"):
        without_ambient(capture, read_image_file(path), [*"012"])
    given = read_capture(select(folder, exclude=["room*"]), transfer="srgb")
    without_ambient(given, read_image_file(path), [*"012"])

    floats = dataclasses.replace(
        capture, images=as_linear(capture.images, "srgb"), transfer="linear"
    )
    floats = dataclasses.replace(floats, encoding=Encoding("linear", "floats"))
    ambient = np.full((*capture.mask.shape, 3), -0.01, np.float32)
    ambient[~capture.mask] = np.nan
    path = tmp_path / "dark" / "a.exr"
    with OpenEXR.File({}, {"RGB": ambient}) as file:
        file.write(str(path))
    result = without_ambient(floats, read_image_file(path), [*"012"])
    np.testing.assert_array_equal(result.images, floats.images)  # no light is added
    ambient[capture.mask] = np.nan
    with OpenEXR.File({}, {"RGB": ambient}) as file:
        file.write(str(path))
    with pytest.raises(InputError, match=r"a\.exr: expected finite values"):
        without_ambient(floats, read_image_file(path), [*"012"])
