"""Reading photographs: formats, choice of files, masks, and bad files."""

import inspect
import struct

import cv2
import numpy as np
import OpenEXR
import pytest
from picture_files import HEIGHT, WIDTH, save, smooth

from unips_jax.errors import InputError
from unips_jax.estimation.streaming import estimate_photographs
from unips_jax.io.images import read_image
from unips_jax.io.photographs import read_photographs
from unips_jax.io.selection import SUFFIXES, select


@pytest.mark.parametrize(
    ("suffix", "dtype", "tolerance"),
    [
        (".png", np.uint8, 0),
        (".PNG", np.uint16, 0),
        (".tif", np.uint8, 0),
        (".TIFF", np.uint16, 0),
        (".tif", np.float32, 0),
        (".bmp", np.uint8, 0),
        (".webp", np.uint8, 0),  # lossless
        (".JPG", np.uint8, 4),  # quality 100, colours not subsampled
        (".jfif", np.uint8, 4),
        (".exr", np.float32, 0),
        (".hdr", np.float32, 0.02),  # 8-bit mantissa, shared exponent: 3 / 256 steps
    ],
)
def test_formats_keep_type_values_and_order(tmp_path, suffix, dtype, tolerance):
    picture = smooth(dtype)
    read = read_image(save(tmp_path / f"a{suffix}", picture))
    assert suffix.lower() in SUFFIXES
    assert read.dtype == dtype
    assert read.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(read.astype(np.float64) - picture).max() <= tolerance


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp", ".exr"])
def test_red_is_first(tmp_path, suffix):
    dtype = np.float32 if suffix == ".exr" else np.uint8
    red = np.zeros((16, 16, 3), dtype)
    red[..., 0] = 200
    colour = read_image(save(tmp_path / f"red{suffix}", red)).mean(axis=(0, 1))
    np.testing.assert_allclose(colour, [200, 0, 0], atol=2)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_gray_is_replicated_and_alpha_dropped(tmp_path, dtype):
    picture = smooth(dtype)
    save(tmp_path / "a.png", picture[..., 0])
    save(tmp_path / "b.png", np.dstack([picture, picture[..., :1] // 2]))
    read = read_photographs(select(tmp_path))
    gray = np.repeat(picture[..., :1], 3, axis=-1)
    np.testing.assert_array_equal(read.images, [gray, picture])
    assert read.mask.all() and read.mask.shape == (HEIGHT, WIDTH)


def test_a_folders_path_is_enough(tmp_path):
    """And gives the arguments of `estimate_photographs`."""
    for name in "ab":
        save(tmp_path / f"{name}.png", smooth(np.uint16, ord(name)))
    expected = read_photographs(select(tmp_path))
    for source in (tmp_path, str(tmp_path)):
        photographs = read_photographs(source)
        np.testing.assert_array_equal(photographs.images, expected.images)
        assert photographs.mask.all() and photographs.transfer == "linear"
    takes = inspect.signature(estimate_photographs).parameters
    assert list(takes)[1:3] == ["images", "mask"] and "transfer" in takes
    with pytest.raises(InputError, match="none: expected a folder of photographs"):
        read_photographs(tmp_path / "none")


def test_exr_layers_half_and_luminance(tmp_path):
    picture = smooth(np.float32)
    half = picture.astype(np.float16)
    planes = {f"View.Combined.{c}": half[..., i].copy() for i, c in enumerate("RGB")}
    planes["View.Depth.Z"] = picture[..., 0].copy()
    path = tmp_path / "layers.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(path))
    np.testing.assert_array_equal(read_image(path), half.astype(np.float32))
    gray = read_image(save(tmp_path / "gray.exr", picture[..., 1]))
    np.testing.assert_array_equal(gray[..., 0], picture[..., 1])
    windows = {
        "type": OpenEXR.scanlineimage,
        "dataWindow": (np.int32([-2, 4]), np.int32([WIDTH - 3, HEIGHT + 3])),
        "displayWindow": (np.int32([0, 1]), np.int32([39, 29])),
    }
    OpenEXR.File(windows, {"RGB": picture.copy()}).write(str(path))
    shown = np.zeros((29, 40, 3), np.float32)
    shown[3 : 3 + HEIGHT, : WIDTH - 2] = picture[:, 2:]
    np.testing.assert_array_equal(read_image(path), shown)
    only_depth = {"Z": picture[..., 0].copy()}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, only_depth).write(str(path))
    with pytest.raises(
        InputError, match=r"layers\.exr: .* EXR with the channels Z, not"
    ):
        read_image(path)


def test_values_that_are_not_finite_matter_inside_the_mask_only(tmp_path):
    picture = smooth(np.float32)
    picture[2, 3] = [np.nan, np.inf, 1]
    save(tmp_path / "a.exr", picture)
    with pytest.raises(InputError, match=r"a\.exr: .* got 2 NaN or infinite"):
        read_photographs(select(tmp_path))
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[2, 3] = 0
    save(tmp_path / "mask.png", mask)
    (read,) = read_photographs(select(tmp_path)).images
    np.testing.assert_array_equal(read, np.nan_to_num(picture, posinf=0))


def test_there_is_no_negative_light(tmp_path):
    picture = smooth(np.float32)
    picture[2, 3] = -0.1
    save(tmp_path / "a.exr", picture)
    (read,) = read_photographs(select(tmp_path)).images
    np.testing.assert_array_equal(read, np.maximum(picture, 0))


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        (".png", np.uint8),
        (".png", np.uint16),
        (".jpg", np.uint8),
        (".tif", np.uint8),
        (".tif", np.uint16),
        (".tif", np.float32),
        (".webp", np.uint8),
        (".exr", np.float32),
        (".hdr", np.float32),
        (".bmp", np.uint8),
    ],
)
def test_truncated_files_are_one_quiet_error(tmp_path, capfd, suffix, dtype):
    path = save(tmp_path / f"a{suffix}", smooth(dtype, height=64, width=80))
    data = path.read_bytes()
    for length in (3, len(data) // 3, len(data) * 4 // 5, len(data) - 3):
        path.write_bytes(data[:length])
        with pytest.raises(
            InputError, match="expected a readable image, got a damaged"
        ):
            read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["a.tif", "a.jpg"])
def test_damage_that_a_decoder_only_mentions(tmp_path, capfd, name):
    path = save(tmp_path / name, smooth(np.uint8, height=64, width=80))
    data = bytearray(path.read_bytes())
    middle = len(data) // 3
    data[middle : middle + 400] = b"\xa5" * 400
    if name == "a.jpg":  # cut, but for its end marker
        data[-1000:] = b"\xff\xd9"
    path.write_bytes(data)
    with pytest.raises(InputError, match=rf"{name}: .*the decoder says: "):
        read_image(path)
    assert capfd.readouterr() == ("", "")


def test_bytes_between_the_segments_of_a_jpeg_are_no_damage(tmp_path):
    path = save(tmp_path / "a.jpg", smooth(np.uint8))
    whole, data = read_image(path), path.read_bytes()
    tables = data.index(b"\xff\xdb")
    path.write_bytes(data[:tables] + b"\0\0\xff\0\7" + data[tables:])
    np.testing.assert_array_equal(read_image(path), whole)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="truncated"):
        read_image(path)


def test_jpeg_thumbnail_does_not_hide_truncation(tmp_path):
    path = save(tmp_path / "a.jpg", smooth(np.uint8))
    data = path.read_bytes()
    thumbnail = b"thumbnail \xff\xd8\xff\xd9"
    segment = b"\xff\xe2" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    path.write_bytes(data[:2] + segment + data[2:] + b"trailer")
    assert read_image(path).shape == (HEIGHT, WIDTH, 3)
    path.write_bytes(data[:2] + segment + data[2:-40])
    with pytest.raises(InputError, match="truncated"):
        read_image(path)


def test_other_pixel_types_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tif"), smooth(np.uint8).astype(np.int16))
    with pytest.raises(InputError, match="got a TIFF of 16-bit signed samples; export"):
        read_image(tmp_path / "a.tif")
