"""What `unips estimate` writes beside normals and depth, and confidence."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from colour_profiles import P3
from estimate_runs import pot, run
from lamp_photographs import (
    DIRECTIONS,
    MASK,
    NORMALS,
    angles,
    photographs,
    read_planes,
    read_ptm,
)
from PIL import Image
from small_networks import SHALLOW_OURS, lively_network

from unips_jax import estimate_lights
from unips_jax.cli.estimate import main as estimate
from unips_jax.errors import InputError
from unips_jax.estimation import confidence, writing
from unips_jax.estimation.extras import (
    estimate_extras,
    write_confidence,
    write_extras,
)
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.streaming import NormalsAndLights, estimate_with_lights
from unips_jax.estimation.writing import Estimate
from unips_jax.io.color import icc_to_srgb, srgb_encode
from unips_jax.io.images import read_image
from unips_jax.io.photographs import read_photographs, select
from unips_jax.lighting import ptm
from unips_jax.lighting.light_files import write_base_color
from unips_jax.weights import save_weights


def test_the_texture_map_relights_like_the_photographs(tmp_path):
    images = photographs()
    lights = estimate_lights(images, NORMALS, MASK)
    fit = ptm.fit_texture_map(images, MASK, lights)
    facts = ptm.write_ptm(tmp_path / "relight.ptm", fit)
    ptm.write_planes(tmp_path, fit)
    show, web = read_ptm(tmp_path / "relight.ptm"), read_planes(tmp_path)
    expected = ptm.equalised(images, "linear", lights, facts["white"])
    bright = np.quantile(expected[:, MASK], 0.995)
    assert bright == pytest.approx(srgb_encode(0.95), abs=0.01)
    error = []
    for image, (x, y, _) in zip(expected, lights.directions, strict=True):
        shown = show(x, y)
        assert (shown[~MASK] < 0.02).all()
        error.append(np.square(shown - image)[MASK].mean())
        assert np.abs(web(x, y) - shown)[MASK].mean() < 0.01
        assert web(x, y)[~MASK].mean() < 0.02  # JPEGs ring
    psnr = -10 * np.log10(np.mean(error))
    assert psnr == pytest.approx(facts["psnr_db"], abs=0.1) and psnr > 27
    # Moving the light to the right brightens what faces right; the same upwards.
    right, up = show(0.7, 0) - show(-0.7, 0), show(0, 0.7) - show(0, -0.7)
    assert right[20, 33].min() > 0.1 > -0.1 > right[20, 6].max()
    assert up[6, 20].min() > 0.1 > -0.1 > up[33, 20].max()


def test_halves_are_halves():
    halves = confidence._halves(7, 2, 0)
    assert [len(half) for half in halves] == [3, 4, 3, 4]
    for first, second in (halves[:2], halves[2:]):
        assert sorted([*first, *second]) == list(range(7))
    with pytest.raises(InputError, match="expected 2 photographs or more, got 1"):
        confidence.normal_spread(None, np.ones((1, 4, 4, 3)), MASK, NORMALS)


def test_spread_is_over_halves_of_which_every_second_is_mirrored(monkeypatch):
    """Each half's normals are turned by 2, 4, 6 and 8 degrees about the vertical."""
    mirror, given = np.float32([-1, 1, 1]), []

    def estimate(network, images, mask, *, lights, **_):
        index = len(given)
        given.append((images, lights))
        angle = np.deg2rad(2 * index + 2)
        cos, sin = np.cos(angle), np.sin(angle)
        turned = NORMALS @ np.float32([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
        expected = MASK[:, ::-1] if index % 2 else MASK
        np.testing.assert_array_equal(mask, expected)
        return turned[:, ::-1] * mirror if index % 2 else turned

    monkeypatch.setattr(confidence, "estimate_photographs", estimate)
    images = photographs()
    spread = confidence.normal_spread(None, images, MASK, NORMALS, lights=DIRECTIONS)
    # About the vertical what faces sidewards turns as far as what faces the viewer.
    middle = spread[20, MASK[20]]
    np.testing.assert_allclose(middle, np.sqrt((4 + 16 + 36 + 64) / 4), atol=0.05)
    assert not spread[~MASK].any()
    for index, half in enumerate(confidence._halves(5, 2, 0)):
        step = -1 if index % 2 else 1
        seen, lights = given[index]
        np.testing.assert_array_equal(seen, images[half][:, :, ::step])
        np.testing.assert_allclose(lights, DIRECTIONS[half] * [step, 1, 1])


def test_confidence_on_disk(tmp_path):
    spread = np.float32([[0.001, 1.23, 14.9], [15.1, 90, 40]])
    mask = np.array([[True, True, True], [True, True, False]])
    facts = write_confidence(tmp_path, spread, mask)
    levels = read_image(tmp_path / "confidence.png")[..., 0]
    np.testing.assert_array_equal(levels, [[1, 123, 1490], [1510, 9000, 0]])
    bad = read_image(tmp_path / "unreliable.png")[..., 0]
    np.testing.assert_array_equal(bad, [[0, 0, 0], [255, 255, 0]])
    assert facts["mean_deg"] == pytest.approx(spread[mask].mean())


def test_all_is_everything():
    whole = FolderOptions(all=True, mesh="ply").spelled_out()
    assert whole.mesh == "ply" and not whole.all
    names = ("depth", "lights", "base_color", "rti", "confidence", "view")
    assert all(getattr(whole, name) for name in names)
    assert FolderOptions().spelled_out() == FolderOptions()
    FolderOptions(all=True, lights_from=Path("a.lp"), lamp_distance=2.0).check()


def test_a_mesh_has_the_base_colour(tmp_path):
    reason = "the extra [mesh] is not installed"
    trimesh = pytest.importorskip("trimesh", reason=reason)
    color = np.where(MASK[..., None], np.float32([0.5, 0.2, 0.05]), 0)
    write_base_color(tmp_path, color)
    given = photographs(), MASK, "linear", NORMALS.astype(np.float32)
    options = FolderOptions(mesh="ply", base_color=True)
    writing._write_surface(tmp_path, Estimate(*given, {}), options, [], False)
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    expected = np.rint(255 * srgb_encode(np.array([0.5, 0.2, 0.05])))
    assert (np.abs(mesh.visual.vertex_colors[:, :3] - expected) <= 1).all()


def test_estimate_writes_what_is_asked_for(tmp_path):
    folder = tmp_path / "thing"
    folder.mkdir()
    for index, image in enumerate(photographs()[:2]):
        encoded = np.uint8(255 * srgb_encode(image / 2))
        cv2.imwrite(str(folder / f"{index}.png"), encoded[..., ::-1])
    cv2.imwrite(str(folder / "mask.png"), np.uint8(255 * MASK))
    weights = tmp_path / "small.safetensors"
    save_weights(weights, lively_network(SHALLOW_OURS))
    given = [str(folder), "-o", str(tmp_path / "out"), "--weights", str(weights)]
    every = ["--lights", "--base-color", "--rti", "--confidence"]
    assert estimate([*given, *every]) == 0
    out = tmp_path / "out" / "thing"
    record = json.loads((out / "normals.json").read_text())
    beyond = {
        "lights.json",
        "lights.lp",
        "base_color.exr",
        "base_color.png",
        "relight.ptm",
        "confidence.exr",
        "confidence.png",
        "unreliable.png",
        "info.json",
        *(f"plane_{index}.jpg" for index in range(6)),
    }
    assert beyond <= set(record["files"])
    assert record["rti"]["psnr_db"] > 15  # by the lights of a random network
    found = json.loads((out / "lights.json").read_text())["photographs"]
    # What the network guesses, here a random one.
    images, mask, transfer = read_photographs(folder)
    network = lively_network(SHALLOW_OURS)
    guesses = estimate_with_lights(network, images, mask, transfer=transfer).lights
    directions = np.array([light["direction"] for light in found])
    assert angles(directions, guesses).max() < 0.1
    levels = cv2.imread(str(out / "confidence.png"), cv2.IMREAD_UNCHANGED)
    assert not levels[~MASK].any() and (levels > 0).sum() == record["mask_pixels"]
    # The results are no photographs, should they be read as a folder of them.
    (out / "photo.png").write_bytes((folder / "0.png").read_bytes())
    assert select(out).names == ("photo.png",)


def test_extras_are_of_linear_light(tmp_path):
    """Lights, base colours, texture maps of sRGB values and of a wide profile's."""
    options = FolderOptions(lights=True, base_color=True, rti=True)
    found = NormalsAndLights(NORMALS, DIRECTIONS)
    names = [f"{index}.png" for index in range(5)]

    def written(name, images, transfer, to_srgb=None):
        place = tmp_path / name
        place.mkdir()
        extras = estimate_extras(None, images, MASK, found, transfer, options)
        given = images, MASK, transfer, NORMALS, {"images": names}, None, extras
        write_extras(place, Estimate(*given, to_srgb), options)
        lamps = json.loads((place / "lights.json").read_text())["photographs"]
        colors = np.array([lamp["color"] for lamp in lamps])
        base = read_image(place / "base_color.exr")
        return colors, base, read_ptm(place / "relight.ptm")(0.3, 0.2)

    linear, matrix = photographs() / 3, icc_to_srgb(P3)
    plain = written("linear", linear, "linear")
    encoded = np.uint16(np.rint(65535 * srgb_encode(linear)))
    # 2e-5, 8e-5 and 4e-3; as linear values 0.42, 0.35 and 0.27.
    for one, other in zip(plain, written("srgb", encoded, "srgb"), strict=True):
        np.testing.assert_allclose(other, one, atol=0.01)
    wide = np.float32(linear @ np.linalg.inv(matrix).T)
    _, *maps = written("wide", wide, "linear", matrix)
    # 0.015 and 0.007; without the profile 0.05.
    for one, other in zip(plain[1:], maps, strict=True):
        np.testing.assert_allclose(other, one, atol=0.03)


def test_confidence_is_of_the_same_transfer_and_frame(monkeypatch):
    seen = []

    def estimate(network, images, mask, *, transfer, frame, **_):
        seen.append((transfer, frame))
        return np.where(mask[..., None], np.float32([0, 0, 1]), 0)

    monkeypatch.setattr(confidence, "estimate_photographs", estimate)
    options = FolderOptions(confidence=True, reader="official")
    found = NormalsAndLights(NORMALS, DIRECTIONS)
    extras = estimate_extras(None, photographs(), MASK, found, "srgb", options)
    assert extras.confidence is not None and set(seen) == {("srgb", "image")}


def test_a_wide_profile_reaches_what_is_written(calls, tmp_path, monkeypatch):
    folder, seen = pot(tmp_path), []
    for path in folder.glob("L_*.png"):
        Image.open(path).save(path, icc_profile=P3)

    def write(place, estimate, options):
        seen.append(estimate.to_srgb)
        return {}

    monkeypatch.setattr(writing, "write_extras", write)
    assert run(folder, "-o", tmp_path / "out", "--fast") == 0
    np.testing.assert_array_equal(seen[0], icc_to_srgb(P3))
    assert calls[0]["fast"]
