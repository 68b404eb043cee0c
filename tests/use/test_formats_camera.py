"""Files as phones and cameras write them: raw, HEIC, AVIF, MPO; and TGA."""

import datetime
import importlib.util
import struct
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import OpenEXR
import pytest
import tifffile
from picture_files import save, smooth
from PIL import Image, features

from unips_jax.capture.prepare import without_ambient
from unips_jax.errors import InputError
from unips_jax.io.color import as_linear
from unips_jax.io.formats import camera
from unips_jax.io.formats.encoded import time_of
from unips_jax.io.images import read_image, read_image_file, turned
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select

HEIGHT, WIDTH = 48, 64


def dng(path, left=9000, right=2000, orientation=1, extra=()):
    """A raw file of grey: two brightnesses, of 16383, next to each other."""
    values = np.full((HEIGHT, WIDTH), left, np.uint16)
    values[:, WIDTH // 2 :] = right
    one, none = (10_000, 10_000), (0, 10_000)
    unit = [n for i in range(9) for n in (none if i % 4 else one)]
    tags = [
        (50706, "B", 4, (1, 4, 0, 0)),
        (50707, "B", 4, (1, 1, 0, 0)),
        (33421, "H", 2, (2, 2)),
        (33422, "B", 4, (0, 1, 1, 2)),
        (50708, "s", 0, "Test Camera"),
        (271, "s", 0, "Test"),
        (272, "s", 0, "One"),
        (50721, "2i", 9, unit),
        (50714, "H", 1, (0,)),
        (50717, "I", 1, (16383,)),
        (50728, "2I", 3, [*one, *one, *one]),
        (50778, "H", 1, (21,)),
    ]
    tags = [(*tag, True) for tag in (*tags, (274, "H", 1, (orientation,)), *extra)]
    tifffile.imwrite(
        path, values, photometric=32803, extratags=tags, metadata=None, software=None
    )
    return path


def test_raw_files_are_linear_and_as_exposed(tmp_path):
    pytest.importorskip("rawpy")
    for index, light in enumerate((9000, 4500)):
        dng(tmp_path / f"{index}.dng", light)
    capture = read_capture(select(tmp_path))
    assert capture.images.shape == (2, HEIGHT, WIDTH, 3)
    assert capture.images.dtype == np.uint16 and capture.transfer == "linear"
    for image, light in zip(capture.images, (9000, 4500), strict=True):
        for column, value in ((10, light), (50, 2000)):
            expected = 65535 * value / 16383
            np.testing.assert_allclose(image[24, column], expected, rtol=1e-3)


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_raw_files_are_turned(tmp_path, orientation):
    pytest.importorskip("rawpy")
    file = read_image_file(dng(tmp_path / "a.dng", orientation=orientation))
    upright = read_image(dng(tmp_path / "b.dng"))
    turns = {3: 2, 6: 3, 8: 1}[orientation]
    np.testing.assert_array_equal(file.pixels, np.rot90(upright, turns))
    assert file.orientation == orientation


EXPOSED = (
    (33434, "2I", 1, (1, 60)),
    (33437, "2I", 1, (8, 1)),
    (34855, "H", 1, (200,)),
    (36867, "s", 0, "2026:11:28 10:00:00"),
    (41989, "H", 1, (50,)),
)


def test_how_raw_files_were_taken(tmp_path, monkeypatch):
    pytest.importorskip("rawpy")
    file = read_image_file(dng(tmp_path / "a.dng", extra=EXPOSED))
    header = file.header
    assert header.camera == "Test One" and header.exposure == pytest.approx(200 / 3840)
    assert header.taken == time_of("2026:11:28 10:00:00")
    assert file.focal == pytest.approx(50 * np.hypot(48, 64) / np.hypot(24, 36))
    assert not header.srgb and file.encoding.transfer == "linear"


def test_how_raw_files_of_no_tiffs_form_were_taken(tmp_path, monkeypatch):
    pytest.importorskip("rawpy")
    path = dng(tmp_path / "a.dng", extra=EXPOSED)
    monkeypatch.setattr(camera, "raw_facts", lambda data: {})
    shot = camera._shot
    other = SimpleNamespace(
        shutter_speed=1 / 60,
        aperture=8.0,
        iso_speed=200.0,
        timestamp=datetime.datetime(2026, 11, 28, 10),  # as rawpy gives it
    )
    monkeypatch.setattr(camera, "_shot", lambda _: shot(SimpleNamespace(other=other)))
    header = read_image_file(path).header
    assert header.taken == time_of("2026:11:28 10:00:00")
    assert header.exposure == pytest.approx(200 / 3840)
    monkeypatch.setattr(camera, "_shot", lambda _: shot(SimpleNamespace()))
    header = read_image_file(path).header  # of an older binding
    assert (header.taken, header.exposure) == (0, 0)


@pytest.mark.parametrize(("wide", "high"), [(2, 1), (4, 3), (1, 2), (3, 4)])
def test_raw_files_whose_pixels_are_not_square(tmp_path, wide, high):
    pytest.importorskip("rawpy")
    scale = (50718, "2I", 2, (wide, 1, high, 1))
    image = read_image(dng(tmp_path / "a.dng", extra=[scale]))
    ratio = image.shape[1] / image.shape[0]
    assert ratio == pytest.approx(WIDTH / HEIGHT * wide / high, abs=0.02)
    assert image[4, 4, 0] > 3 * image[4, -4, 0]


@pytest.mark.parametrize("mark", [b"IIRO", b"IIU\0"])
def test_raw_files_are_read_quietly(tmp_path, mark):
    """As the first of a process: what the decoder logs is not for the terminal."""
    pytest.importorskip("rawpy")
    path = dng(tmp_path / "a.orf", extra=EXPOSED)
    path.write_bytes(mark + path.read_bytes()[4:])
    code = """
import pathlib, sys
from unips_jax.io.images import image_header
path = pathlib.Path(sys.argv[1])
image_header(path.read_bytes(), path)
"""
    command = [sys.executable, "-c", code, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_damaged_raw_file_is_one_quiet_error(tmp_path, capfd):
    pytest.importorskip("rawpy")
    path = dng(tmp_path / "a.dng")
    data = path.read_bytes()
    for length in (len(data) // 3, len(data) * 4 // 5):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.dng: expected .*image"):
            read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", ["RAF", "RW2", "ORF", "PEF", "SRW", "mrw", "nef"])
@pytest.mark.parametrize("content", [b"x" * 64, b"\0MRM" + bytes(300)])
def test_raw_files_without_a_known_mark_are_named_by_their_suffix(
    suffix, content, tmp_path, monkeypatch
):
    path = tmp_path / f"p.{suffix}"
    path.write_bytes(content)
    kind = rf"got a camera's raw file by its name \({suffix.upper()}\)"
    if importlib.util.find_spec("rawpy") is not None:
        with pytest.raises(InputError, match=f"{kind} that is damaged or that LibRaw"):
            read_image(path)
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(InputError, match=f"{kind}; pip install rawpy, or develop it"):
        read_image(path)


def heic(path, picture, **options):
    pillow_heif = pytest.importorskip("pillow_heif")
    height, width, channels = picture.shape
    mode = "RGB" if channels == 3 else "RGBA"
    file = pillow_heif.from_bytes(mode, (width, height), picture.tobytes())
    file.save(path, quality=100, chroma=444, **options)
    return path


def test_heic_whatever_it_is_called(tmp_path):
    picture = smooth(np.uint8, height=HEIGHT, width=WIDTH)
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "Phone", 6
    for name in ("a.heic", "b.jpg", "c.HEIF", "d.HIF"):
        file = read_image_file(heic(tmp_path / name, picture, exif=exif.tobytes()))
        upright = np.rot90(picture, 3)
        assert np.abs(file.pixels.astype(int) - upright).max() <= 6
        assert (file.orientation, file.header.camera) == (6, "Phone")
        assert file.encoding.transfer == "srgb"
    assert select(tmp_path).names == ("a.heic", "b.jpg", "c.HEIF", "d.HIF")


def turned_heic(path, picture, orientation):
    """A picture stored as it is, which viewers turn."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    return heic(path, picture, exif=exif.tobytes())


@pytest.mark.parametrize("orientation", range(1, 9))
def test_heic_is_turned_as_viewers_do(tmp_path, orientation):
    picture = smooth(np.uint8, height=HEIGHT, width=WIDTH)
    file = read_image_file(turned_heic(tmp_path / "a.heic", picture, orientation))
    shown = turned(picture, orientation)
    assert file.pixels.shape == shown.shape and file.orientation == orientation
    assert np.abs(file.pixels.astype(int) - shown).max() <= 6
    assert (file.header.height, file.header.width) == (HEIGHT, WIDTH)  # as stored


def test_heic_whose_exif_data_turn_nothing(tmp_path):
    """By HEIF's rules its own boxes decide."""
    picture = smooth(np.uint8, height=HEIGHT, width=WIDTH)
    path = turned_heic(tmp_path / "a.heic", picture, 6)
    data = path.read_bytes()
    assert data.count(b"irot\3") == 1
    path.write_bytes(data.replace(b"irot\3", b"irot\0"))
    file = read_image_file(path)
    assert file.orientation == 1 and file.pixels.shape == picture.shape


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_a_phone_that_looks_down_does_not_know_what_is_up(tmp_path, orientation):
    picture = smooth(np.uint8, height=HEIGHT, width=WIDTH)
    for name, tag in (("a", 1), ("b", orientation)):
        turned_heic(tmp_path / f"{name}.heic", picture, tag)
    turned_heic(tmp_path / "dark.heic", picture // 4, orientation)
    capture = read_capture(select(tmp_path, exclude=["dark*"]))
    for image in capture.images:
        assert np.abs(image.astype(int) - picture).max() <= 6
    (note,) = capture.notes
    assert note.startswith("other EXIF orientation than a.heic: b.heic; turned")
    assert capture.orientation == 1  # SfMData has HEIC as it is shown
    dark = read_image_file(tmp_path / "dark.heic")
    left = as_linear(without_ambient(capture, dark, ["a", "b"]).images, "srgb")
    expected = as_linear(picture, "srgb") - as_linear(picture // 4, "srgb")
    assert np.abs(left - expected).max() < 0.05
    first = read_capture(select(tmp_path, include=["b*"]))
    assert (first.exif_orientation, first.orientation) == (orientation, 1)


def test_heic_and_avif_that_are_cut_out_or_damaged(tmp_path, capfd):
    alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    alpha[:10] = 0
    picture = np.dstack([smooth(np.uint8, height=HEIGHT, width=WIDTH), alpha])
    paths = [heic(tmp_path / "a.heic", picture)]
    if features.check("avif"):
        paths.append(tmp_path / "a.avif")
        Image.fromarray(picture).save(paths[-1], quality=100)
    for path in paths:
        file = read_image_file(path)
        np.testing.assert_array_equal(file.alpha > 127, alpha[..., 0] > 0)
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2])
        with pytest.raises(InputError, match="got a damaged, truncated"):
            read_image(path)
    assert capfd.readouterr() == ("", "")


def test_pixels_of_heic_are_their_own(tmp_path):
    """The decoder's memory ends with it, before pillow-heif 1.6."""
    pixels = read_image_file(heic(tmp_path / "a.heic", smooth(np.uint8))).pixels
    while isinstance(pixels.base, np.ndarray):
        pixels = pixels.base
    assert pixels.flags.owndata


@pytest.mark.skipif(not features.check("avif"), reason="Pillow has no AVIF here")
def test_avif(tmp_path):
    picture = smooth(np.uint8, height=HEIGHT, width=WIDTH)
    Image.fromarray(picture).save(tmp_path / "a.avif", quality=100, subsampling="4:4:4")
    read = read_image(tmp_path / "a.avif")
    assert np.abs(read.astype(int) - picture).max() <= 12


@pytest.mark.parametrize(
    ("module", "package", "make"),
    [("rawpy", "rawpy", dng), ("pillow_heif", "pillow-heif", heic)],
)
def test_what_is_not_installed_is_named(tmp_path, monkeypatch, module, package, make):
    arguments = () if make is dng else (smooth(np.uint8),)
    path = make(tmp_path / "a.jpg", *arguments)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f"pip install {package}, or "):
        read_image(path)


def test_the_first_picture_of_an_mpo(tmp_path):
    views = [Image.fromarray(smooth(np.uint8, seed)) for seed in (0, 1)]
    path = tmp_path / "a.mpo"
    views[0].save(path, save_all=True, append_images=views[1:], quality=95)
    assert select(tmp_path).names == ("a.mpo",)
    read = read_image(path).astype(int)
    assert np.abs(read - smooth(np.uint8)).mean() < 4


@pytest.mark.parametrize("compression", [None, "tga_rle"])
@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P"])
def test_tga(tmp_path, mode, compression):
    picture = Image.fromarray(smooth(np.uint8)).convert(mode)
    picture.save(tmp_path / "a.tga", compression=compression)
    assert select(tmp_path).names == ("a.tga",)
    read = read_image(tmp_path / "a.tga")
    expected = np.atleast_3d(
        np.asarray(picture.convert("RGB" if mode == "P" else mode))
    )
    np.testing.assert_array_equal(read, expected[..., :3])
    data = (tmp_path / "a.tga").read_bytes()
    (tmp_path / "a.tga").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="damaged, truncated or unknown"):
        read_image(tmp_path / "a.tga")


def test_a_tga_without_a_footer(tmp_path):
    picture = smooth(np.uint8)
    height, width = picture.shape[:2]
    header = struct.pack("<BBBHHBHHHHBB", 0, 0, 2, 0, 0, 0, 0, 0, width, height, 24, 32)
    path = tmp_path / "a.tga"
    path.write_bytes(header + picture[..., ::-1].tobytes())
    np.testing.assert_array_equal(read_image(path), picture)


@pytest.mark.parametrize("colour", [(0, 255, 0), (255, 0, 0), (90, 20, 160)])
def test_masks_of_any_colour_and_palette(tmp_path, colour):
    save(tmp_path / "a.png", smooth(np.uint8))
    mask = np.zeros(smooth(np.uint8).shape[:2], bool)
    mask[4:12, 5:30] = True
    painted = Image.fromarray(np.uint8(mask), "P")
    painted.putpalette([0, 0, 0, *colour])
    for picture in (painted, painted.convert("RGB")):
        picture.save(tmp_path / "mask.png")
        np.testing.assert_array_equal(read_capture(select(tmp_path)).mask, mask)


def test_float_tiff_with_alpha(tmp_path):
    alpha = np.ones((HEIGHT, WIDTH, 1), np.float32)
    alpha[:, :9] = 0
    picture = smooth(np.float32, height=HEIGHT, width=WIDTH)
    for index in range(2):
        tifffile.imwrite(
            tmp_path / f"{index}.tif",
            np.dstack([picture, alpha]),
            photometric="rgb",
            extrasamples=["unassalpha"],
        )
    capture = read_capture(select(tmp_path))
    np.testing.assert_array_equal(capture.images[0], picture)
    np.testing.assert_array_equal(capture.mask, alpha[..., 0] > 0)


@pytest.mark.parametrize("suffix", [".tga", ".exr"])
def test_alpha_of_zero_everywhere_is_none(tmp_path, suffix):
    """As programs write it that know no alpha."""
    dtype = np.float32 if suffix == ".exr" else np.uint8
    picture = np.dstack([smooth(dtype), np.zeros(smooth(dtype).shape[:2], dtype)])
    for index in range(2):
        path = tmp_path / f"{index}{suffix}"
        if suffix == ".tga":
            Image.fromarray(picture).save(path)
        else:
            OpenEXR.File({}, {"RGBA": picture}).write(str(path))
    capture = read_capture(select(tmp_path))
    np.testing.assert_array_equal(capture.images[1], picture[..., :3])
    assert capture.opaque is None and not capture.notes
    assert capture.mask.mean() > 0.9
