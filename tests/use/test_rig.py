"""Lights of an earlier capture, or of an RTI's list, used for another object."""

import json

import cv2
import numpy as np
import pytest
from estimate_runs import run
from plain_objects import hemisphere

from unips_jax import estimate_lights
from unips_jax.errors import InputError
from unips_jax.io.images import read_image
from unips_jax.lighting.known import read_known_lights
from unips_jax.lighting.light_files import base_color, write_lights
from unips_jax.lighting.rig import read_rig

NORMALS, MASK, _ = hemisphere(40)
DIRECTIONS = np.array(
    [[0.5, 0.2, 0.8], [-0.6, 0.1, 0.7], [0, 0.7, 0.6], [0.1, -0.5, 1]]
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
COLORS = np.array([[1, 1, 1], [2, 1.8, 1.5], [0.6, 0.7, 0.9], [1, 0.8, 1]])
NAMES = [f"{index}.png" for index in range(4)]


def lit(albedo):
    cosine = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, DIRECTIONS), 0)
    images = cosine[..., None] * COLORS[:, None, None] * albedo
    return (images * MASK[..., None]).astype(np.float32)


@pytest.fixture
def earlier(tmp_path):
    """The result of a grey ball under the rig's lamps."""
    lights = estimate_lights(lit(0.5), NORMALS, MASK, guesses=DIRECTIONS)
    folder = tmp_path / "earlier"
    folder.mkdir()
    write_lights(folder, NAMES, lights)
    return folder, lights


def test_lights_come_back_as_they_were_written(earlier):
    folder, lights = earlier
    for names in (NAMES, ["a.tif", "b.tif", "c.tif", "d.tif"]):
        for value, back in zip(lights[:5], read_rig(folder, names)[:5], strict=True):
            np.testing.assert_allclose(back, value, atol=2e-6)
    some = read_rig(folder, ["2.TIF", "0.tif"])
    np.testing.assert_allclose(some.colors, lights.colors[[2, 0]], atol=2e-6)
    listed = read_rig(folder / "lights.lp", ["3.jpg"])
    np.testing.assert_allclose(listed, DIRECTIONS[[3]], atol=2e-6)
    longer = folder.parent / "longer.lp"
    longer.write_text("a.png 0 3 4\nb.png 0.1 0 0\n")
    np.testing.assert_allclose(read_rig(longer), [[0, 0.6, 0.8], [1, 0, 0]])


def test_lights_in_the_order_of_letters_are_photographs_in_that_of_numbers(tmp_path):
    """As version 0.3.0 wrote them: 1, 10, 2."""
    listed = tmp_path / "coin.lp"
    listed.write_text("coin_1.jpg 0 0 1\ncoin_10.jpg 1 0 0\ncoin_2.jpg 0 1 0\n")
    names = ["seal_1.jpg", "seal_2.jpg", "seal_10.jpg"]
    expected = [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    np.testing.assert_allclose(read_rig(listed, names), expected)
    np.testing.assert_allclose(read_known_lights([str(listed)], names), expected)
    # What is not in order by letters is a list of its own order.
    listed.write_text("b.jpg 0 0 1\na10.jpg 1 0 0\na2.jpg 0 1 0\n")
    np.testing.assert_allclose(read_rig(listed, names)[1], [1, 0, 0])


def test_another_object_has_its_colours_by_them(earlier):
    """What is dark on one side looks lit from the other, by itself."""
    folder, _ = earlier
    albedo = np.linspace(0.1, 0.9, 40)[:, None] * [1, 0.7, 0.4]
    albedo = np.broadcast_to(albedo, (40, 40, 3))

    def error(lights):
        color = base_color(lit(albedo), NORMALS, MASK, lights)[MASK]
        ratio = color / albedo[MASK]  # up to the lights' common colour
        return np.median(np.abs(ratio / np.median(ratio, 0) - 1))

    own = error(estimate_lights(lit(albedo), NORMALS, MASK))
    assert error(read_rig(folder, NAMES)) < 0.025 < 0.04 < own  # measured: 0.018, 0.049


def test_the_command_uses_them(earlier, tmp_path, network_calls, capsys):
    folder, lights = earlier
    photographs = tmp_path / "vase"
    photographs.mkdir()
    stored = np.uint16(65535 * lit(0.4) / 2)
    for name, image in zip(NAMES, stored, strict=True):
        cv2.imwrite(str(photographs / name), image[..., ::-1])
    cv2.imwrite(str(photographs / "mask.png"), np.uint8(255 * MASK))
    given = (photographs, "-o", tmp_path / "out", "--base-color")
    assert run(*given, "--lights", "--lights-from", folder) == 0
    result = tmp_path / "out" / "vase"
    used, before = (
        json.loads((place / "lights.json").read_text())["photographs"]
        for place in (result, folder)
    )
    for one, other in zip(used, before, strict=True):
        assert one.keys() == other.keys() and one["file"] == other["file"]
        for name in one.keys() - {"file"}:  # of six digits
            np.testing.assert_allclose(one[name], other[name], atol=1.01e-6)
    normals = np.load(result / "normals.npy")
    expected = base_color(stored, normals, MASK, lights)
    np.testing.assert_allclose(
        read_image(result / "base_color.exr"), expected, atol=1e-4
    )
    assert run(*given, "--lights", "--lights-from", folder) == 0
    assert "is up to date" in capsys.readouterr().out and len(network_calls) == 1
    # Other lights, another result: here the list's directions, with fitted colours.
    assert run(*given, "--lights", "--lights-from", folder / "lights.lp") == 0
    assert len(network_calls) == 2
    found = json.loads((result / "lights.json").read_text())["photographs"]
    np.testing.assert_allclose(
        [light["direction"] for light in found], DIRECTIONS, atol=1e-5
    )
    assert found != before


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "2\na.png 0 0 1\nb.png 1 0 1\n",
            r"each of the 3 photographs.* got 2, 0 of them",
        ),
        (
            "".join(f"{n}.png 0 0 1\n" for n in "abcd"),
            r"each of the 3 .* got 4, 0 of them",
        ),
        (  # the numbers of an earlier object go on
            "2.png 0 0 1\n3.png 0 1 1\n4.png 1 0 1\n",
            r"got 3, 2 of them by name, none for 1\.png",
        ),
        ("a.png 3 4\nb.png 4 4\nc.png 5 5\n", "expected directions, three numbers"),
        ("a.png 0 0 0\nb.png 0 1 1\nc.png 0 1 1\n", "got one of length 0"),
        ("a.png 0 0 1\nnothing\n", "line 2"),
    ],
)
def test_lists_that_do_not_fit_are_named(tmp_path, text, message):
    file = tmp_path / "dome.lp"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_rig(file, ["1.png", "2.png", "3.png"])


@pytest.mark.parametrize(
    "content", ["", "{}", '{"photographs": []}', '{"photographs": [{"file": "a"}]}']
)
def test_other_files_are_named(tmp_path, content):
    with pytest.raises(InputError, match="found none"):
        read_rig(tmp_path, NAMES)
    (tmp_path / "lights.json").write_text(content)
    with pytest.raises(InputError, match="expected lights as `unips estimate"):
        read_rig(tmp_path, NAMES)


def test_directions_of_another_length_are_no_lights(earlier):
    folder, _ = earlier
    content = json.loads((folder / "lights.json").read_text())
    content["photographs"][1]["direction"] = [0, 0, 2]
    (folder / "lights.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="expected lights as `unips estimate"):
        read_rig(folder, NAMES)


def test_lights_without_a_use_are_refused(tmp_path, network_calls, capsys):
    assert run(tmp_path, "-o", tmp_path / "out", "--lights-from", tmp_path) == 2
    assert "--lights-from: expected something to use it for" in capsys.readouterr().err
