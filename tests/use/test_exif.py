"""Orientation from EXIF data."""

import math
import struct

import numpy as np
import pytest
from picture_files import (
    HEIGHT,
    WIDTH,
    exif,
    png_with_orientation,
    save,
    smooth,
    tiff_with_orientation,
    with_orientation,
)
from PIL import Image, TiffImagePlugin

from unips_jax.capture.check import check_capture
from unips_jax.errors import InputError
from unips_jax.io.formats.encoded import facts_of
from unips_jax.io.images import read_image, read_image_file
from unips_jax.io.official_photographs import read_official
from unips_jax.io.orientation import as_oriented
from unips_jax.io.photographs import read_capture, read_photographs
from unips_jax.io.selection import select


def test_exif_orientation_is_applied_as_viewers_do(tmp_path):
    upright = smooth(np.uint8)
    path = save(tmp_path / "a.jpg", np.ascontiguousarray(np.rot90(upright)))
    path.write_bytes(with_orientation(path.read_bytes(), 6))  # turn clockwise to view
    assert read_image_file(path).orientation == 6
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[3:9, 4:30] = 255
    save(tmp_path / "mask.png", mask)  # drawn over the picture as shown
    read = read_photographs(select(tmp_path))
    assert np.abs(read.images[0].astype(int) - upright).max() <= 4
    np.testing.assert_array_equal(read.mask, mask > 0)


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_camera_that_looks_down_does_not_know_what_is_up(tmp_path, orientation):
    """Its files are stored alike, or turned before: what fits is taken."""
    picture = smooth(np.uint8, height=60, width=60)
    for name, tag, stored in (
        ("a.jpg", 1, picture),
        ("b.jpg", orientation, picture),
        ("c.jpg", orientation, np.rot90(picture, {3: 2, 6: 1}[orientation])),
    ):
        path = save(tmp_path / name, np.ascontiguousarray(stored))
        path.write_bytes(with_orientation(path.read_bytes(), tag))
    capture = read_capture(select(tmp_path))
    for image in capture.images:
        assert np.abs(image.astype(int) - picture).max() <= 4
    assert capture.notes == (
        "other EXIF orientation than a.jpg: b.jpg, c.jpg; turned so that their edges "
        "fit",
    )


def test_differing_orientations_are_refused(tmp_path):
    for name, orientation in (("a.jpg", 1), ("b.jpg", 3)):
        path = save(tmp_path / name, smooth(np.uint8, ord(name[0])))
        path.write_bytes(with_orientation(path.read_bytes(), orientation))
    for read in (read_photographs, read_official):
        with pytest.raises(InputError, match=r"b\.jpg: expected EXIF.* 1 .*got 3"):
            read(select(tmp_path))


def test_a_picture_that_fits_either_way_is_refused(tmp_path):
    picture = smooth(np.uint8, height=60, width=60) // 2
    picture += picture[::-1, ::-1]  # alike upside down
    for name, tag in (("a.jpg", 1), ("b.jpg", 3)):
        path = save(tmp_path / name, picture)
        path.write_bytes(with_orientation(path.read_bytes(), tag))
    with pytest.raises(InputError, match=r"b\.jpg: expected EXIF.* 1 .*got 3"):
        read_capture(select(tmp_path))


def webp_with_orientation(webp, orientation):
    features = struct.pack("<I", 8)  # it has EXIF data
    size = struct.pack("<I", WIDTH - 1)[:3] + struct.pack("<I", HEIGHT - 1)[:3]
    chunks = [(b"VP8X", features + size), (b"EXIF", exif(orientation))]
    first, last = (name + struct.pack("<I", len(body)) + body for name, body in chunks)
    body = b"WEBP" + first + webp[12:] + last
    return b"RIFF" + struct.pack("<I", len(body)) + body


@pytest.mark.parametrize(
    ("suffix", "dtype", "add"),
    [
        (".tif", np.uint8, tiff_with_orientation),
        (".tif", np.uint16, tiff_with_orientation),
        (".png", np.uint8, png_with_orientation),
        (".webp", np.uint8, webp_with_orientation),
    ],
)
def test_whatever_the_decoder_turns_is_reported(tmp_path, suffix, dtype, add):
    path = save(tmp_path / f"a{suffix}", smooth(dtype))
    upright = read_image(path)
    assert read_image_file(path).orientation == 1
    path.write_bytes(add(path.read_bytes(), 3))
    np.testing.assert_array_equal(read_image(path), upright[::-1, ::-1])
    assert read_image_file(path).orientation == 3


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_opacity_turns_with_the_image(tmp_path, orientation, dtype):
    for suffix, turned in (
        (".png", png_with_orientation),
        (".tif", tiff_with_orientation),
    ):
        path = save(tmp_path / f"a{suffix}", smooth(dtype)[..., [0, 1, 2, 0]])
        path.write_bytes(turned(path.read_bytes(), orientation))
        file = read_image_file(path)
        np.testing.assert_array_equal(file.alpha, file.pixels[..., 0])
        again = as_oriented(file, 6)  # where the others of a set lie so
        np.testing.assert_array_equal(again.alpha, again.pixels[..., 0])


@pytest.mark.parametrize("block", [b"", b"II*\0", b"\xff\xd8\xff\xe1", b"II*\0" * 9])
def test_damaged_exif_is_upright(tmp_path, block):
    path = save(tmp_path / "a.jpg", smooth(np.uint8))
    jpeg, body = path.read_bytes(), b"Exif\0\0" + block
    segment = b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
    path.write_bytes(jpeg[:2] + segment + jpeg[2:])
    file = read_image_file(path)
    assert (file.orientation, file.focal) == (1, None)


@pytest.mark.parametrize("focal", [math.nan, math.inf, -1, "35", None])
def test_a_focal_length_is_a_number_above_0(focal):
    assert facts_of(1, focal, 1)["focal_35mm"] == 0
    assert facts_of(1, 35, 1)["focal_35mm"] == 35


def developed_tiff(path, seconds, model, exposure=(8.0, 100)):
    """A TIFF as raw converters write it; its picture is of `seed`."""
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[0x010F], tags[0x0110] = "Maker", model
    aperture, speed = exposure
    exif = {0x829A: seconds, 0x829D: aperture, 0x8827: speed}
    exif |= {0x9003: "2026:11:28 10:00:00", 0xA405: 50}
    tags[0x8769] = exif
    picture = smooth(np.uint8, height=60, width=80)
    Image.fromarray(picture).save(path, tiffinfo=tags)
    return path


def test_camera_and_exposure_of_tiffs(tmp_path):
    file = read_image_file(developed_tiff(tmp_path / "0.tif", 1 / 60, "One"))
    assert file.header.camera == "Maker One"
    assert file.header.exposure == pytest.approx(100 / 60 / 64)
    assert file.focal == pytest.approx(50 * 100 / math.hypot(24, 36))
    for index, (seconds, model) in enumerate(((1 / 60, "One"), (1 / 15, "Two")), 1):
        developed_tiff(tmp_path / f"{index}.tif", seconds, model)
    capture = read_capture(select(tmp_path))
    found = {f.kind: f for f in check_capture(capture, ["0.tif", "1.tif", "2.tif"])}
    assert found["mixed cameras"].files == found["exposure changes"].files == ("2.tif",)
    assert "x4 of the usual" in found["exposure changes"].text


@pytest.mark.parametrize("aperture", [0.0, -0.0])
def test_an_exposure_that_is_none_is_unknown(tmp_path, aperture):
    path = developed_tiff(tmp_path / "0.tif", 1 / 60, "One", (aperture, 100))
    assert read_image_file(path).header.exposure == 0
