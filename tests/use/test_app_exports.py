"""Files for a purpose that the application makes, opened again by trimesh."""

import io
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

import trimesh
from app_client import photographs
from colour_profiles import P3
from PIL import Image
from plain_objects import hemisphere

from unips_jax.app import exports
from unips_jax.app.work import Chosen
from unips_jax.io.color import as_linear, icc_to_srgb, srgb_encode
from unips_jax.io.results import write_record
from unips_jax.surface.depth_files import write_depth


@pytest.fixture
def done(opening):
    """A client, an object with a result, and the folder of that: half a ball."""
    client = opening()
    key = client.post("/objects")["id"]
    for name, data in photographs(3, (48, 48)).items():
        client.put(key, name, data)
    client.ready(key)
    client.post(f"/objects/{key}/estimate", name="my cat", options={})
    client.state(key, "done")
    shown = next(Path(client.results).glob("my_cat-*"))
    (shown / "normals.json").unlink()
    normals, mask, depth = hemisphere(48)
    np.save(shown / "normals.npy", normals)
    facts = write_depth(shown, np.where(mask, depth, np.nan), unit="pixels")
    surface = {"camera": "orthographic", "focal_px": None, "scale": 1.0, **facts}
    write_record(shown, {"transfer": "srgb", "surface": surface})
    return client, key, shown


def made(client, key, **wish):
    """What the page is told of an export, and the file."""
    facts = client.post(f"/objects/{key}/exports", **wish)
    answer = client.ask("GET", f"/api/objects/{key}/exports/{facts['file']}")
    assert answer.status == 200 and len(answer.content) == facts["bytes"]
    assert facts["file"] in answer.headers["content-disposition"]
    return facts, io.BytesIO(answer.content)


def green(model):
    """Mean of a model's normal map, and of its upper half, as the map has it."""
    texture = model.visual.material.normalTexture.convert("RGB")
    return np.asarray(texture)[:, :, 1].astype(int)


def test_a_model_for_blender(done):
    client, key, _ = done
    facts, file = made(client, key, purpose="blender")
    assert facts["file"] == "my_cat.glb" and facts["unit"] == "m"
    assert "scale unknown: the longest side is 1 m" in facts["size"]
    model = trimesh.load(file, file_type="glb", force="mesh")
    assert model.extents.max() == pytest.approx(1) and len(model.faces) > 200
    # The photographs' mean colours.
    colors = np.asarray(model.visual.material.baseColorTexture.convert("RGB"))
    sent = [
        cv2.imdecode(np.frombuffer(data, np.uint8), 1)[24, 24, ::-1]
        for data in photographs(3, (48, 48)).values()
    ]
    np.testing.assert_allclose(colors[24, 24], np.mean(sent, axis=0), atol=1.5)
    wish = {"purpose": "blender", "directx": True, "longest_mm": 250}
    facts, file = made(client, key, **wish)
    assert facts["size"] == "the longest side is given, 250 mm"
    other = trimesh.load(file, file_type="glb", force="mesh")
    assert other.extents.max() == pytest.approx(0.25)
    assert np.ptp(green(model)) > 4
    np.testing.assert_array_equal(green(model) + green(other), 255)


def test_photographs_that_were_moved_back_are_no_colours(done):
    client, key, shown = done
    record = json.loads((shown / "normals.json").read_text())
    record["moved_back"] = {"1.png": [3, 0, 0]}
    (shown / "normals.json").write_text(json.dumps(record))
    facts, data = made(client, key, purpose="blender")
    model = trimesh.load(data, file_type="glb", force="mesh")
    assert model.visual.material.baseColorTexture is None and facts["faces"] > 100


def test_colours_of_a_wide_profile_become_srgbs(tmp_path):
    stored = np.full((4, 5, 3), (200, 60, 90), np.uint8)
    Image.fromarray(stored).save(tmp_path / "0.png", icc_profile=P3)
    chosen = Chosen(tmp_path, ("0.png",), None, ())
    record = {"images": {"0.png": ""}, "transfer": "srgb"}
    found = exports._colors(chosen, tmp_path, record, stored.shape, 10**6)
    linear = as_linear(stored, "srgb") @ icc_to_srgb(P3).T
    np.testing.assert_allclose(found, 255 * srgb_encode(linear), atol=2)
    assert found[0, 0, 0] > 210


def test_a_solid_to_print(done):
    client, key, _ = done
    facts, file = made(client, key, purpose="print", longest_mm=62.5)
    solid = trimesh.load(file, file_type="stl")
    assert solid.is_watertight and solid.extents.max() == pytest.approx(62.5, rel=1e-5)
    assert facts["unit"] == "mm" and facts["faces"] == len(solid.faces)
    _, file = made(client, key, purpose="print")
    assert trimesh.load(file, file_type="stl").extents.max() == pytest.approx(100)


def test_an_archive_of_all(done):
    client, key, _ = done
    made(client, key, purpose="print")
    facts, file = made(client, key, purpose="archive")
    assert facts["file"] == "my_cat.zip"
    with zipfile.ZipFile(file) as packed:
        names = {Path(name).name for name in packed.namelist()}
        text = packed.read("my_cat/my_cat-README.txt").decode()
        stl = packed.read("my_cat/my_cat.stl")
    assert trimesh.load(io.BytesIO(stl), file_type="stl").is_watertight
    wanted = {"my_cat-normals.npy", "my_cat-depth.exr", "my_cat-normals.json"}
    assert names >= wanted | {"my_cat.stl", "my_cat-README.txt"}
    assert "my_cat-depth.exr: depth, float32" in text


def test_what_is_refused_is_one_line(done):
    client, key, folder = done
    path = f"/objects/{key}/exports"
    for wish in (
        {"purpose": "blender", "longest_mm": 0},
        {"purpose": "blender", "longest_mm": -3},
        {"purpose": "print", "longest_mm": "long"},
        {"purpose": "print", "longest_mm": 2e6},
        {"purpose": "fly"},
        {},
    ):
        assert client.refused(path, **wish)["code"] == "length"
    for name in ("..%2Fobject.json", "object.json", "my_cat.glb"):
        answer = client.ask("GET", f"/api/objects/{key}/exports/{name}")
        assert answer.status == 404
    depth = (folder / "depth.exr").read_bytes()
    (folder / "depth.exr").write_bytes(depth[:50])
    for purpose in ("print", "archive"):
        error = client.refused(path, purpose=purpose)["error"]
        assert "depth.exr" in error and "\n" not in error and str(folder) not in error
    (folder / "normals.json").unlink()
    error = client.refused(path, purpose="blender")["error"]
    assert "expected results, found none there any more" in error
    assert str(folder) not in error
    draft = client.post("/objects")["id"]
    answer = client.refused(f"/objects/{draft}/exports", purpose="print")
    assert answer["code"] == "gone"
