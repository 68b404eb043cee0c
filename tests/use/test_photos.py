"""Reading photographs: formats, choice of files, masks, and bad files."""

import inspect
import struct
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from picture_files import HEIGHT, WIDTH, save, smooth

from unips_jax.errors import InputError
from unips_jax.estimation.streaming import estimate_photographs
from unips_jax.io.images import read_image
from unips_jax.io.photographs import read_photographs
from unips_jax.io.selection import SUFFIXES, is_map, select


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


@pytest.mark.parametrize(
    "name",
    [
        "normal.tif",
        "normals.png",
        "Normal_gt.png",
        "NORMAL01.PNG",
        "obj_normal.png",
        "mask.png",
        "mask_02.png",
        "objMask.tif",
        "depth.exr",
        "Depth0001.exr",
        "baseColor.tif",
        "base_color.png",
        "BaseColour.png",
        "roughness.tif",
        "metal.tif",
        "metallic.png",
        "albedo.png",
        "ball_albedo.png",
        "ball_gt.png",
        "ballGT.png",
        "gt.png",
        "gt_normal.tif",
        "sheet.png",
    ],
)
def test_maps_and_outputs_are_recognised(name):
    assert is_map(name)


@pytest.mark.parametrize(
    "name",
    [
        "001.png",
        "L_1.png",
        "IMG_20240101.JPG",
        "length_01.png",
        "abnormal.jpg",
        "light3.png",
        "unmasked.png",
        "sheets_1.png",
        "strength.tif",
        "DSC0001.tif",
        "maskot_1.png",
        "normandy.jpg",
        "depths.png",
    ],
)
def test_photographs_are_not_taken_for_maps(name):
    assert not is_map(name)


def touch(folder: Path, *names: str):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"x")


def test_plain_folder_lists_what_is_left_out(tmp_path):
    touch(tmp_path, "b.PNG", "a.jpg", ".hidden.png", "normal.tif", "notes.txt")
    touch(tmp_path, "mask.TIF", "c.jxl", "d.PSD", "depth.exr")
    (tmp_path / "sub.png").mkdir()
    selection = select(tmp_path)
    assert selection.names == ("a.jpg", "b.PNG")
    assert selection.mask_file == tmp_path / "mask.TIF"
    assert selection.left_out == {
        "a map or output, by its name": ["depth.exr", "normal.tif"],
        "not an image": ["notes.txt"],
        ".jxl is not read: export PNG or TIFF": ["c.jxl"],
        ".psd is not read: export PNG or TIFF": ["d.PSD"],
    }


def test_data_folders(tmp_path):
    test, train, other = (tmp_path / f"{n}.data" for n in ("test", "train", "other"))
    touch(test, "L_1.png", "L_2.png", "0.png", "view.png", "mask.png")
    touch(train, "000.tif", "001.tif", "normal.tif", "baseColor.tif", "x.png")
    touch(other, "a.png", "b.png")
    assert select(test).names == ("L_1.png", "L_2.png")
    assert select(test).left_out == {
        "not named L* in a .data folder": ["0.png", "view.png"]
    }
    assert select(train).names == ("000.tif", "001.tif")
    assert select(other).names == ("a.png", "b.png")


@pytest.mark.parametrize("name", ["metal_bowl_{}.png", "{:02}-goldMask.jpg"])
def test_names_decide_only_between_files(tmp_path, name):
    series = [name.format(i) for i in range(3)]
    touch(tmp_path, *series, "normal.tif", "depth_1.exr", "depth_2.exr")
    selection = select(tmp_path)
    assert selection.names == tuple(series)
    maps = ["depth_1.exr", "depth_2.exr", "normal.tif"]
    assert selection.left_out == {"a map or output, by its name": maps}
    touch(tmp_path, "a.png")
    assert select(tmp_path).names == ("a.png",)


def test_maps_alone_are_no_photographs(tmp_path):
    touch(tmp_path, "normal_1.png", "normal_2.png", "ball_depth.png")
    with pytest.raises(InputError, match="got none; 3 left out .a map or output"):
        select(tmp_path)


def test_patterns_overrule_names(tmp_path):
    touch(tmp_path, "depth_1.png", "depth_2.png", "a.png", "b.PNG", "notes.txt")
    touch(tmp_path, "mask.png")
    chosen = select(tmp_path, include=["depth_*", "*.txt"], exclude=["*_2.png"])
    assert chosen.names == ("depth_1.png",)
    assert chosen.mask_file == tmp_path / "mask.png"
    assert chosen.left_out == {
        "not among --include": ["a.png", "b.PNG"],
        "by --exclude": ["depth_2.png"],
        "not an image": ["notes.txt"],
    }
    assert select(tmp_path, exclude=["mask*"]).mask_file is None
    with pytest.raises(InputError, match="4 left out .not among --include."):
        select(tmp_path, include=["*.exr"])


def test_given_mask_is_no_photograph(tmp_path):
    touch(tmp_path, "a.png", "shape.png", "mask.png")
    selection = select(tmp_path, mask_file=tmp_path / "shape.png")
    assert selection.names == ("a.png",)
    assert selection.left_out == {"a map or output, by its name": ["mask.png"]}


def test_drawn_images_depend_on_the_seed_only(tmp_path):
    touch(tmp_path, *(f"{i:02}.png" for i in range(20)))
    first, again, other = (select(tmp_path, max_images=5, seed=s) for s in (3, 3, 4))
    assert first == again
    assert len(first.names) == 5 and list(first.names) == sorted(first.names)
    assert first.names != other.names
    assert len(first.left_out["not among the 5 drawn with seed 3"]) == 15
    assert select(tmp_path, max_images=20).left_out == {}


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


def test_masks_named_after_the_object(tmp_path):
    touch(tmp_path, "buddha.0.png", "buddha.1.png", "buddha.mask.png", "filenames.txt")
    selection = select(tmp_path)
    assert selection.names == ("buddha.0.png", "buddha.1.png")
    assert selection.mask_file == tmp_path / "buddha.mask.png"
    touch(tmp_path, "mask.png")
    with pytest.raises(InputError, match="one mask, got buddha.mask.png, mask.png"):
        select(tmp_path)


def test_a_photograph_in_two_formats_counts_once(tmp_path):
    touch(tmp_path, "a.JPG", "a.tif", "b.JPG", "b.tif", "c.JPG", "c.tif")
    selection = select(tmp_path)
    assert selection.names == ("a.tif", "b.tif", "c.tif")
    assert selection.left_out == {
        "the same photographs as .tif": ["a.JPG", "b.JPG", "c.JPG"]
    }
    assert select(tmp_path, include=["*.JPG"]).names == ("a.JPG", "b.JPG", "c.JPG")
    (tmp_path / "c.tif").unlink()  # what all have comes first
    assert select(tmp_path).names == ("a.JPG", "b.JPG", "c.JPG")


@pytest.mark.parametrize("installed", [True, False])
def test_raw_files_come_first_where_they_are_read(tmp_path, monkeypatch, installed):
    found = object() if installed else None
    monkeypatch.setattr("importlib.util.find_spec", lambda name: found)
    touch(tmp_path, "a.JPG", "a.CR2", "b.JPG", "b.CR2")
    suffix = "CR2" if installed else "JPG"
    assert select(tmp_path).names == (f"a.{suffix}", f"b.{suffix}")


def test_a_list_of_lights_names_the_photographs(tmp_path):
    touch(tmp_path, "rti 01.jpg", "rti 02.jpg", "Ball_mask.png", "setup.jpg")
    text = "3\nC:\\work\\rti 01.jpg 0.1 -0.2 0.97\nx/RTI 02.JPG\t.5 5e-1 0.7\n"
    (tmp_path / "coin.lp").write_text(text + "rti 03.jpg 0 0 1\nnonsense\n")
    selection = select(tmp_path)
    assert selection.names == ("rti 01.jpg", "rti 02.jpg")
    assert selection.left_out == {
        "not understood in coin.lp": [
            "coin.lp, line 5: no name and light, 'nonsense'",
            "coin.lp: 3 lights by its first line, 4 there",
        ],
        "not listed in coin.lp": ["Ball_mask.png", "setup.jpg"],
        "listed in coin.lp, but not there": ["rti 03.jpg"],
    }
    (tmp_path / "coin.lp").write_bytes(b"\xff\x00nothing of ours")
    assert select(tmp_path).names == ("rti 01.jpg", "rti 02.jpg", "setup.jpg")


def test_links_and_hidden_files(tmp_path):
    touch(tmp_path, "b.png", ".b.png", "._b.png")
    touch(tmp_path / "elsewhere", "c.png")
    (tmp_path / "a.png").symlink_to("b.png")
    (tmp_path / "c.png").symlink_to("elsewhere/c.png")
    selection = select(tmp_path)
    assert selection.names == ("b.png", "c.png")
    assert selection.left_out == {"another name of b.png": ["a.png"]}
