"""Kinds of light, from networks that have tokens for them, and what is made of them."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from lamp_photographs import DIRECTIONS, MASK, NORMALS, angles, photographs
from small_networks import SHALLOW_OURS, lively_network

from unips_jax.estimation.extras import estimate_extras, key_lights, write_extras
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.streaming import NormalsAndLights, estimate_with_lights
from unips_jax.estimation.writing import Estimate
from unips_jax.lighting.rig import read_rig
from unips_jax.models.encoding import Guesses
from unips_jax.models.light_tokens import LightGuess
from unips_jax.models.network import Encoding, Lamps, guessed_lamps

KINDS = dataclasses.replace(SHALLOW_OURS, light_tokens=True)


def encoding(near, near_share, distant, distant_share):
    """Of an object seen as it is and mirrored; the guesses are as in the images."""
    logits = [
        jnp.log(jnp.clip(jnp.array(s), 1e-6, 1 - 1e-6))
        for s in (near_share, distant_share)
    ]
    logits = [x - jnp.log1p(-jnp.exp(x)) for x in logits]
    sides = jnp.array([[[1, 1, 1]], [[-1, 1, 1]]])
    directions = [jnp.array(x, jnp.float32) * sides for x in (near, distant)]
    shares = [jnp.stack([x, x]) for x in logits]
    none = jnp.zeros((2, len(near)))
    kinds = LightGuess(none, directions[0], none, shares[0], directions[1], shares[1])
    mirrored = jnp.array([False, True])
    return Encoding(none, None, mirrored, None, Guesses(none, none, kinds))


def test_the_lamp_is_the_one_that_gives_more_light():
    right, up = [1.0, 0, 1], [0, 2.0, 0]
    given = encoding([right] * 3, [0.9, 0.0, 0.01], [up] * 3, [0, 0.6, 0.02])
    found = guessed_lamps(given)
    np.testing.assert_allclose(found.shares, [0.9, 0.6, 0.03], atol=1e-4)
    expected = np.array([right, up])
    assert angles(found.directions[:2], expected).max() < 0.1
    known = jnp.array([[0, 0, 1.0], [0, 0, 0], [0, 0, 0]])
    views = jnp.stack([known, known * jnp.array([-1, 1, 1])])
    moved = guessed_lamps(given, views)
    assert angles(moved.directions[:1], np.array([[0, 0, 1]])).max() < 0.2
    np.testing.assert_allclose(moved.directions[1:], found.directions[1:], atol=1e-6)


def test_photographs_have_lamps_whichever_way_round_they_are():
    rng = np.random.default_rng(0)
    images = rng.uniform(0.1, 1, (5, 20, 24, 3)).astype(np.float32)  # padded to six
    mask = np.zeros((20, 24), bool)
    mask[2:18, 3:21] = True
    network = lively_network(KINDS)
    lamps = estimate_with_lights(network, images, mask).lamps
    assert lamps.directions.shape == (5, 3)
    assert ((lamps.shares >= 0) & (lamps.shares <= 1)).all()
    np.testing.assert_allclose(np.linalg.norm(lamps.directions, axis=1), 1, atol=1e-5)
    turned = estimate_with_lights(network, images[:, :, ::-1], mask[:, ::-1]).lamps
    np.testing.assert_allclose(
        turned.directions * [-1, 1, 1], lamps.directions, atol=1e-4
    )
    np.testing.assert_allclose(turned.shares, lamps.shares, atol=1e-5)


def test_the_key_light_is_the_lamp_or_the_mean_of_surroundings():
    mean, lamp = np.float32([[0, 0.4, 0.3]]), np.float32([[0.6, 0, 0.8]])

    def key(share):
        return key_lights(mean, Lamps(lamp, np.float32([share])))

    np.testing.assert_allclose(key(1.0), lamp, atol=1e-6)
    np.testing.assert_allclose(key(0.25), 0.25 * lamp, atol=1e-6)
    np.testing.assert_allclose(key(0.0), mean, atol=1e-6)
    steps = np.concatenate([key(share) for share in np.linspace(0, 1, 201)])
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 0.05  # no jump
    assert key_lights(mean, None) is mean and key_lights(None, None) is None


def test_lights_on_disk_have_kinds(tmp_path):
    """The lamp beside even light: its direction, its share, its kind."""
    images = photographs(0.4)
    names = [f"{index}.png" for index in range(5)]
    shares = np.float32([0.75, 0.5, 0.25, 0.2, 1.0])
    # As if surroundings from above had drawn the mean of all light upwards.
    means = DIRECTIONS * shares[:, None] + [0, 0.3, 0]
    options = FolderOptions(lights=True)

    def written(lamps):
        found = NormalsAndLights(NORMALS, means, lamps)
        extras = estimate_extras(None, images, MASK, found, "linear", options)
        given = images, MASK, "linear", NORMALS, {"images": names}, None, extras
        write_extras(tmp_path, Estimate(*given, None), options)
        return json.loads((tmp_path / "lights.json").read_text())

    before = written(None)["photographs"]
    assert "kind" not in before[0] and "lamp_share" not in before[0]
    content = written(Lamps(np.float32(DIRECTIONS), shares))
    assert {"kind", "lamp_share"} <= set(content["conventions"])
    lights = content["photographs"]
    kinds = ["lamp", "both", "both", "surroundings", "lamp"]
    assert [light["kind"] for light in lights] == kinds
    assert [light["lamp_share"] for light in lights] == pytest.approx(shares)
    towards = np.array([light["direction"] for light in lights])
    off = angles(towards, DIRECTIONS)
    assert off[shares >= 0.25].max() < 0.1 < off[3]
    assert angles(np.array([x["direction"] for x in before]), DIRECTIONS).max() > 10
    assert len(read_rig(tmp_path).directions) == 5
