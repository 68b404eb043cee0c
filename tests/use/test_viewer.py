"""The viewer's page as a file: precision, size, what it takes and what it refuses."""

import dataclasses
import json
import re
import struct
from pathlib import Path

import known_results
import numpy as np
import pytest
from colour_profiles import P3
from known_results import decoded
from picture_files import png, save, smooth, with_orientation
from PIL import Image

from unips_jax.cli.view import main as view
from unips_jax.io.color import icc_to_srgb
from unips_jax.io.images import write_image
from unips_jax.io.orientation import read_as_estimated
from unips_jax.io.photographs import read_capture
from unips_jax.io.results import file_hash, read_record
from unips_jax.io.selection import select
from unips_jax.viewer.layers import color_of, layers_of, view_of
from unips_jax.viewer.page import (
    BUDGET,
    notes_in,
    page,
    with_depth,
    write_tiled_view,
    write_view,
)
from unips_jax.viewer.result import Photograph, photographs_of, read_result

ASSETS = Path(__file__).parents[2] / "unips_jax" / "viewer" / "assets"


def data_of(html):
    return json.loads(re.search(r'id="data">(.*?)</script>', html, re.S).group(1))


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


@pytest.mark.parametrize("shape", [(4000, 60), (60, 4000)])
def test_the_scale_of_long_objects_is_that_of_their_length(shape):
    view = view_of(np.ones(shape, bool), 1024)
    assert max(view.height, view.width) * view.scale == 4000


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
    assert html.count("<script") == 5 and "alert(1)</script>" not in html
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


def test_an_integrated_depth_is_in_the_results_pixels(monkeypatch):
    """Also where the page is smaller, here by 2."""
    monkeypatch.setattr("unips_jax.viewer.page._SIDES", (40,))
    found = with_depth(known_results.result(depth=None)).depth
    truth = known_results.result().depth
    both = np.isfinite(found) & np.isfinite(truth)
    assert np.ptp(found[both]) == pytest.approx(np.ptp(truth[both]), rel=0.1)


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


@pytest.mark.parametrize("orientation", [3, 6])
def test_photographs_lie_as_they_were_estimated(tmp_path, orientation):
    """The camera stood still, whatever its files say is up."""
    picture = smooth(np.uint8, height=40, width=64)
    for name, tag in (("a.jpg", 1), ("b.jpg", orientation), ("c.jpg", 1)):
        path = save(tmp_path / name, picture)
        path.write_bytes(with_orientation(path.read_bytes(), tag))
    capture = read_capture(select(tmp_path))
    record = {"images": dict.fromkeys(["a.jpg", "b.jpg", "c.jpg"])}
    for name, image in zip(record["images"], capture.images, strict=True):
        found = read_as_estimated(tmp_path / name, record)
        np.testing.assert_array_equal(found, image)


def test_photographs_of_a_wide_profile_are_shown_in_srgb(tmp_path):
    """From files and from memory, as of an estimate."""
    known_results.write_folder(tmp_path / "bowl", tmp_path / "photographs")
    record = json.loads((tmp_path / "bowl" / "normals.json").read_text())
    for path in (tmp_path / "photographs").iterdir():
        Image.open(path).save(path, icc_profile=P3)
        record["images"][path.name] = file_hash(path)
    (tmp_path / "bowl" / "normals.json").write_text(json.dumps(record))
    first, *_ = read_result(tmp_path / "bowl").photographs
    matrix = icc_to_srgb(P3)
    images = known_results.photographs()
    kept, *_ = photographs_of(images, tuple(known_results.LIGHTS), "linear", matrix)
    np.testing.assert_allclose(first.read(), kept.read(), atol=1e-6)
    middle = np.unravel_index(images[0, ..., 0].argmax(), images.shape[1:3])
    stored = images[0][middle] / 255
    np.testing.assert_allclose(kept.read()[middle], matrix @ stored, atol=1e-6)
    assert kept.read()[middle][0] > stored[0] + 0.02  # redder than it was stored


@pytest.mark.parametrize("given", [None, "srgb"])
def test_photographs_have_the_values_that_were_estimated_from(tmp_path, given):
    gamma = {b"gAMA": struct.pack(">I", 55556)}  # 1 / 1.8
    picture = smooth(np.uint8, height=8, width=9)
    (tmp_path / "a.png").write_bytes(png(picture, 2, 8, gamma))
    capture = read_capture(select(tmp_path), transfer=given)
    record = {"images": {"a.png": ""}, "transfer_rule": capture.transfer_rule}
    found = read_as_estimated(tmp_path / "a.png", record)
    np.testing.assert_array_equal(found, capture.images[0])
    assert (capture.images[0] == picture).all() == (given is not None)


def test_base_color_has_no_dark_rim_in_a_smaller_page():
    y, x = np.mgrid[-1:1:300j, -1:1:300j]
    normals = np.zeros((300, 300, 3), np.float32)
    normals[..., 2] = x**2 + y**2 < 0.7
    result = known_results.result(
        normals=normals,
        depth=None,
        photographs=(),
        base_color=0.8 * normals[..., [2] * 3],
    )
    view = view_of(result.inside, 100)
    levels = decoded(color_of(result, view, None)["image"])[..., 0].astype(int)
    kept = view.shrink(result.inside) > 0.5
    assert np.abs(levels[kept] - levels[50, 50]).max() < 40  # of a JPEG's edges


def test_names_in_any_encoding_are_shown():
    html = page(known_results.result(title="caf\udce9"))
    assert "caf?" in html and html.encode()


def test_base_color_and_spread_are_shown(folder, tmp_path):
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
        ("normals.npy", [], "expected the file that `unips estimate` wrote"),
        (None, ["-o", "page.txt"], "expected a name that ends in .html"),
        (None, ["--pixel-mm", "0"], "--pixel-mm 0.0: expected a length above 0"),
        (None, ["--tiles", "-o", "."], "expected a new folder"),
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


def test_tiles_are_the_pixels_of_the_result(folder, tmp_path, capsys):
    """Of a result of 2600 x 2600: two levels, 512 pixels and a border a tile."""
    size = 2600
    result = known_results.ripples(size=size, length=7, slope=0.4)
    image = np.zeros((size, size, 3), np.float32)
    image[1000:1100, 1500:1600] = [1, 0.5, 0]
    photograph = Photograph("a.png", lambda: image)
    result = dataclasses.replace(result, photographs=(photograph,))
    write_tiled_view(tmp_path / "tiled", result)
    data = data_of((tmp_path / "tiled" / "index.html").read_text())
    sizes = [(level["width"], level["height"]) for level in data["tiles"]["levels"]]
    assert sizes == [(2600, 2600), (1300, 1300)]
    files = {path.name for path in (tmp_path / "tiled" / "tiles").iterdir()}
    names = ("normals", "color", "photograph-0")
    assert {f"{name}-0-4-4.js" for name in names} <= files

    def tile(name):
        script = (tmp_path / "tiled" / "tiles" / f"{name}.js").read_text()
        return decoded(re.search(r'"(data:[^"]*)"', script)[1])

    normals = tile("normals-0-0-1")
    assert normals.shape == (513, 514, 3)  # at the upper edge there is no border
    expected = result.normals[0:513, 511:1025] * 127.5 + 127.5
    np.testing.assert_allclose(normals, expected, atol=0.51)
    spot = tile("photograph-0-0-1-2")  # rows 511 to 1024, columns 1023 to 1536
    assert spot[1020 - 511, 1520 - 1023, 0] > 240 > 30 > spot[900 - 511, 400, 0]


def test_a_page_without_more_pixels_has_no_tiles(folder, tmp_path, capsys):
    target = tmp_path / "a folder"
    assert view([str(folder), "--tiles", "-o", str(target), "--flat"]) == 0
    assert "0 tiles" in " ".join(capsys.readouterr().out.split())
    assert data_of((target / "index.html").read_text())["tiles"] is None
    assert view([str(folder), "--tiles", "-o", str(target), "--flat"]) == 0  # again


@pytest.mark.parametrize("focal", [None, 150.0])
def test_a_pixel_in_millimetres_is_the_unit(focal):
    """`--pixel-mm` is at the mean distance, where the camera is not orthographic."""
    result = known_results.result(focal=focal, pixel_mm=0.25)
    layers = layers_of(result, view_of(result.inside, 1024))
    assert layers["unit_mm"] == pytest.approx(0.25 * (focal or 1))
    plain = known_results.result(unit="m", depth=result.depth * 1e-3)
    layers = layers_of(plain, view_of(plain.inside, 1024))
    assert layers["unit_mm"] == 1000


def test_notes_stay_and_leave_the_results_whole(folder):
    """A reader's page in a folder of results is not a damaged result."""
    assert view([str(folder), "--flat"]) == 0
    page_file = folder / "view.html"
    record = json.loads((folder / "normals.json").read_text())
    record["files"]["view.html"] = file_hash(page_file)
    (folder / "normals.json").write_text(json.dumps(record))
    notes = {"notes": [{"place": [3, 4], "text": "<!--"}], "views": []}
    write_view(page_file, known_results.result())
    html = page(known_results.result(), notes=notes)
    page_file.write_text(html)
    assert "<!--" not in html and notes_in(page_file) == notes
    assert read_record(folder) is not None
    assert view([str(folder), "--flat"]) == 0
    assert notes_in(page_file) == notes
    page_file.write_text("damaged")
    assert notes_in(page_file) is None and notes_in(folder / "none.html") is None


@pytest.mark.parametrize("tiles", [False, True])
def test_notes_on_one_object_are_not_anothers(folder, tmp_path, capsys, tiles):
    target = tmp_path / ("kept" if tiles else "kept.html")
    command = [str(folder), "--flat", "-o", str(target), *["--tiles"] * tiles]
    assert view(command) == 0
    page_file = target / "index.html" if tiles else target
    notes = {"notes": [{"place": [3, 4], "text": "a dent"}], "views": []}
    other = dataclasses.replace(known_results.result(), title="a & <b>")
    page_file.write_text(page(other, notes=notes))
    capsys.readouterr()
    assert view(command) == 2
    assert "notes on a & <b>; name another" in " ".join(capsys.readouterr().err.split())
    assert notes_in(page_file) == notes
    nothing = {"size": "9 x 9", "scale": {"mm": None}, "notes": [], "views": []}
    page_file.write_text(page(other, notes=nothing))
    assert view(command) == 0  # nothing is lost
