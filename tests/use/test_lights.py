"""Lights of photographs, and base colours by them."""

import json
import warnings

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from lamp_photographs import (
    COLORS,
    DIRECTIONS,
    MASK,
    NORMALS,
    angles,
    photographs,
    texture,
)

from unips_jax import estimate_lights
from unips_jax.io.color import srgb_encode
from unips_jax.io.images import read_image_file, read_linear
from unips_jax.io.light_list import read_light_list
from unips_jax.io.results import RECORD, transfer_of
from unips_jax.lighting.harmonics import COSINE_LOBE, harmonics
from unips_jax.lighting.light_files import base_color, write_base_color, write_lights
from unips_jax.lighting.light_fit import irradiance
from unips_jax.viewer.result import maps_of


def test_lamps_are_found_without_guesses():
    lights = estimate_lights(photographs(), NORMALS, MASK)
    # Measured: 0.5 degrees and 0.03.
    assert angles(lights.directions, DIRECTIONS).max() < 1.5
    ratio = lights.colors / COLORS
    np.testing.assert_allclose(ratio / ratio.mean(0), 1, atol=0.06)
    assert (lights.directness == 1).all()


def test_surroundings_beside_the_lamp():
    images = photographs(ambient=0.4)
    # The mean direction of a lamp of irradiance E and even light of radiance 0.4 / pi.
    power = COLORS.mean(1) / (COLORS.mean(1) + 1.6)
    lights = estimate_lights(images, NORMALS, MASK, guesses=DIRECTIONS * power[:, None])
    np.testing.assert_allclose(lights.directions, DIRECTIONS, atol=1e-6)
    np.testing.assert_allclose(lights.directness, power, atol=1e-6)
    shading = irradiance(lights, NORMALS[MASK])
    true = photographs(ambient=0.4)[:, MASK] / texture()[MASK]
    ratio = shading / true
    error = np.abs(ratio / np.median(ratio, axis=(0, 1)) - 1)
    assert np.quantile(error, 0.95) < 0.08
    # What harmonics say of all light agrees with key and surroundings, up to order 2.
    key = harmonics(lights.directions)[..., None] * lights.colors[:, None]
    np.testing.assert_allclose(lights.harmonics - lights.surroundings, key, atol=1e-9)
    even = lights.surroundings[:, 0].mean() * 0.28209479 * COSINE_LOBE[0]
    assert even / lights.colors.mean() == pytest.approx(0.4 / COLORS.mean(), rel=0.25)


def test_there_is_no_negative_light():
    """As of a series of harmonics that is cut off."""
    lights = estimate_lights(photographs(), NORMALS, MASK, guesses=DIRECTIONS)
    dark = lights._replace(
        surroundings=lights.surroundings - 10 * (np.arange(9) == 0)[:, None]
    )
    assert (irradiance(dark, NORMALS[MASK]) == 0).all()


def test_light_without_a_direction_comes_from_the_viewer():
    guesses = DIRECTIONS * [[1], [0], [1], [1], [1]]
    lights = estimate_lights(photographs(0.4), NORMALS, MASK, guesses=guesses)
    np.testing.assert_array_equal(lights.directions[1], [0, 0, 1])
    assert lights.directness[1] == 0 and np.isfinite(lights.harmonics).all()


def test_stored_values_and_padding_do_not_matter():
    images = photographs()
    lights = estimate_lights(images, NORMALS, MASK)
    encoded = np.rint(65535 * srgb_encode(images / 3)).astype(np.uint16)
    same = estimate_lights(encoded, NORMALS, transfer="srgb")
    np.testing.assert_allclose(same.directions, lights.directions, atol=1e-3)
    np.testing.assert_allclose(same.colors, lights.colors, rtol=1e-2)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pixel_without_a_value_does_not_count(value):
    images = photographs()
    lights = estimate_lights(images, NORMALS, MASK)
    images[0, 20, 20, 0] = value
    found = estimate_lights(images, NORMALS, MASK)
    assert angles(found.directions, lights.directions).max() < 0.1
    np.testing.assert_allclose(found.colors, lights.colors, rtol=1e-2)
    images[1] = value
    with pytest.raises(ValueError, match="images: expected some finite pixels, got"):
        estimate_lights(images, NORMALS, MASK)


def test_arrays_of_jax_are_numpys():
    given = photographs()[:2], NORMALS, MASK
    expected = estimate_lights(*given)
    with warnings.catch_warnings(action="error"):  # float64, which JAX has not
        lights = estimate_lights(*map(jnp.asarray, given))
    np.testing.assert_allclose(lights.directions, expected.directions, atol=1e-6)
    lights = estimate_lights(*(each.tolist() for each in given))
    np.testing.assert_allclose(lights.directions, expected.directions, atol=1e-6)


def test_one_photograph_has_a_light():
    grey = np.where(MASK[..., None], photographs()[:1] / texture(), 0)
    lights = estimate_lights(grey.astype(np.float32), NORMALS, MASK)
    assert angles(lights.directions, DIRECTIONS[:1]).max() < 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"images": np.ones((2, 40, 40))}, r"images: expected \[N, H, W, 3\]"),
        ({"normals": np.ones((3, 3, 3))}, r"normals: expected \(40, 40, 3\)"),
        ({"normals": np.ones((40, 40, 3), np.uint8)}, "normals: expected floats of"),
        ({"mask": np.ones((2, 2))}, r"mask: expected \(40, 40\)"),
        ({"mask": np.zeros((40, 40))}, "expected some inside the mask, got none"),
        ({"guesses": np.ones((2, 3))}, r"guesses: expected \[N, 3\] = \(5, 3\)"),
    ],
)
def test_shapes_that_do_not_fit_are_named(arguments, message):
    given = {"images": photographs(), "normals": NORMALS, "mask": MASK, **arguments}
    with pytest.raises(ValueError, match=message):
        estimate_lights(**given)


def test_base_colour_without_highlights_and_seams(tmp_path, monkeypatch):
    for gloss in (False, True):
        images = photographs(gloss=gloss)
        lights = estimate_lights(images, NORMALS, MASK, guesses=DIRECTIONS)
        whole = base_color(images, NORMALS, MASK, lights)
        truth = texture()[MASK]
        truth = truth * (whole[MASK] * truth).sum(0) / np.square(truth).sum(0)
        error = np.abs(whole[MASK] / truth - 1)  # measured: 0.03, and 0.05 and 0.10
        assert np.median(error) < 0.04 and np.quantile(error, 0.9) < 0.14
    assert np.quantile(whole[MASK].max(-1), 0.99) == pytest.approx(0.8, abs=0.01)
    monkeypatch.setattr("unips_jax.lighting.light_fit._STRIP", 7 * 5 * 40)
    np.testing.assert_allclose(base_color(images, NORMALS, MASK, lights), whole, 1e-6)
    write_base_color(tmp_path, whole)
    picture = cv2.imread(str(tmp_path / "base_color.png"), cv2.IMREAD_UNCHANGED)
    encoded = np.rint(65535 * srgb_encode(whole[..., ::-1])).astype(int)
    assert np.abs(picture.astype(int) - encoded).max() <= 1
    # Read again it is the same light, by its tag; without one, as of earlier versions,
    # by its name.
    path, size = tmp_path / "base_color.png", whole.shape[:2]
    np.testing.assert_allclose(read_linear(path), whole, atol=1e-4)
    for _ in range(2):
        found = maps_of(tmp_path, size)["base_color"]
        np.testing.assert_allclose(found, whole, atol=1e-4)
        cv2.imwrite(str(path), picture)
    assert abs(read_linear(path) - whole).max() > 0.1
    assert transfer_of(read_image_file(path)) == "linear"
    (tmp_path / RECORD).write_text("{}")
    assert transfer_of(read_image_file(path)) == "srgb"


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.02])
def test_dark_and_saturated_paint_stays(noise):
    """On white: the cleaner the photographs, the less it fits what is typical."""
    paint = np.full((40, 40, 3), 0.8)
    patches = {
        (12, 15): (0.03,) * 3,
        (12, 22): (0.7, 0.04, 0.04),
        (24, 18): (0.1, 0.3, 0.1),
    }
    for (top, left), color in patches.items():
        paint[top : top + 5, left : left + 5] = color
    cosine = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, DIRECTIONS), 0)
    images = cosine[..., None] * paint
    rng = np.random.default_rng(0)
    images += noise * np.sqrt(images) * rng.standard_normal(images.shape)
    stored = np.uint8(np.rint(255 * srgb_encode(np.clip(images, 0, 1))))
    lights = estimate_lights(stored, NORMALS, MASK, guesses=DIRECTIONS, transfer="srgb")
    found = base_color(stored, NORMALS, MASK, lights, transfer="srgb")
    found *= 0.8 / np.median(found[MASK], axis=0)
    for (top, left), color in patches.items():
        patch = np.median(found[top : top + 5, left : left + 5], axis=(0, 1))
        np.testing.assert_allclose(patch, color, rtol=0.15, atol=0.04)


def test_lights_on_disk(tmp_path):
    lights = estimate_lights(photographs(), NORMALS, MASK)
    names = [f"{index}.png" for index in range(5)]
    (tmp_path / "marked").mkdir()
    write_lights(tmp_path, names, lights)
    write_lights(tmp_path / "marked", ["#1.png", *names[1:]], lights)
    listed = read_light_list(tmp_path / "marked" / "lights.lp")
    assert listed.names[0] == "#1.png" and not listed.problems
    count, *lines = (tmp_path / "lights.lp").read_text().splitlines()
    assert count == "5"
    for line, name, direction in zip(lines, names, DIRECTIONS, strict=True):
        file, *numbers = line.split()
        assert file == name
        np.testing.assert_allclose([float(x) for x in numbers], direction, atol=0.03)
    record = json.loads((tmp_path / "lights.json").read_text())["photographs"]
    assert [light["file"] for light in record] == names
    assert np.shape(record[0]["harmonics"]) == (9, 3)
    assert record[1]["intensity"] > 2 * record[2]["intensity"]
