"""Cameras and objects that moved between photographs: found, and moved back."""

import re

import numpy as np
import pytest
from capture_checks import STRIPES, check, moved
from plain_objects import lights, photographs

from unips_jax.capture.motion import Motion, _with_outlines, find_motion
from unips_jax.capture.outline import OutlineShifts, _edges
from unips_jax.capture.registration import _scaled, register
from unips_jax.capture.shading import light_of


@pytest.mark.parametrize("known", [True, False])
def test_photographs_that_moved(known):
    images, mask = photographs(5, **STRIPES)
    images[2] = moved(images[2], 7.3, -4.6)
    images[6] = moved(images[6], -30, 18)
    motion = find_motion(images, mask if known else None)
    assert np.flatnonzero(motion.moved).tolist() == [2, 6]
    np.testing.assert_allclose(motion.offsets[2], [7.3, -4.6], atol=0.6)
    np.testing.assert_allclose(motion.offsets[6], [-30, 18], atol=0.6)
    (finding,) = check(images, mask)
    assert re.match("moved: 2.png [89], 6.png 35 pixels from where", finding.text)
    assert finding.kind == "moved" and finding.files == ("2.png", "6.png")
    assert finding.figures["6.png"] == pytest.approx(35, abs=1)


def test_all_photographs_by_hand():
    images, mask = photographs(6, **STRIPES)
    places = np.random.default_rng(3).uniform(-12, 12, (8, 2))
    images = np.stack([moved(i, *p) for i, p in zip(images, places, strict=True)])
    motion = find_motion(images)
    expected = places - places[motion.reference]
    np.testing.assert_allclose(motion.offsets, expected, atol=0.7)


def test_a_moving_pool_of_light_and_highlights_are_no_movement():
    y, x = np.mgrid[:120, :160]
    pools = [
        np.exp(-(np.hypot(x - 80 - 40 * np.cos(a), y - 60 - 30 * np.sin(a)) ** 2) / 900)
        for a in np.arange(8) * 0.785
    ]
    images = np.repeat((25 + 200 * np.array(pools))[..., None], 3, -1).astype(np.uint8)
    assert not find_motion(images).moved.any()
    images, mask = photographs(7, gloss=4.0, albedo=(0.3,) * 3)
    assert not find_motion(images, mask).moved.any()


def sphere(seed, gloss):
    """Photographs of a sphere without any texture, on black, one lamp each."""
    rng = np.random.default_rng(seed)
    height, width = 120, 140
    y, x = np.mgrid[:height, :width]
    radius = rng.uniform(0.3, 0.42) * height
    u = (x - width * rng.uniform(0.45, 0.55)) / radius
    v = -(y - height * rng.uniform(0.45, 0.55)) / radius
    mask = u * u + v * v < 1
    normals = np.stack([u, v, np.sqrt(np.maximum(1 - u * u - v * v, 0))], axis=-1)
    normals *= mask[..., None]
    images = []
    for light in lights(8, rng.uniform(0, 360, 8), rng.uniform(30, 60)):
        half = light + [0, 0, 1]
        shine = np.maximum(normals @ (half / np.linalg.norm(half)), 0) ** 40
        light = np.maximum(normals @ light, 0) + gloss * shine
        noise = 0.005 * rng.standard_normal(mask.shape) * np.sqrt(light + 0.01)
        levels = np.rint(65535 * np.clip(0.8 * light + noise, 0, 1))
        images.append(np.repeat(levels[..., None], 3, axis=-1).astype(np.uint16))
    return np.stack(images), mask


@pytest.mark.parametrize("seed", [0, 5, 28])
def test_shading_is_not_movement(seed):
    images, mask = sphere(seed, gloss=0.5 * (seed % 2))
    assert not find_motion(images, mask).moved.any()
    assert not find_motion(images).moved.any()


BACKDROPS = {
    "stripes": STRIPES,
    "plain": {},
    "glossy": {"albedo": (0.25, 0.2, 0.2), "gloss": 3.0, "background": 0.005},
    "grey": {"albedo": (0.8,) * 3, "background": 0.12, "vignette": 0.8},
    "sphere": None,
}


@pytest.mark.parametrize("name", BACKDROPS)
def test_shifts_of_three_pixels(name):
    """At least 19 of 20 are found, and still photographs are silent."""
    found = 0
    for seed in range(40, 60):
        options = BACKDROPS[name]
        images, mask = (
            sphere(seed, gloss=0.5 * (seed % 2))
            if options is None
            else photographs(seed, size=(150, 170), **options)
        )
        if seed % 4 == 0:
            assert not find_motion(images, mask).moved.any()
        angle, which = 40 * seed, seed % 8
        shift = 3 * np.cos(angle), 3 * np.sin(angle)
        images[which] = moved(images[which], *shift)
        motion = find_motion(images, mask)
        right = np.flatnonzero(motion.moved).tolist() == [which]
        found += right and np.hypot(*(motion.offsets[which] - shift)) < 1
    assert found >= 19


def test_pictures_of_light_are_linear():
    for levels, light in ((np.uint8(128), 0.2159), (np.uint16(32768), 0.5)):
        found = light_of(np.full((9, 9, 3), levels), 1.0)
        np.testing.assert_allclose(found, light, atol=1e-4)


@pytest.mark.parametrize("edge", [-2.4, 0.1, 0.3, 1.7])
def test_edges_are_found_between_the_steps(edge):
    x = np.arange(60, dtype=np.float32)
    grey = np.tile(1 / (1 + np.exp((x - 30 - edge) / 1.2)), (40, 1))
    places = np.stack([np.full(20, 30), np.arange(10, 30)], -1).astype(np.float32)
    outward = np.tile(np.float32([1, 0]), (20, 1))
    found, clear = _edges(grey.astype(np.float32), places, outward)
    np.testing.assert_allclose(found, edge, atol=0.1)
    assert clear.all()


@pytest.mark.parametrize(("count", "believed"), [(3, True), (4, False)])
def test_outlines_that_lie_apart_in_most_photographs_move_none(count, believed):
    offsets = np.zeros((6, 2))
    offsets[:count] = 5, -2
    agree, still = (np.where(offsets.any(1), *x) for x in ((0.9, 0), (0.1, 0.9)))
    stood = Motion(np.zeros((6, 2)), np.ones(6), 5, 1.5)
    found = _with_outlines(stood, OutlineShifts(offsets, agree, still))
    np.testing.assert_array_equal(found.offsets, believed * offsets)
    assert found.moved.sum() == believed * count


def test_registration_undoes_shifts_and_turns():
    still, _ = photographs(8, size=(360, 440), **STRIPES)
    images = still.copy()
    images[3] = moved(images[3], 6.4, -9.7, 1.2)
    images[5] = moved(images[5], -20.5, 3.2)
    back, valid, maps = register(images, find_motion(images))
    turn = np.degrees(np.arctan2(maps[3][0, 1], maps[3][0, 0]))
    assert turn == pytest.approx(1.2, abs=0.15)
    np.testing.assert_allclose(maps[5][:, 2], [-20.5, 3.2], atol=0.3)
    assert valid.mean() > 0.85 and back.dtype == np.uint8
    for index, share in ((3, 0.3), (5, 0.3)):
        before, after = (
            np.abs(stack[index].astype(float) - still[index])[valid].mean()
            for stack in (images, back)
        )
        assert after < share * before
    for index in (0, 1, 2, 4, 6, 7):
        np.testing.assert_array_equal(back[index], images[index])


def test_maps_of_smaller_pictures_agree_at_the_middles_of_pixels():
    matrix = np.array([[0.98, -0.1, 3.0], [0.1, 0.98, -7.0]])
    small = _scaled(matrix, 0.25)
    place = np.array([13.0, 40.0])

    def reduced(place):
        return 0.25 * (place + 0.5) - 0.5

    np.testing.assert_allclose(
        small @ [*reduced(place), 1], reduced(matrix @ [*place, 1])
    )


def test_where_a_moved_photograph_shows_nothing_is_told():
    """And sharp edges between black and white leave no light below zero."""
    rng = np.random.default_rng(0)
    wide = np.kron(rng.integers(0, 2, (18, 18)), np.ones((6, 6), np.float32))
    wide = np.repeat(wide[..., None], 3, -1).astype(np.float32)
    images = np.stack([wide[8:88, 8:98]] * 4)
    images[2] = wide[4:84, 2:92]  # what it shows lies 6 to the right and 4 below
    offsets = np.array([[0, 0], [0, 0], [6, 4], [0, 0]], float)
    found, valid, _ = register(images, Motion(offsets, np.ones(4), 0, 1.5))
    assert valid[:75, :83].all() and not valid[-3:].any() and not valid[:, -5:].any()
    np.testing.assert_allclose(found[2][valid], images[0][valid], atol=0.05)
    assert found.min() >= 0
