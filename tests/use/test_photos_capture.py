"""Warnings about poor captures."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from unips_jax.capture import prepare
from unips_jax.capture.advice import look_at_values
from unips_jax.capture.masks import mask_picture, toggle_piece
from unips_jax.io.color import srgb_encode
from unips_jax.io.photographs import Capture


def capture_warnings(images, mask, names):
    return [finding.text for finding in look_at_values(images, mask, names)]


def sphere_images(count=8, dtype=np.uint8, size=96):
    """A matte sphere under lights all around, well exposed; and its mask."""
    axis = np.linspace(-1.1, 1.1, size)
    x, y = np.meshgrid(axis, -axis)
    z2 = 1 - x**2 - y**2
    mask = z2 > 0
    normals = np.stack([x, y, np.sqrt(np.maximum(z2, 0))], axis=-1)
    angles = np.arange(count) * 2 * np.pi / count
    lights = np.stack([np.cos(angles), np.sin(angles), np.ones(count)], axis=-1)
    shading = np.maximum(np.einsum("hwc,nc->nhw", normals, lights / 2**0.5), 0)
    images = np.repeat(0.9 * shading[..., None], 3, axis=-1) * mask[..., None]
    if dtype != np.float32:
        images = images * np.iinfo(dtype).max
    return images.astype(dtype), mask, [f"{i}.png" for i in range(count)]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_good_captures_pass(dtype):
    assert capture_warnings(*sphere_images(dtype=dtype)) == []


def test_too_few_images():
    (line,) = capture_warnings(*sphere_images(3))
    assert line.startswith("too few photographs: 3;")


def test_tiny_mask():
    images, mask, names = sphere_images(size=30)
    (line,) = capture_warnings(images, mask, names)
    assert line.startswith(f"tiny mask: {mask.sum()} pixels")


def test_identical_images_are_named():
    images, mask, names = sphere_images()
    images[5] = images[2] // 2  # the same light, half as bright
    (line,) = capture_warnings(images, mask, names)
    assert line.startswith("nearly identical photographs: 2.png = 5.png;")
    images[:] = images[:1]
    (line,) = capture_warnings(images, mask, names)
    assert line.startswith("nearly identical photographs: shading differs by 0.0% at")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_exposure(dtype):
    images, mask, names = sphere_images(dtype=dtype)
    full = np.iinfo(dtype).max
    images[1] = np.where(images[1] > full * 0.4, full, images[1])
    images[6] = np.minimum(images[6] // (full // 20), 16)  # a level that many have
    bright, dark = capture_warnings(images, mask, names)
    assert bright.startswith("saturated: 1.png ") and "6.png" not in bright
    said = (
        "underexposed: .* 6.png 1" if dtype == np.uint8 else "hardly any light: 6.png"
    )
    assert re.match(said, dark)


def test_light_beside_the_object_alone_is_not_saturated():
    images, mask, names = sphere_images(dtype=np.float32)
    images[3] = ~mask[..., None]
    (line,) = capture_warnings(images, mask, names)
    assert line.startswith("hardly any light: 3.png reaches 0.0%")


def test_exposure_is_that_of_the_camera():
    """Not that of what a dark frame leaves, in 16 bits."""
    images, mask, names = sphere_images()
    images[1] = np.where(images[1] > 100, 255, images[1])
    images[6] //= 10
    left = np.maximum(images.astype(int) - 3, 0) * mask[..., None]
    found = look_at_values((left * 257).astype(np.uint16), mask, names, taken=images)
    bright, dark = [finding.text for finding in found]
    assert bright.startswith("saturated: 1.png ") and "1.png" not in dark
    assert dark.startswith("underexposed: ") and "6.png 2" in dark


def test_samples_are_taken_inside_the_mask():
    images, _, names = sphere_images(size=400)
    images[:, ::2, ::2] = 255
    mask = np.zeros((400, 400), bool)
    mask[1::2, 1::2] = images[0, 1::2, 1::2, 0] > 0
    lines = capture_warnings(images, mask, names)
    assert not any(line.startswith("saturated") for line in lines)


def test_specks_islands_and_pinholes_of_the_mask():
    images, mask, names = sphere_images(size=120)
    images[:] = np.maximum(images, 40)  # some light everywhere
    mask[2:4, 2:5] = mask[-1, 0] = True
    (line,) = capture_warnings(images, mask, names)
    assert line.startswith("specks in the mask: 2 of together 7 pixels ")
    mask[2:4, 2:5] = mask[-1, 0] = False
    mask[:15, :15] = True
    (line,) = capture_warnings(images, mask, names)
    assert line.startswith("mask in 2 parts (98%, 2%): one object ")
    mask[:15, :15] = False
    mask[50:53, 60:62] = mask[70, 40] = False
    mask[80:100, 50:70] = False  # as a key's: meant
    (line,) = capture_warnings(images, mask, names)
    assert line.startswith("small holes in the mask: 2 of together 7 pixels;")
    # A whole image, and an object that reaches the image's border, have no holes.
    assert capture_warnings(images, np.ones_like(mask), names) == []
    half = np.zeros_like(mask)
    half[60:, 20:100] = True
    half[110:, 50:60] = False
    assert capture_warnings(images, half[:, ::-1], names) == []


def test_a_found_mask_keeps_out_what_was_left_out(monkeypatch):
    """Such as what is black in all photographs; small specks of it are the object's."""
    images = np.full((3, 60, 60, 3), 120, np.uint8)
    images[:, :25], images[:, 40, 30] = 0, 0
    found = np.zeros((60, 60), bool)
    found[10:50, 10:50] = True
    guess = SimpleNamespace(mask=found, figure=1.0, rule="edges")
    monkeypatch.setattr(prepare, "suggest_mask", lambda *_, **__: guess)
    capture = Capture(images, images[0].any(axis=-1), "srgb")
    mask = prepare.with_suggested_mask(capture).mask
    expected = found.copy()
    expected[:25] = False
    np.testing.assert_array_equal(mask, expected)
    opaque = np.ones_like(found)
    opaque[45, 20] = expected[45, 20] = False
    capture = Capture(images, images[0].any(axis=-1) & opaque, "srgb", opaque=opaque)
    np.testing.assert_array_equal(prepare.with_suggested_mask(capture).mask, expected)


def test_a_diagonal_line_closes_a_hole_and_is_one_piece():
    away = np.abs(np.arange(40) - 12)
    away = away[:, None] + away
    picture = np.full((40, 40, 3), 40, np.uint8)
    picture[:12] = 200
    mask = away == 7
    mask[:, 24:] = True
    filled = toggle_piece(mask, picture, (12, 14))
    np.testing.assert_array_equal(filled, mask | (away < 7))
    np.testing.assert_array_equal(
        toggle_piece(mask, picture, (12, 5)), mask & (away != 7)
    )


@pytest.mark.parametrize("turns", range(4))
def test_what_reaches_the_frame_is_no_hole(turns):
    """Of it only what has the colour that was clicked is taken."""
    picture = np.full((40, 40, 3), 40, np.uint8)
    picture[:12] = 200
    mask, upper = np.ones((40, 40), bool), np.zeros((40, 40), bool)
    mask[8:16, 30:], upper[8:12, 30:] = False, True
    spot = np.zeros((40, 40), bool)
    spot[10, 35] = True
    picture, mask, upper, spot = (
        np.rot90(x, turns) for x in (picture, mask, upper, spot)
    )
    ((y, x),) = np.argwhere(spot)
    found = toggle_piece(np.ascontiguousarray(mask), picture, (x, y))
    np.testing.assert_array_equal(found, mask | upper)


def test_a_picture_to_draw_on_is_the_same_of_linear_light():
    linear = np.ones((2, 20, 20, 3), np.float32)
    linear[:, 0, 0] = 0.1, 0.215, 0.5
    picture = mask_picture(linear, transfer="linear")
    assert picture[0, 0].tolist() == [89, 128, 188] and picture[1, 1].min() == 255
    levels = np.rint(255 * srgb_encode(linear)).astype(np.uint8)
    np.testing.assert_array_equal(mask_picture(levels), picture)
