"""Writing normals and the contact sheet."""

import hashlib
import json

import cv2
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
import scipy.io

from unips_jax.errors import InputError
from unips_jax.io.color import srgb_encode
from unips_jax.io.normals import (
    encode_normals,
    has_unit_length,
    true_pixels,
    write_normals,
)
from unips_jax.io.results import appearing_at_once, check_target, write_record
from unips_jax.pictures.estimate_sheet import shade, write_sheet


@pytest.fixture
def normals():
    """Unit normals on an ellipse in a picture that is not square."""
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 61), np.linspace(1.2, -1.2, 43))
    z2 = 1 - x**2 - y**2
    n = np.stack([x, y, np.sqrt(np.maximum(z2, 0))], axis=-1)
    return np.where(z2[..., None] > 0, n, 0).astype(np.float32)


def decoded(path):
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert values.dtype == np.uint16
    return values / 65535 * 2 - 1


def test_known_values():
    known = np.float32([[-1, 0, 1], [0.5, -0.25, 2]])
    expected = [[0, 32768, 65535], [49151, 24576, 65535]]
    np.testing.assert_array_equal(encode_normals(known), expected)
    broken = np.float32([[np.nan, np.inf, -np.inf]])
    np.testing.assert_array_equal(encode_normals(broken), [[32768, 32768, 32768]])


def test_png_is_exact_to_half_a_level_and_background_is_near_zero(tmp_path, normals):
    write_normals(tmp_path, normals)
    read = decoded(tmp_path / "normals.png")
    assert read.shape == normals.shape
    # Half a level, and float32's rounding of values up to 65535.
    assert np.abs(read - normals).max() <= 1 / 65535 + 1.3e-7
    inside = normals.any(axis=-1)
    assert np.abs(read[~inside]).max() <= 2e-5
    np.testing.assert_array_equal(np.load(tmp_path / "normals.npy"), normals)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["normals.npy", "normals.png"]


@pytest.mark.parametrize(
    ("normal_map", "signs"), [("directx", [1, -1, 1]), ("opencv", [1, -1, -1])]
)
def test_conventions_turn_maps_not_arrays(tmp_path, normals, normal_map, signs):
    write_normals(tmp_path, normals, exr=True, mat=True, normal_map=normal_map)
    flipped = normals * signs
    assert np.abs(decoded(tmp_path / "normals.png") - flipped).max() <= 2e-5
    exr = OpenEXR.File(str(tmp_path / "normals.exr")).channels()["RGB"].pixels
    np.testing.assert_array_equal(exr, flipped.astype(np.float32))
    np.testing.assert_array_equal(np.load(tmp_path / "normals.npy"), normals)
    mat = scipy.io.loadmat(tmp_path / "normals.mat")["Normal_est"]
    np.testing.assert_array_equal(mat, normals)


def test_the_object_is_where_lengths_are_one_to_a_thousandth():
    lengths = np.array([0, 0.998, 0.9995, 1.0005, 1.002])
    expected = [False, False, True, True, False]
    z = np.float32([0, 0, 1]) * lengths[:, None]
    np.testing.assert_array_equal(has_unit_length(z), expected)


def test_normals_of_any_type_are_written_as_float32(tmp_path, normals):
    write_normals(tmp_path, jnp.asarray(normals, jnp.bfloat16))
    written = np.load(tmp_path / "normals.npy")
    assert written.dtype == np.float32
    np.testing.assert_allclose(written, normals, atol=0.01)


def test_true_normals_of_eight_bits_are_whole_however_they_are_stored():
    y, x = np.mgrid[-1:1:99j, -1:1:99j]
    inside = np.hypot(x, y) < 0.95
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    exact = np.stack([x, y, z], -1) * inside[..., None]
    np.testing.assert_array_equal(true_pixels(exact), inside)
    coded = np.rint((exact + 1) * 127.5) / 127.5 - 1  # as 8 bits, in a file of 16
    assert has_unit_length(coded)[inside].mean() < 0.5
    np.testing.assert_array_equal(true_pixels(coded), inside)


def test_files_appear_together_or_not_at_all(tmp_path):
    target = tmp_path / "out" / "a"
    with pytest.raises(RuntimeError), appearing_at_once(target) as place:
        (place / "normals.png").write_text("new")
        raise RuntimeError
    assert list((tmp_path / "out").iterdir()) == []
    with appearing_at_once(target) as place:
        for name in ("normals.png", "normals.exr"):
            (place / name).write_text("first")
        names = write_record(place, {"a": 1})
        assert not target.exists()
    assert names == ["normals.exr", "normals.json", "normals.png"]
    (target / "notes.txt").write_text("the user's")
    with pytest.raises(RuntimeError), appearing_at_once(target) as place:
        (place / "normals.png").write_text("second")
        raise RuntimeError
    assert (target / "normals.png").read_text() == "first"
    with appearing_at_once(target) as place:
        (place / "normals.png").write_text("third")
        write_record(place, {})
    assert (target / "normals.png").read_text() == "third"
    left = sorted(p.name for p in target.iterdir())
    assert left == ["normals.json", "normals.png", "notes.txt"]
    record = json.loads((target / "normals.json").read_text())
    assert record == {"files": {"normals.png": hashlib.sha256(b"third").hexdigest()}}


def test_nothing_of_the_users_is_overwritten(tmp_path):
    source = tmp_path / "pot"
    source.mkdir()
    (source / "normals.png").write_text("ground truth")
    with pytest.raises(InputError, match="the photographs' own folder"):
        check_target(tmp_path / "x" / ".." / "pot", source)
    with pytest.raises(InputError, match="one with other files"):
        check_target(source, tmp_path)
    with pytest.raises(InputError, match="got a file"):
        check_target(source / "normals.png", tmp_path)
    check_target(tmp_path / "new", source)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / ".DS_Store").write_bytes(b"\0")  # by the file manager
    check_target(tmp_path / "empty", source)


def test_srgb_and_shading_of_known_values():
    linear = [0, 0.0031308, 0.0121702, 0.2140411, 1]
    expected = [0, 0.0404499, 0.1125, 0.5, 1]  # IEC 61966-2-1
    np.testing.assert_allclose(srgb_encode(np.array(linear)), expected, atol=1e-3)
    np.testing.assert_allclose(srgb_encode(np.array([-1, 2])), [0, 1], atol=1e-12)
    facing = np.float32([[[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0]]])
    cos, sin = np.cos(np.deg2rad(40)), np.sin(np.deg2rad(40))
    np.testing.assert_allclose(shade(facing, 0)[0], [cos, 0, sin, 0], atol=1e-6)
    np.testing.assert_allclose(shade(facing, 90)[0], [0, cos, sin, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("count", "dtype"), [(1, np.uint8), (2, np.uint16), (13, np.uint8)]
)
def test_sheet_shows_inputs_normals_and_lights(tmp_path, normals, count, dtype):
    mask = normals.any(axis=-1)
    images = np.zeros((count, *mask.shape, 3), dtype)
    images[..., 0] = np.iinfo(dtype).max // 255 * 200  # red photographs
    path = tmp_path / "sheet.png"
    title = "a $title_ \u7d75"
    write_sheet(path, images, normals, mask, title=title, subtitle="b", encoded=True)
    sheet = cv2.imread(str(path))[..., ::-1]
    height, width = sheet.shape[:2]
    assert width > 2 * height
    # The photographs lie left; colours are right way round.
    np.testing.assert_array_equal(sheet[200, 100], [200, 0, 0])
    # The middle of the normals faces the viewer.
    middle = sheet[84 + 368, 28 + 736 + 28 + 368]
    np.testing.assert_allclose(middle, [128, 128, 255], atol=3)
    # Radii of 25 and 17.5 pixels, of which 53 fill the block: half of them from its
    # middle n is 0.5.
    half = 736 / 53 * np.array([12.5, 8.75])
    for axis, (right, down) in enumerate(((half[0], 0), (0, -half[1]))):
        x, y = round(28 + 736 + 28 + 368 + right), round(84 + 368 + down)
        expected = np.array([128, 128, 238])
        expected[axis] = 191
        np.testing.assert_allclose(sheet[y, x], expected, atol=6)
    # The tile at the right is lit from the right: its object's right side is brighter.
    tile = sheet[84 + 248 : 84 + 488, 28 + 2 * 764 + 496 :][:, :240].mean(axis=-1)
    assert tile[60:180, 150:230].mean() > 2 * tile[60:180, 10:90].mean()
