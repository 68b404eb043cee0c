"""Lights of photographs, base colour, polynomial texture maps, confidence."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image
from plain_objects import hemisphere
from small_networks import SHALLOW_OURS, lively_network

from unips_jax import estimate_lights
from unips_jax.cli.estimate import main as estimate
from unips_jax.errors import InputError
from unips_jax.estimation import confidence
from unips_jax.estimation.extras import write_confidence
from unips_jax.estimation.options import FolderOptions
from unips_jax.estimation.streaming import estimate_with_lights
from unips_jax.io.color import srgb_encode
from unips_jax.io.images import read_image, read_image_file, read_linear
from unips_jax.io.photographs import read_photographs, select
from unips_jax.io.results import RECORD, transfer_of
from unips_jax.lighting import ptm
from unips_jax.lighting.harmonics import COSINE_LOBE, harmonics
from unips_jax.lighting.light_files import base_color, write_base_color, write_lights
from unips_jax.lighting.light_fit import irradiance
from unips_jax.viewer.result import maps_of
from unips_jax.weights import save_weights

NORMALS, MASK, _ = hemisphere(40)
DIRECTIONS = np.array(
    [[0.5, 0.2, 0.8], [-0.6, 0.1, 0.7], [0, 0.7, 0.6], [0.1, -0.5, 0.9], [0, 0, 1]]
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
COLORS = np.array([[1, 1, 1], [2, 1.8, 1.5], [0.6, 0.7, 0.9], [1, 0.8, 1], [1.3, 1, 1]])


def texture():
    row, column = np.mgrid[:40, :40]
    stripes = 0.55 + 0.35 * np.sin(row / 3)[..., None] * [1, 0.3, -0.5]
    return np.where(column[..., None] < 20, stripes, 0.4)


def photographs(ambient=0.0, gloss=False):
    cosine = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, DIRECTIONS), 0)
    light = cosine[..., None] * COLORS[:, None, None] + ambient
    images = light * texture()
    if gloss:
        half = DIRECTIONS + [0, 0, 1]
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        images += (
            np.maximum(np.einsum("hwk,nk->nhw", NORMALS, half), 0)[..., None] ** 60
        )
    return (images * MASK[..., None]).astype(np.float32)


def angles(found, truth):
    cosine = (found * truth).sum(-1) / np.linalg.norm(truth, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


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


def test_one_photograph_has_a_light():
    grey = np.where(MASK[..., None], photographs()[:1] / texture(), 0)
    lights = estimate_lights(grey.astype(np.float32), NORMALS, MASK)
    assert angles(lights.directions, DIRECTIONS[:1]).max() < 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"images": np.ones((2, 40, 40))}, r"images: expected \[N, H, W, 3\]"),
        ({"normals": np.ones((3, 3, 3))}, r"normals: expected \(40, 40, 3\)"),
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
    write_lights(tmp_path, names, lights)
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


def read_ptm(path):
    """A reader of its own: a function of the light's x and y that gives an image."""
    data = path.read_bytes()
    lines, place = [], 0
    while len(lines) < 6:
        end = data.index(b"\n", place)
        lines.append(data[place:end].decode())
        place = end + 1
    assert lines[:2] == ["PTM_1.2", "PTM_FORMAT_RGB"]
    width, height = int(lines[2]), int(lines[3])
    scale = [float(x) for x in lines[4].split()]
    bias = [int(x) for x in lines[5].split()]
    assert len(data) - place == 18 * width * height

    def show(x, y):
        image = np.zeros((height, width, 3))
        terms = (x * x, y * y, x * y, x, y, 1)
        for color in range(3):
            for row in range(height):
                start = place + 6 * width * (color * height + height - 1 - row)
                line = np.frombuffer(data, np.uint8, 6 * width, start)
                for k, term in enumerate(terms):
                    image[row, :, color] += (
                        (line[k::6].astype(int) - bias[k]) * scale[k] * term
                    )
        return np.clip(image / 255, 0, 1)

    return show


def read_planes(folder):
    """The same, as web viewers do."""
    info = json.loads((folder / "info.json").read_text())
    assert (info["type"], info["colorspace"], info["nplanes"]) == ("ptm", "rgb", 18)
    (material,) = info["materials"]
    planes = [Image.open(folder / f"plane_{index}.jpg") for index in range(6)]
    assert all(plane.size == (info["width"], info["height"]) for plane in planes)

    def show(x, y):
        image = np.zeros((info["height"], info["width"], 3))
        for index, term in enumerate((1, x, y, x * x, x * y, y * y)):
            for color in range(3):
                level = np.asarray(planes[index])[..., color] / 255
                which = 3 * index + color
                factor = material["scale"][which] * term
                image[..., color] += (level - material["bias"][which]) * factor
        return np.clip(image, 0, 1)

    return show


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
    _, guesses = estimate_with_lights(network, images, mask, transfer=transfer)
    directions = np.array([light["direction"] for light in found])
    assert angles(directions, guesses).max() < 0.1
    levels = cv2.imread(str(out / "confidence.png"), cv2.IMREAD_UNCHANGED)
    assert not levels[~MASK].any() and (levels > 0).sum() == record["mask_pixels"]
    # The results are no photographs, should they be read as a folder of them.
    (out / "photo.png").write_bytes((folder / "0.png").read_bytes())
    assert select(out).names == ("photo.png",)
