"""Photographs in one file: pages, and videos."""

import json
import os
import random
import re
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from estimate_runs import run
from plain_objects import lights, photographs

from unips_jax.capture.unpack import unpacked
from unips_jax.cli import main as cli
from unips_jax.errors import InputError
from unips_jax.io.color import CURVES, as_linear
from unips_jax.io.images import read_image, read_image_file
from unips_jax.io.normal_maps import is_normal_map
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select


def images_of(folder):
    return read_capture(select(folder)).images


@pytest.mark.parametrize("kind", ["pages", "grey", "imagej"])
def test_the_pages_of_a_tiff(tmp_path, kind, calls):
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


_COLOUR = np.random.default_rng(0).integers(0, 256, (2, 20, 31, 4), np.uint8)


@pytest.mark.parametrize(
    ("pages", "tags"),
    [
        (_COLOUR[..., :3], dict(photometric="rgb", extratags=[(274, 3, 1, 6, True)])),
        (_COLOUR[..., 0], dict(photometric="miniswhite")),
        (_COLOUR[..., 0], dict(photometric="palette", colormap=_COLOUR[0, :8, :, 0])),
        (_COLOUR[..., 0] >> 4, dict(photometric="minisblack", bitspersample=4)),
        (_COLOUR[..., :2], dict(photometric="minisblack", extrasamples=["unassalpha"])),
        (_COLOUR, dict(photometric="rgb", extrasamples=["unassalpha"])),
        (_COLOUR[..., :3], dict(photometric="cielab")),
        (_COLOUR, dict(photometric="separated")),
        (_COLOUR[..., 0] * np.uint16(16), dict(bitspersample=12)),
    ],
    ids="turned white-is-zero palette 4-bit grey-alpha alpha lab cmyk 12-bit".split(),
)
def test_pages_are_read_as_files_of_their_own(tmp_path, pages, tags):
    if "colormap" in tags:
        colours = np.resize(tags["colormap"].astype(np.uint16) * 257, (3, 256))
        tags = {**tags, "colormap": colours}
    one, several = tmp_path / "one.tif", tmp_path / "several.tif"
    for path, some in ((one, pages[:1]), (several, pages)):
        with tifffile.TiffWriter(path) as tiff:
            for page in some:
                tiff.write(page, metadata=None, **tags)
    try:
        expected = read_image_file(one)
    except InputError as error:
        kind = re.search("got (.*?);", str(error)).group(1)
        with pytest.raises(InputError, match=re.escape(kind)), unpacked(several):
            pass
        return
    with unpacked(several) as folder:
        found = read_image_file(folder / "page_001.tif")
    np.testing.assert_array_equal(found.pixels, expected.pixels)
    assert found.orientation == expected.orientation
    assert (found.alpha is None) == (expected.alpha is None)
    if expected.alpha is not None:
        np.testing.assert_array_equal(found.alpha, expected.alpha)


def test_colours_as_pages_are_no_photographs(tmp_path):
    """As ImageJ saves several pictures of three channels."""
    images = np.moveaxis(_COLOUR[..., :3].astype(np.uint16), -1, 1)
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, images, imagej=True, metadata={"axes": "ZCYX"})
    with pytest.raises(InputError, match="got 3 colours of each as pages"):
        with unpacked(path):
            pass


def test_a_normal_map_with_a_thumbnail_is_one(tmp_path):
    path = tmp_path / "normal.tif"
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(_COLOUR[0, ..., :3], photometric="rgb")
        tiff.write(_COLOUR[0, ::4, ::4, :3], photometric="rgb", subfiletype=1)
    assert is_normal_map(path)
    tifffile.imwrite(path, _COLOUR[..., :3], photometric="rgb", append=True)
    assert not is_normal_map(path)


def test_errors_of_pages_name_the_file_whatever_the_separator(tmp_path):
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, _COLOUR[..., :3], photometric="rgb")
    for separator in ("/", "\\"):
        with pytest.raises(InputError) as caught, unpacked(path) as folder:
            raise InputError(f"{folder}{separator}page_002.tif: too dark")
        assert str(caught.value) == f"{path} page_002: too dark"


def test_files_that_hold_one_or_nothing(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((20, 30), np.uint8))
    tifffile.imwrite(tmp_path / "e.tif", _COLOUR[0, ..., :3], imagej=True)
    (tmp_path / "b.tif").write_bytes(b"II*\0nothing")
    (tmp_path / "c.mp4").write_bytes(b"no video")
    (tmp_path / "d.mp4").write_bytes(bytes(4) + b"ftypisom")
    for name, said in (
        ("a.tif", f"got one of 1; give its folder, {tmp_path}"),
        ("e.tif", "got one of 1"),
        ("b.tif", "or a TIFF of several"),
        ("c.mp4", "got a file that does not begin like one"),
        ("d.mp4", "expected a video of some seconds, got 0 frames"),
    ):
        with pytest.raises(InputError, match=said), unpacked(tmp_path / name):
            pass
    with pytest.raises(InputError, match="left out .a video: give the file itself"):
        for name in "abe":
            (tmp_path / f"{name}.tif").unlink()
        select(tmp_path)


@pytest.fixture
def video(tmp_path):
    """A lamp that rests at the right, then goes around; some frames are shaken."""
    azimuths = [0.0] * 30 + list(np.arange(0, 360, 6.0))
    images, _ = photographs(
        5, directions=lights(0, np.array(azimuths)), second=(0.2, 0.2, 0.1)
    )
    path = tmp_path / "turn.avi"
    shaken = [
        cv2.blur(image, (9, 9)) if index % 15 == 7 else image
        for index, image in enumerate(images[..., ::-1])
    ]
    write_video(path, shaken)
    return path, np.array(azimuths)


def test_a_video_gives_the_frames_whose_light_differs(video, tmp_path, calls, capsys):
    path, azimuths = video
    with unpacked(path, frames=8) as folder:
        names = select(folder).names
    assert all(re.fullmatch(r"at_00m0\d\.\d{3}s\.png", name) for name in names)
    numbers = np.array([round(25 * float(name[6:12])) for name in names])
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
    assert "turn.avi: 12 photographs" in capsys.readouterr().out


def test_names_of_videos_that_opencv_cannot_take(video, tmp_path, monkeypatch):
    path, _ = video
    (tmp_path / "12:30.avi").write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    with unpacked(Path("12:30.avi"), frames=3) as folder:
        assert len(select(folder).files) == 3
    strange = tmp_path / os.fsdecode(b"caf\xe9.avi")
    path.rename(strange)
    with pytest.raises(InputError, match="expected a path in UTF-8 for a video"):
        with unpacked(strange):
            pass


def test_messages_name_the_video_and_the_time(video, tmp_path, calls, capsys):
    path, _ = video
    shaken = cv2.VideoCapture(str(path))
    frames = [frame for _ in range(90) for frame in [shaken.read()[1]]]
    frames = [np.roll(f, 9, 1) if 40 <= i < 43 else f for i, f in enumerate(frames)]
    write_video(path, frames)
    assert cli.main(["check", str(path)]) == 0
    out = capsys.readouterr().out
    moved = re.search(r"moved: at_00m0[12]\.\d{3}s\.png (\d+) pixels", out)
    assert moved and abs(int(moved[1]) - 9) <= 1 and "unips-" not in out
    assert out.startswith(f"{path}: 12 photographs")
    assert run(path, "-o", tmp_path / "out") == 0
    assert "unips-" not in "".join(capsys.readouterr())
    record = json.loads((tmp_path / "out/turn/normals.json").read_text())
    assert record["folder"] == str(path)
    with pytest.raises(InputError) as raised, unpacked(path) as folder:
        raise InputError(f"{folder}/at_00m01.640s.png: expected light")
    assert str(raised.value) == f"{path} at_00m01.640s: expected light"
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((9, 9), 255, np.uint8))
    assert run(path, "-o", tmp_path / "out", "--mask", tmp_path / "mask.png") == 2
    error = capsys.readouterr().err
    assert "unips-" not in error and "expected a mask of 220 x 180 pixels" in error


def write_video(path, frames, codec="MJPG"):
    size = frames[0].shape[1::-1]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25, size)
    for frame in frames:
        writer.write(np.ascontiguousarray(frame))
    writer.release()


def with_colours(mp4: bytes, code: int) -> bytes:
    """An MP4 of one track whose sample entry has a colour box."""
    box = struct.pack(">I4s4sHHHB", 19, b"colr", b"nclx", 9, code, 9, 0)
    end = mp4.index(b"mp4v") - 4
    end += struct.unpack_from(">I", mp4, end)[0]
    data = bytearray(mp4[:end] + box + mp4[end:])
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"):
        at = mp4.index(name, mp4.index(b"moov")) - 4
        size = struct.unpack_from(">I", mp4, at)[0]
        struct.pack_into(">I", data, at, size + len(box))
    return bytes(data)


@pytest.mark.parametrize("code", [0, 1, 8])
def test_the_transfer_code_of_a_video(tmp_path, code):
    path = tmp_path / "a.mp4"
    levels = np.uint8([64, 128, 192])
    steps = np.repeat(levels, 32)[None, :, None]
    rolled = [np.roll(steps, 32 * i, axis=1) for i in range(3)]
    frames = [np.tile(step, (64, 1, 3)) for step in rolled for _ in range(2)]
    write_video(path, frames, "mp4v")
    path.write_bytes(
        with_colours(path.read_bytes(), code) if code else path.read_bytes()
    )
    with unpacked(path) as folder:
        capture = read_capture(select(folder))
    assert capture.images.dtype == (np.uint16 if code else np.uint8)
    found = as_linear(capture.images, capture.transfer)[:, 32, [16, 48, 80]]
    expected = CURVES[code or 13][1](levels / 255)
    for image in found:  # the codec changes values by up to two levels
        np.testing.assert_allclose(np.sort(image[:, 1]), expected, rtol=0.1)


@pytest.mark.parametrize(
    ("code", "said"),
    [(16, "HDR video .PQ."), (18, "HDR video .HLG."), (77, "unknown transfer code 77")],
)
def test_videos_of_other_codes_are_refused_by_name(tmp_path, code, said):
    path = tmp_path / "a.mp4"
    write_video(path, [np.zeros((64, 64, 3), np.uint8)] * 3, "mp4v")
    path.write_bytes(with_colours(path.read_bytes(), code))
    with pytest.raises(InputError, match=rf"a\.mp4: .*{said}"), unpacked(path):
        pass


def test_a_tiff_whose_pages_lead_back(tmp_path):
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as tiff:
        for _ in range(3):
            tiff.write(np.zeros((20, 30), np.uint8), contiguous=False)
    data = path.read_bytes()
    with tifffile.TiffFile(path) as tiff:
        places = [page.offset for page in tiff.pages]
    count = struct.unpack_from("<H", data, places[2])[0]
    at = places[2] + 2 + 12 * count
    for place in places:
        path.write_bytes(data[:at] + struct.pack("<I", place) + data[at + 4 :])
        start = time.monotonic()
        for read in (read_image, lambda path: unpacked(path).__enter__()):
            with pytest.raises(InputError, match="its pages lead back to one another"):
                read(path)
        assert time.monotonic() - start < 1


UNPACKING = """
import sys
from pathlib import Path
from unips_jax.capture.unpack import unpacked
while True:
    with unpacked(Path(sys.argv[1])) as folder:
        print(folder, flush=True)
"""


def test_killed_while_it_unpacks_nothing_stays(tmp_path, monkeypatch):
    place = tmp_path / "tmp"
    place.mkdir()
    monkeypatch.setenv("TMPDIR", str(place))
    monkeypatch.setattr(tempfile, "tempdir", None)
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.zeros((40, 60, 80), np.uint8), photometric="minisblack")
    tifffile.imwrite(path, np.zeros((60, 80), np.uint8), append=True)
    moments = random.Random(5)
    for _ in range(5):
        command = [sys.executable, "-c", UNPACKING, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            process.stdout.readline()
            time.sleep(moments.uniform(0, 0.05))
            process.kill()
    assert list(place.iterdir())
    with unpacked(path) as folder:
        assert [p for p in place.iterdir() if p.is_dir()] == [folder.parent]
        assert folder.parent.stat().st_mode & 0o77 == 0  # nobody else's photographs
    assert not list(place.iterdir())
