"""Lamps that are near: their falloff is no colour and no relief."""

import dataclasses
import json

import numpy as np
import pytest
from plain_objects import hemisphere

from unips_jax import estimate_lights
from unips_jax.errors import InputError
from unips_jax.estimation.extras import Extras, estimate_extras, write_extras
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.streaming import NormalsAndLights
from unips_jax.estimation.writing import Estimate
from unips_jax.lighting import near, ptm
from unips_jax.lighting.light_files import base_color

SIZE, DISTANCE = 48, 1.3
NORMALS, MASK, _ = hemisphere(SIZE)
DIRECTIONS = np.array(
    [[0.6, 0.2, 0.8], [-0.6, 0.1, 0.7], [0, 0.7, 0.6], [0.1, -0.6, 0.8], [0, 0, 1]]
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
POWERS = np.array([1, 1.5, 0.7, 1, 1.2])
# A hemisphere's places are its normals, as long as its radius.
RADIUS = np.sqrt(MASK.sum() / np.pi) / SIZE
PLACES = NORMALS * RADIUS - [0, 0, 0.7 * RADIUS]


def photographs():
    """By the law of distances, pixel by pixel: every lamp has the power 1 at 1."""
    images = np.zeros((len(DIRECTIONS), SIZE, SIZE, 3), np.float32)
    for image, direction, power in zip(images, DIRECTIONS, POWERS, strict=True):
        for row, column in np.argwhere(MASK):
            to = DISTANCE * direction - PLACES[row, column]
            squared = to @ to
            cosine = max(NORMALS[row, column] @ to, 0) / np.sqrt(squared)
            image[row, column] = power * cosine / squared * np.array([0.6, 0.5, 0.4])
    return images


IMAGES = photographs()
FIELD = near.NearField(DISTANCE, PLACES.astype(np.float32))


def test_lamps_have_the_law_of_distances():
    normal, place = np.array([[0.0, 0.6, 0.8]]), np.array([[0.1, -0.2, 0.05]])
    (value,) = near.cosines(np.array([[0.0, 0.0, 1.0]]), normal, 2.0, place)
    to = np.array([-0.1, 0.2, 1.95])
    assert value[0] == pytest.approx(
        4 * (to @ normal[0]) / np.linalg.norm(to) ** 3, rel=1e-12
    )
    far = near.cosines(DIRECTIONS, NORMALS[MASK], 1e5, PLACES[MASK])
    np.testing.assert_allclose(far, near.cosines(DIRECTIONS, NORMALS[MASK]), atol=1e-4)
    strength = near.falloffs(DIRECTIONS, 2.0, place)
    np.testing.assert_allclose(
        strength[:, 0], 4 / np.square(2 * DIRECTIONS - place).sum(-1)
    )


def test_base_colour_is_even_where_the_surface_is():
    def unevenness(field):
        lights = estimate_lights(IMAGES, NORMALS, MASK, guesses=DIRECTIONS, near=field)
        color = base_color(IMAGES, NORMALS, MASK, lights)[MASK]
        return np.abs(color / np.median(color, 0) - 1).mean(), lights

    (known, lights), (unknown, _) = unevenness(FIELD), unevenness(None)
    assert known < 0.005 < 0.1 < unknown  # measured: 0.0006 and 0.20
    ratio = lights.colors / POWERS[:, None]
    np.testing.assert_allclose(ratio / ratio.mean(), 1, atol=0.05)


def test_the_texture_map_has_even_light(monkeypatch):
    lights = estimate_lights(IMAGES, NORMALS, MASK, guesses=DIRECTIONS, near=FIELD)
    fit = ptm.fit_texture_map(IMAGES, MASK, lights)
    (_, inside, _, values), *rest = fit.strips()
    assert not rest
    whole = ptm.equalised(IMAGES, "linear", lights, fit.white)
    np.testing.assert_allclose(values, whole[:, inside], atol=1e-6)
    monkeypatch.setattr("unips_jax.lighting.light_fit._STRIP", 5 * 7 * SIZE)
    parts = [values for *_, values in fit.strips()]
    assert len(parts) == 7
    np.testing.assert_allclose(np.concatenate(parts, 1), values, atol=1e-6)
    # As distant lamps of one power at the middle: towards each side equally bright.
    linear = np.where(whole < 0.04045, whole / 12.92, ((whole + 0.055) / 1.055) ** 2.4)
    to = DISTANCE * DIRECTIONS[:, None] - PLACES[MASK]
    to /= np.linalg.norm(to, axis=-1, keepdims=True)
    shading = np.maximum(np.einsum("npk,pk->np", to, NORMALS[MASK]), 0)
    lit = (shading > 0.2) & (linear[:, MASK, 0] < 0.99)
    ratio = linear[:, MASK, 0][lit] / shading[lit]
    assert np.abs(ratio / np.median(ratio) - 1).mean() < 0.03


def test_the_option_takes_the_depth_of_the_normals(tmp_path):
    options = FolderOptions(base_color=True, lights=True, lamp_distance=DISTANCE)
    found = NormalsAndLights(NORMALS.astype(np.float32), DIRECTIONS)

    def extras(options, rig=None):
        return estimate_extras(None, IMAGES, MASK, found, "linear", options, rig=rig)

    lights = extras(options).lights
    off = lights.near.places[MASK] - PLACES[MASK]  # in widths
    assert np.abs(off[:, :2]).max() < 0.02
    assert np.std(off[:, 2]) < 0.01  # the middle's depth is where the median is
    assert extras(options, lights._replace(near=None)).lights.near.distance == DISTANCE
    record = {"images": [f"{index}.png" for index in range(5)]}
    estimate = Estimate(
        IMAGES, MASK, "linear", found.normals, record, None, Extras(lights)
    )
    write_extras(tmp_path, estimate, options)
    written = json.loads((tmp_path / "lights.json").read_text())
    assert written["lamp_distance"] == DISTANCE
    with pytest.raises(InputError, match="--lamp-distance 0.4: expected lamps away"):
        extras(dataclasses.replace(options, lamp_distance=0.4))
    for wrong, text in ((-1, "widths of a photograph"), (float("nan"), "widths")):
        with pytest.raises(InputError, match=f"--lamp-distance: expected {text}"):
            FolderOptions(rti=True, lamp_distance=wrong).check()
    with pytest.raises(InputError, match="--lamp-distance: expected something to"):
        FolderOptions(lamp_distance=2.0).check()
