"""What Cycles renders, against closed forms and against our own scenes.

Needs a Python with `bpy` (`UNIPS_BPY_PYTHON`); skipped without, unless
`UNIPS_REQUIRE_BPY` is set.
"""

import os
import signal
import subprocess
import sys
import time

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from blender_runs import LAMBERTIAN, SIZE, build, opened, photograph, sphere, sun

from unips_jax.cli import render
from unips_jax.cycles import assets, run
from unips_jax.cycles.environments import HEIGHT, WIDTH
from unips_jax.lighting.reflectance import Surface, reflectance

METAL = {"Base Color": [0.8, 0.5, 0.2], "Roughness": 0.5, "Metallic": 1.0}
TOWARDS = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])


@pytest.fixture(scope="module")
def blender():
    with opened() as process:
        yield process


def test_normals_of_a_sphere_are_exact_and_in_place(blender):
    normals, mask = sphere(256)
    truth = build(blender, METAL, 256)
    np.testing.assert_array_equal(truth.mask, mask)
    apart = np.linalg.norm(np.cross(truth.normals, normals), axis=-1)[mask]
    error = np.rad2deg(np.arcsin(np.minimum(apart, 1)))
    # The worst pixels touch the outline of what is a polyhedron after all.
    assert np.percentile(error, 99.9) < 0.05 and error.mean() < 0.005
    np.testing.assert_allclose(truth.depth[mask], 10 - normals[mask][:, 2], atol=4e-3)
    for name, value in (("roughness", 0.5), ("metal", 1.0)):
        np.testing.assert_allclose(truth.maps[name][mask], value, atol=1e-6)
    np.testing.assert_allclose(truth.maps["baseColor"][mask][:, 1], 0.5, atol=1e-6)
    assert not truth.normals[~mask].any()


def test_a_lambertian_sphere_is_albedo_times_cosine(blender):
    normals, mask = sphere()
    truth = build(blender, LAMBERTIAN)
    image = photograph(blender, truth.mask, sun(TOWARDS))
    cosine = np.maximum(normals @ TOWARDS, 0)
    inner = mask & (cosine > 0.1) & (normals[..., 2] > 0.3)
    expected = cosine[..., None] * LAMBERTIAN["diffuse"]
    np.testing.assert_allclose(image[inner], expected[inner], rtol=0.03)
    assert np.mean(image[inner] / expected[inner]) == pytest.approx(1, abs=3e-3)
    dark = mask & (normals @ TOWARDS < -0.15) & (normals[..., 2] > 0.3)
    assert image[dark].max() == 0


def test_a_rough_metal_sphere_agrees_with_our_scenes(blender):
    normals, mask = sphere()
    truth = build(blender, METAL)
    image = photograph(blender, truth.mask, sun(TOWARDS))
    half = (TOWARDS + [0, 0, 1]) / np.linalg.norm(TOWARDS + [0, 0, 1])
    inner = mask & (normals @ TOWARDS > 0.1) & (normals[..., 2] > 0.3)
    n = normals[inner]
    surface = Surface(
        base_color=jnp.asarray(METAL["Base Color"])[:, None],
        roughness=jnp.float32(METAL["Roughness"]),
        metallic=jnp.float32(1),
        specular=jnp.float32(1),
    )
    ours = reflectance(
        surface,
        n_l=jnp.asarray(n @ TOWARDS),
        n_v=jnp.asarray(n[:, 2]),
        n_h=jnp.asarray(n @ half),
        v_h=jnp.float32(half[2]),
        widening=jnp.float32(0),
    )
    expected = np.pi * np.asarray(ours).T * (n @ TOWARDS)[:, None]
    ratio = image[inner] / expected
    assert np.mean(ratio) == pytest.approx(1, abs=0.01)
    assert np.percentile(np.abs(ratio - 1), 99) < 0.03


def test_light_adds_up(blender):
    mask = build(blender, METAL).mask
    lamps = [sun(TOWARDS), sun([-0.5, 0.1, 0.7], 2.0)]
    one, two = (photograph(blender, mask, lamp) for lamp in lamps)
    both = photograph(blender, mask, *lamps, seed=5, samples=256)
    assert np.mean(both) == pytest.approx(np.mean(one + two), rel=5e-3)
    difference = np.linalg.norm(both - one - two) / np.linalg.norm(both)
    assert difference < 0.03


def test_a_white_furnace_shows_the_albedo(blender):
    mask = build(blender, LAMBERTIAN).mask
    image = photograph(blender, mask, environment={"color": [1, 1, 1]})
    colors = image[mask].mean(0)
    np.testing.assert_allclose(colors, LAMBERTIAN["diffuse"], rtol=5e-3)


def test_the_top_of_an_environment_is_above(blender, tmp_path):
    picture = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    picture[: HEIGHT // 8] = 1
    path = tmp_path / "top.hdr"
    cv2.imwrite(str(path), picture)
    mask = build(blender, LAMBERTIAN).mask
    around = {"file": str(path), "rotation": [np.pi / 2, 0, 1.0], "strength": 1.0}
    image = photograph(blender, mask, environment=around).mean(-1)
    normals, _ = sphere()
    slope, *_ = np.linalg.lstsq(
        normals[mask & (normals[..., 1] > 0.3)],
        image[mask & (normals[..., 1] > 0.3)],
        rcond=None,
    )
    assert slope[1] > 0 and abs(slope[0]) + abs(slope[2]) < 0.05 * slope[1]


def test_perspective_is_a_pinhole(blender):
    """A sphere placed by hand: its outline is where geometry says."""
    blender.ask("build", shape={"kind": "sphere"}, material={"uniform": LAMBERTIAN})
    blender.ask("place", rotation=[1, 0, 0, 0], focal_mm=35.0)
    truth = run.read_truth(blender.picture("truth", size=SIZE))
    ys, xs = np.nonzero(truth.mask)
    assert (xs.min(), xs.max(), ys.min(), ys.max()) == (0, SIZE - 1, 0, SIZE - 1)
    c = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    x, y = np.meshgrid(c * 18 / 35, -c * 18 / 35)
    away = np.stack([x, y, -np.ones_like(x)], -1) * truth.depth[..., None]
    points = away[truth.mask]  # in the camera's frame
    center = np.array([0, 0, -np.hypot(1, 70 / 36)])
    radius = np.linalg.norm(points - center, axis=1)
    np.testing.assert_allclose(radius, radius.mean(), rtol=2e-3)
    outward = (points - center) / radius[:, None]
    np.testing.assert_allclose(truth.normals[truth.mask], outward, atol=4e-3)


@pytest.mark.parametrize("kind", assets.SHAPES)
def test_drawn_objects_have_varied_normals_in_the_frame(blender, kind):
    index = assets.SHAPES.index(kind)
    job = assets.drawn_jobs(7, 3)[index]
    settings = run.Settings(size=SIZE)
    facts = run.pose(blender, job, settings, np.random.default_rng(0))
    assert facts["entropy_bits"] > 4
    truth = run.read_truth(blender.picture("truth", size=128))
    ys, xs = np.nonzero(truth.mask)
    assert max(np.ptp(xs), np.ptp(ys)) >= 125  # the outline reaches the frame
    assert (truth.normals[truth.mask][:, 2] > -0.02).mean() > 0.99
    assert truth.maps["baseColor"][truth.mask].std() > 0.003


def test_killed_and_started_again_it_ends_with_the_same_bytes(blender, tmp_path):
    arguments = ["--objects", "1", "--images", "2", "--size", "32", "--samples", "2"]
    command = ["render", "--engine", "cycles", *arguments, "--seed", "3"]
    assert render.main([*command[1:], "-o", str(tmp_path / "whole")]) == 0
    out = tmp_path / "killed"
    start = [sys.executable, "-m", "unips_jax.cli.main", *command, "-o", str(out)]
    process = subprocess.Popen(start, start_new_session=True)
    while not list(out.glob("*/*.data")):
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert render.main([*command[1:], "-o", str(out)]) == 0
    whole = [p for p in sorted((tmp_path / "whole").glob("*/*/*")) if p.is_file()]
    assert len(whole) == 3 * 9
    for path in whole:
        twin = out / path.relative_to(tmp_path / "whole")
        assert path.read_bytes() == twin.read_bytes(), path
