"""The model for Blender and games, as the viewer's own three.js draws it."""

import base64
import io
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")

from browser import ABSENT, browser, messages
from gltf_reader import read_glb
from PIL import Image
from plain_objects import rippled_dome
from selenium.webdriver.support.ui import WebDriverWait

from unips_jax.surface.exports import blender_model

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")
ASSETS = Path(__file__).parents[2] / "unips_jax/viewer/assets"
SIDE = 640  # of the drawing, in which the model's longest side is 1 and 1.25 are seen
# The normal map as glTF defines it: in the frame of tangent, bitangent and normal.
PAGE = """<!doctype html><canvas id="canvas" width="SIDE" height="SIDE"></canvas>
<script>THREE_SCRIPT</script>
<script>
const model = MODEL;
const typed = (text, type) =>
  new type(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
async function draw() {
  const geometry = new THREE.BufferGeometry();
  for (const [name, [size, text]] of Object.entries(model.attributes)) {
    geometry.setAttribute(
      name, new THREE.BufferAttribute(typed(text, Float32Array), size));
  }
  geometry.setIndex(new THREE.BufferAttribute(typed(model.index, Uint32Array), 1));
  const texture = async (source) => {
    const image = new Image();
    image.src = source;
    await image.decode();
    const made = new THREE.Texture(image);
    Object.assign(made, { flipY: false, generateMipmaps: false, needsUpdate: true });
    made.minFilter = made.magFilter = THREE.LinearFilter;
    return made;
  };
  const material = (color) => new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    uniforms: { bumps: { value: maps.normal }, base: { value: maps.color } },
    vertexShader: `
      uniform mat4 modelViewMatrix, projectionMatrix;
      in vec3 position, normal; in vec4 tangent; in vec2 uv;
      out vec3 n, t, b; out vec2 at;
      void main() {
        n = normal; t = tangent.xyz; b = cross(normal, tangent.xyz) * tangent.w;
        at = uv;
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      }`,
    fragmentShader: `
      precision highp float;
      uniform sampler2D bumps, base;
      in vec3 n, t, b; in vec2 at; out vec4 color;
      void main() {
        vec3 m = texture(bumps, at).xyz * 2.0 - 1.0;
        vec3 seen = normalize(m.x * t + m.y * b + m.z * n);
        color = vec4(${color}, 1.0);
      }`,
  });
  const [normal, color] = [await texture(model.normal), await texture(model.color)];
  const maps = { normal, color };
  const canvas = document.getElementById("canvas");
  const renderer = new THREE.WebGLRenderer({ canvas });
  const camera = new THREE.OrthographicCamera(-0.625, 0.625, 0.625, -0.625, -9, 9);
  const drawn = ["seen * 0.5 + 0.5", "texture(base, at).xyz"].map((color) => {
    const scene = new THREE.Scene();
    scene.add(new THREE.Mesh(geometry, material(color)));
    renderer.render(scene, camera);
    return canvas.toDataURL();
  });
  document.body.dataset.drawn = JSON.stringify(drawn);
}
draw();
</script>"""


def drawn(path, folder):
    """A model's normals and colours as drawn, and where its vertices are there."""
    content, accessor = read_glb(path)
    (primitive,) = content["meshes"][0]["primitives"]
    of = {name: accessor(index) for name, index in primitive["attributes"].items()}
    names = {"position": "POSITION", "normal": "NORMAL", "tangent": "TANGENT"}
    names["uv"] = "TEXCOORD_0"

    def text(values, kind):
        return base64.b64encode(values.astype(kind).tobytes()).decode()

    def picture(index):
        image = content["images"][content["textures"][index]["source"]]
        data = base64.b64encode(content["view"](image["bufferView"])).decode()
        return f"data:{image['mimeType']};base64,{data}"

    material = content["materials"][primitive["material"]]
    model = {
        "attributes": {
            name: (of[key].shape[1], text(of[key], "<f4"))
            for name, key in names.items()
        },
        "index": text(accessor(primitive["indices"]), "<u4"),
        "normal": picture(material["normalTexture"]["index"]),
        "color": picture(material["pbrMetallicRoughness"]["baseColorTexture"]["index"]),
    }
    page = PAGE.replace("MODEL", json.dumps(model)).replace("SIDE", str(SIDE))
    three = (ASSETS / "three.min.js").read_text("utf-8")
    (folder / "page.html").write_text(page.replace("THREE_SCRIPT", three), "utf-8")
    with browser(800, 800) as driver:
        driver.get((folder / "page.html").as_uri())
        done = "return document.body.dataset.drawn"
        WebDriverWait(driver, 300, 0.2).until(lambda _: driver.execute_script(done))
        pictures = json.loads(driver.execute_script(done))
        assert not [text for text in messages(driver) if "rror" in text]
    images = []
    for source in pictures:
        data = base64.b64decode(source.partition(",")[2])
        with Image.open(io.BytesIO(data)) as image:
            images.append(np.asarray(image.convert("RGB")).astype(float))
    x, y, _ = (of["POSITION"] / 1.25).T
    places = np.stack([(0.5 - y) * SIDE, (x + 0.5) * SIDE], -1)
    return *images, places, of["TEXCOORD_0"]


@pytest.mark.parametrize("directx", [False, True])
def test_a_model_is_drawn_with_every_pixels_normal_and_colour(directx, tmp_path):
    depth, normals, _ = rippled_dome()
    size = len(depth)
    y, x = np.mgrid[:size, :size]
    colors = np.stack([40 + 3 * x, 40 + 3 * y, 0 * x + 90], -1).astype(np.uint8)
    data, facts = blender_model(
        depth, normals, name="dome", colors=colors, directx=directx
    )
    path = tmp_path / "dome.glb"
    path.write_bytes(data)
    assert facts["green"].startswith("down" if directx else "up")
    shown, painted, places, uv = drawn(path, tmp_path)
    row, column = np.rint(uv[:, ::-1] * size - 0.5).astype(int).T
    inner = np.hypot(column - size / 2, row - size / 2) < 0.38 * size
    at_row, at_column = np.rint(places[inner] - 0.5).astype(int).T
    row, column = row[inner], column[inner]
    assert len(row) > 150
    found = shown[at_row, at_column] / 127.5 - 1
    found /= np.linalg.norm(found, axis=-1, keepdims=True)
    cosine = (found * normals[row, column]).sum(-1)
    error = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    if directx:  # shown as glTF says, ripples from above look lit from below
        assert np.median(error) > 5
    else:
        assert np.median(error) < 2 and np.percentile(error, 95) < 5
    color = painted[at_row, at_column]
    np.testing.assert_allclose(color, colors[row, column], atol=4)
