"""The viewer's page as a file: precision, size, what it takes and what it refuses."""

import base64
import dataclasses
import json
import re
from pathlib import Path

import cv2
import known_results
import numpy as np
import pytest

from unips_jax.cli.view import main as view
from unips_jax.io.images import write_image
from unips_jax.viewer.layers import layers_of, view_of
from unips_jax.viewer.page import BUDGET, page, with_depth
from unips_jax.viewer.result import Photograph

ASSETS = Path(__file__).parents[2] / "unips_jax" / "viewer" / "assets"


def data_of(html):
    return json.loads(re.search(r'id="data">(.*?)</script>', html, re.S).group(1))


def decoded(address):
    data = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)[..., ::-1]


def depth_of(layers):
    stored = decoded(layers["depth"]["image"]).astype(int)
    level = 256 * stored[..., 0] + stored[..., 1]
    near, far = layers["depth"]["near"], layers["depth"]["far"]
    depth = near + (level - 1) / 65534 * (far - near)
    return np.where(level == 0, np.nan, depth)


def test_what_is_packed_comes_back():
    result = known_results.result()
    view = view_of(result.inside, 1024)
    layers = layers_of(result, view)
    part = (view.rows, view.columns)
    stored = decoded(layers["normals"]) / 127.5 - 1
    inside = result.inside[part]
    assert np.array_equal(np.linalg.norm(stored, axis=-1) > 0.5, inside)
    stored /= np.linalg.norm(stored, axis=-1, keepdims=True)
    cosine = np.sum(stored * result.normals[part], -1)[inside]
    assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() < 0.5
    depth = depth_of(layers)
    assert np.array_equal(np.isfinite(depth), inside)
    reach = layers["depth"]["far"] - layers["depth"]["near"]
    error = np.abs(depth - result.depth[part])[inside]
    assert error.max() <= 0.51 * reach / 65534


@pytest.mark.parametrize("focal", [None, 150.0])
def test_half_the_size_is_the_same_surface(focal):
    """Points of the page's surface lie on the hemisphere, whatever the scale."""
    result = dataclasses.replace(known_results.result(), focal=focal)
    if focal is not None:
        result = dataclasses.replace(result, depth=result.depth + 400)
    view = view_of(result.inside, 40)
    layers = layers_of(result, view)
    depth, camera = depth_of(layers), layers["camera"]
    assert depth.shape == (40, 40) and layers["scale"] > 1.5
    row, column = np.indices(depth.shape)
    size = layers["depth"]["pixel"] if focal is None else depth / camera["focal"]
    x, y = (column - camera["column"]) * size, (row - camera["row"]) * size
    near = 0 if focal is None else 400
    middle = np.hypot(x, y) < 20  # in the middle pixels' means are close to pixels
    if focal is None:
        radius = np.sqrt(x**2 + y**2 + (depth - near) ** 2)[middle]
        np.testing.assert_allclose(radius, known_results.RADIUS, atol=0.5)
    else:
        middle = np.hypot(row - camera["row"], column - camera["column"]) < 1
        np.testing.assert_allclose(depth[middle], 400 - known_results.RADIUS, atol=0.5)
        shift = (known_results.SIZE - 1) / 2 - view.columns.start  # of its own pixels
        assert camera["column"] == pytest.approx((shift + 0.5) / view.scale - 0.5)
        assert camera["focal"] * view.scale == pytest.approx(focal)


def test_noisy_results_of_1024_stay_below_six_megabytes():
    rng = np.random.default_rng(0)
    side = 1024
    normals = rng.normal([0, 0, 2], 0.5, (side, side, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    image = rng.random((side, side, 3), np.float32)
    photographs = tuple(Photograph(f"{i}.png", lambda: image) for i in range(3))
    depth = np.cumsum(normals[..., 0], axis=1)
    result = known_results.result(normals=normals, depth=depth, photographs=photographs)
    html = page(result)
    data = data_of(html)
    assert 1_000_000 < len(html.encode()) < BUDGET
    assert len(data["photographs"]) == 3 and data["width"] >= 512


def test_names_cannot_end_the_script_or_begin_another():
    evil = '</script><script>alert(1)</script>"<!--'
    plain = known_results.result(title=evil)
    named = [dataclasses.replace(p, name=evil) for p in plain.photographs]
    html = page(dataclasses.replace(plain, photographs=tuple(named)))
    assert html.count("<script") == 4 and "alert(1)</script>" not in html
    assert data_of(html)["photographs"][0]["name"] == evil


def test_texts_are_whole_in_every_language():
    strings = json.loads((ASSETS / "strings.json").read_text())
    assert set(strings["en"]) == set(strings["de"])
    for key, text in strings["en"].items():
        holes = set(re.findall(r"\{\d\}", text))
        assert holes == set(re.findall(r"\{\d\}", strings["de"][key])), key
    html = (ASSETS / "page.html.j2").read_text()
    code = "".join(path.read_text() for path in ASSETS.glob("*.js"))
    used = re.findall(r'data-(?:text|label)="(\w+)"', html)
    used += re.findall(r'\bsay\("(\w+)"', code)
    assert len(used) > 30 and set(used) <= set(strings["en"])


def test_text_has_contrast():
    css = (ASSETS / "page.css").read_text()
    colors = dict(re.findall(r"--(\w+): #(\w{6});", css))

    def luminance(name):
        value = np.array([int(colors[name][i : i + 2], 16) / 255 for i in (0, 2, 4)])
        linear = np.where(value > 0.04, ((value + 0.055) / 1.055) ** 2.4, value / 12.92)
        return linear @ [0.2126, 0.7152, 0.0722]

    for ground in ("ground", "panel"):
        for text, least in (("text", 7), ("quiet", 4.5), ("accent", 4.5)):
            ratio = (luminance(text) + 0.05) / (luminance(ground) + 0.05)
            assert ratio >= least, (text, ground)  # WCAG 2.2, 1.4.3


@pytest.fixture
def folder(tmp_path):
    known_results.write_folder(tmp_path / "hemisphere", tmp_path / "photographs")
    return tmp_path / "hemisphere"


def test_the_command_integrates_what_has_no_depth(folder, capsys):
    assert view([str(folder)]) == 0
    assert "view.html" in capsys.readouterr().out
    html = (folder / "view.html").read_text()
    data = data_of(html)
    assert [p["name"] for p in data["photographs"]] == list(known_results.LIGHTS)
    assert data["color"]["kind"] == "mean"
    depth = depth_of(data)
    middle = depth.shape[0] // 2
    fall = depth[middle, middle + 30] - depth[middle, middle]
    expected = known_results.RADIUS - np.sqrt(known_results.RADIUS**2 - 30**2)
    assert fall == pytest.approx(expected, rel=0.05)
    assert "<b>bright" not in html and "\\u003cb>bright" in html


def test_photographs_that_moved_or_changed(folder, tmp_path, capsys):
    (tmp_path / "photographs").rename(tmp_path / "elsewhere")
    page_file = str(tmp_path / "a.html")
    assert view([str(folder), "-o", page_file, "--flat"]) == 0
    data = data_of(Path(page_file).read_text())
    assert data["photographs"] == [] and data["color"] is None
    assert data["depth"] is None
    there = ["--photographs", str(tmp_path / "elsewhere"), "--flat"]
    assert view([str(folder), "-o", page_file, *there]) == 0
    assert len(data_of(Path(page_file).read_text())["photographs"]) == 3
    capsys.readouterr()
    write_image(tmp_path / "elsewhere" / "up.png", known_results.photographs()[0])
    assert view([str(folder), *there]) == 2
    error = capsys.readouterr().err
    assert "expected the photograph that the normals are from" in error
    assert error.count("\n") == 1


def test_base_color_and_expected_error_are_shown(folder, tmp_path):
    import OpenEXR

    size = (known_results.SIZE, known_results.SIZE)
    write_image(folder / "base_color.png", np.full((*size, 3), 128, np.uint8))
    channels = {"Y": np.full(size, 12.0, np.float32)}
    OpenEXR.File({}, channels).write(str(folder / "confidence.exr"))
    assert view([str(folder), "-o", str(tmp_path / "a.html"), "--flat"]) == 0
    data = data_of((tmp_path / "a.html").read_text())
    assert data["color"]["kind"] == "base"
    assert data["confidence"]["top"] == pytest.approx(12)


@pytest.mark.parametrize(
    ("damage", "arguments", "message"),
    [
        ("normals.npy", [], "all its files as they were"),
        (None, ["-o", "page.txt"], "expected a name that ends in .html"),
    ],
)
def test_bad_input_is_one_line(folder, damage, arguments, message, capsys):
    if damage:
        (folder / damage).write_bytes(b"")
    assert view([str(folder), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_flat_result_is_only_integrated_once():
    result = known_results.result()
    assert with_depth(result) is result
