"""The numbers that the viewer shows, without a browser."""

import re
import runpy
import types
from pathlib import Path

import known_results
import numpy as np
import pytest
from known_results import decoded
from node_calls import printed

from unips_jax.viewer.layers import View, layers_of, view_of, white_of
from unips_jax.viewer.result import Result

ROOT = Path(__file__).resolve().parents[2]
ASSETS = ROOT / "unips_jax" / "viewer" / "assets"

# Of the page what these scripts need, and of three.js what holds a mesh.
_LENGTHS = """
const data = JSON.parse(require("fs").readFileSync(0, "utf8"));
globalThis.document = { documentElement: { outerHTML: "", lang: "en" },
  getElementById: (id) => (
    { textContent: JSON.stringify(id === "data" ? data : {}) }) };
globalThis.location = { hash: "" };
globalThis.window = globalThis;
Object.defineProperty(globalThis, "navigator", { value: { language: "en" } });
globalThis.THREE = {
  BufferGeometry: class { kept = {}; setAttribute(n, v) { this.kept[n] = v; }
    getAttribute(n) { return this.kept[n]; } setIndex() {} },
  BufferAttribute: class { constructor(array) { this.array = array; } } };
const files = process.argv.slice(1);
const code = files.map((f) => require("fs").readFileSync(f, "utf8")).join("\\n");
console.log(JSON.stringify(new Function(code + `
  return { points: data.places.map((place) => spaceAt(data.bytes, place)),
    length: distanceOf(data.bytes, ...data.places),
    corners: [...surfaceGeometry(data.bytes).getAttribute("position").array] };`)()));
"""


def test_lengths_are_those_of_a_camera_in_perspective():
    focal, depth = 150.0, known_results.hemisphere()[1] + 400
    result = known_results.result(depth=depth, focal=focal, photographs=())
    view = view_of(result.inside, 1024)
    layers = layers_of(result, view)
    stored = decoded(layers["depth"]["image"])
    rgba = np.dstack([stored, np.full(stored.shape[:2], 255, np.uint8)])
    places = [[30.5, 40.5], [60.5, 20.5]]
    asked = {**layers, "strings": {"en": {}}, "places": places, "color": None}
    asked |= {"bytes": rgba.ravel().tolist(), "photographs": [], "facts": []}
    files = [str(ASSETS / f"{name}.js") for name in ("data", "scale", "mesh")]
    found = printed(["-e", _LENGTHS, *files], asked)
    rows, columns = np.indices(depth.shape) - (known_results.SIZE - 1) / 2
    true = np.stack([columns * depth, -rows * depth, -focal * depth], -1) / focal
    true = true[view.rows, view.columns]
    expected = [true[int(y), int(x)] for x, y in places]
    np.testing.assert_allclose(found["points"], expected, atol=0.01)
    length = np.linalg.norm(np.subtract(*expected))
    assert found["length"] == pytest.approx(length, abs=0.01)
    inside = np.isfinite(true[..., 2])
    corners = [np.nan if c is None else c for c in found["corners"]]
    off = (np.reshape(corners, true.shape) - true)[inside]
    np.testing.assert_allclose(off - off.mean(0), 0, atol=0.01)


def test_the_environments_light_is_in_the_tools_basis():
    tool = runpy.run_path(str(ROOT / "tools" / "bundle_viewer.py"))
    text = (ASSETS / "shaders.js").read_text("utf-8")
    (formula,) = re.findall(
        r"vec3 irradiance\(vec3 n\) \{\s*return (.*?);", text, re.DOTALL
    )
    ways = np.random.default_rng(0).normal(size=(5, 3))
    for way, row in zip(ways, tool["_basis"](ways), strict=True):
        n = types.SimpleNamespace(**dict(zip("xyz", way, strict=True)))
        found = eval(" ".join(formula.split()), {"harmonics": np.eye(9), "n": n})
        np.testing.assert_allclose(found, row)


def test_what_is_unsure_is_bright():
    size = known_results.SIZE
    spread = np.tile(np.linspace(0, 40, size, dtype=np.float32), (size, 1))
    result = known_results.result(spread=spread)
    view = view_of(result.inside, 1024)
    found = layers_of(result, view)["confidence"]
    inside = result.inside[view.rows, view.columns]
    expected = np.clip(spread[view.rows, view.columns] / found["top"], 0, 1)
    levels = decoded(found["image"])[..., 0] / 255
    np.testing.assert_allclose(levels[inside], expected[inside], atol=0.003)


def test_the_cameras_axis_is_where_it_was_in_a_smaller_page():
    """A pixel of the page is the middle of four of the result's."""
    normals = np.zeros((60, 80, 3), np.float32)
    normals[4:36, 10:50] = 0, 0, 1
    result = Result("thing", normals, focal=100.0)
    half = View(slice(4, 36), slice(10, 50), width=20, height=16)
    camera = layers_of(result, half)["camera"]
    assert (camera["column"], camera["row"]) == (14.5, 12.5)
    assert camera["focal"] == 50


def test_white_is_the_objects_not_its_surroundings():
    linear = np.full((20, 20, 3), 8.0)
    linear[5:9, 5:9] = 0.1, 0.2, 0.4
    assert white_of(linear, linear[..., 0] < 1) == pytest.approx(0.4)
    assert white_of(linear, np.zeros((20, 20), bool)) == 8
