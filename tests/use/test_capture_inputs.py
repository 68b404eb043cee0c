"""Photographs in one file, and a frame without the lamp."""

import json

import cv2
import numpy as np
import pytest
import tifffile
from estimate_runs import run
from plain_objects import lights, photographs

from unips_jax.capture.prepare import without_ambient
from unips_jax.capture.unpack import unpacked
from unips_jax.cli import main as cli
from unips_jax.errors import InputError
from unips_jax.io.color import as_linear, srgb_encode
from unips_jax.io.images import read_image, read_image_file
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select


def images_of(folder):
    return read_capture(select(folder)).images


@pytest.mark.parametrize("kind", ["pages", "grey", "imagej"])
def test_the_pages_of_a_tiff(tmp_path, kind, calls):  # noqa: F811
    images, _ = photographs(3, count=4)
    images = images if kind == "pages" else images[..., 0]
    path = tmp_path / "stack.tif"
    if kind == "imagej":
        tifffile.imwrite(path, images, imagej=True)
    else:
        with tifffile.TiffWriter(path) as tiff:
            for image in images:
                tiff.write(image, contiguous=False)
            tiff.write(images[0][::4, ::4], subfiletype=1)  # a preview
    with unpacked(path) as folder:
        expected = images if kind == "pages" else np.repeat(images[..., None], 3, -1)
        np.testing.assert_array_equal(images_of(folder), expected)
        assert folder.name == "stack"
    assert not folder.exists()
    if kind == "pages":
        assert run(path, "-o", tmp_path / "out", "--max-images", 3) == 0
        record = json.loads((tmp_path / "out/stack/normals.json").read_text())
        assert record["folder"] == str(path) and len(record["images"]) == 3
        assert set(record["images"]) < {f"page_00{i}.tif" for i in range(1, 5)}
        with pytest.raises(InputError, match="a TIFF of 4 pages; give the file itself"):
            read_image(path)


def test_files_that_hold_one_or_nothing(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((20, 30), np.uint8))
    (tmp_path / "b.tif").write_bytes(b"II*\0nothing")
    (tmp_path / "c.mp4").write_bytes(b"no video")
    for name, said in (
        ("a.tif", f"got one of 1; give its folder, {tmp_path}"),
        ("b.tif", "or a TIFF of several"),
        ("c.mp4", "expected a video of some seconds, got 0 frames"),
    ):
        with pytest.raises(InputError, match=said), unpacked(tmp_path / name):
            pass
    with pytest.raises(InputError, match="left out .a video: give the file itself"):
        (tmp_path / "a.tif").unlink()
        (tmp_path / "b.tif").unlink()
        select(tmp_path)


@pytest.fixture
def video(tmp_path):
    """A lamp that rests at the right, then goes around; some frames are shaken."""
    azimuths = [0.0] * 30 + list(np.arange(0, 360, 6.0))
    images, _ = photographs(
        5, directions=lights(0, np.array(azimuths)), second=(0.2, 0.2, 0.1)
    )
    path = tmp_path / "turn.avi"
    size = images.shape[2], images.shape[1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, size)
    for index, image in enumerate(images):
        if index % 15 == 7:
            image = cv2.blur(image, (9, 9))
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()
    return path, np.array(azimuths)


def test_a_video_gives_the_frames_whose_light_differs(video, tmp_path, calls, capsys):  # noqa: F811
    path, azimuths = video
    with unpacked(path, frames=8) as folder:
        names = select(folder).names
    numbers = np.array([int(name[6:11]) for name in names])
    assert len(numbers) == 8 and not (numbers % 15 == 7).any()
    places = np.sort(azimuths[numbers])
    gaps = np.diff([*places, places[0] + 360])
    assert gaps.min() > 15 and gaps.max() < 80
    assert run(path, "-o", tmp_path / "out") == 0
    assert calls[0]["images"].shape == (12, 180, 220, 3)
    capsys.readouterr()
    assert run(path, "-o", tmp_path / "out") == 0
    assert "up to date" in capsys.readouterr().out and len(calls) == 1
    assert cli.main(["check", str(path)]) == 0
    assert "turn: 12 photographs" in capsys.readouterr().out


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


def test_a_dark_frame_is_subtracted(folder, tmp_path, calls, capsys):  # noqa: F811
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


def test_dark_frames_that_do_not_fit(folder):
    folder, _ = folder
    capture = read_capture(select(folder, exclude=["room*"]))
    names = [str(i) for i in range(8)]
    cv2.imwrite(str(folder / "small.png"), np.zeros((20, 30), np.uint8))
    cv2.imwrite(str(folder / "white.png"), np.full((180, 220), 255, np.uint8))
    for name, said in (("small", "expected a dark frame as"), ("white", "less light")):
        with pytest.raises(InputError, match=rf"{name}\.png: .*{said}"):
            without_ambient(capture, read_image_file(folder / f"{name}.png"), names)
