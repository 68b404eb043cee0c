"""Meshes, textures and scenes of the user in Blender.

Needs a Python with `bpy`, as `test_cycles_blender.py` does.
"""

import base64
import json
import subprocess

import cv2
import numpy as np
import pytest
from blender_runs import LAMBERTIAN, SIZE, opened, sphere

from unips_jax.cycles import assets, run
from unips_jax.cycles.blender_process import BlenderError, find_python


@pytest.fixture(scope="module")
def blender():
    with opened() as process:
        yield process


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nelement face 4\nproperty list uchar int vertex_indices\n"
    "end_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
)


def stl() -> str:
    corners = np.eye(4, 3, -1)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    lines = ["solid a"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex {:g} {:g} {:g}".format(*corners[i]) for i in face]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid a", ""])


def gltf() -> str:
    """A tetrahedron in one text file."""
    corners = np.eye(4, 3, -1, dtype=np.float32)
    faces = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], np.uint16)
    data = corners.tobytes() + faces.tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    views = [(0, corners.nbytes), (corners.nbytes, faces.nbytes)]
    accessors = [
        {"componentType": 5126, "count": 4, "type": "VEC3", "min": [0] * 3},
        {"componentType": 5123, "count": 12, "type": "SCALAR"},
    ]
    accessors[0]["max"] = [1] * 3
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    content = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": uri, "byteLength": len(data)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": length}
            for offset, length in views
        ],
        "accessors": [{"bufferView": i, **a} for i, a in enumerate(accessors)],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    return json.dumps(content)


def test_meshes_and_textures_of_the_user(blender, tmp_path):
    picture = np.zeros((8, 8, 3), np.uint8)
    picture[..., 1] = 255
    cv2.imwrite(str(tmp_path / "x_basecolor.png"), picture)
    cv2.imwrite(str(tmp_path / "x_roughness.png"), np.full((8, 8), 51, np.uint8))
    maps = assets.find_materials(tmp_path)[tmp_path.name]
    files = {"a.obj": OBJ, "a.ply": PLY, "a.stl": stl(), "a.gltf": gltf()}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        shape = {"file": str(tmp_path / name)}
        assert blender.ask("build", shape=shape, material=maps) == 4
        blender.ask("place", rotation=[0.9, 0.3, 0.3, 0.1], focal_mm=None)
        truth = run.read_truth(blender.picture("truth", size=32))
        assert truth.mask.sum() > 100
        np.testing.assert_allclose(truth.maps["roughness"][truth.mask], 0.2, atol=1e-3)
        color = truth.maps["baseColor"][truth.mask].mean(0)
        np.testing.assert_allclose(color, [0, 1, 0], atol=1e-3)
    packed = np.full((8, 8, 3), [204, 102, 0], np.uint8)  # BGR: metal, roughness
    cv2.imwrite(str(tmp_path / "x_orm.png"), packed)
    (tmp_path / "x_roughness.png").unlink()
    maps = assets.find_materials(tmp_path)[tmp_path.name]
    blender.ask("build", shape=shape, material=maps)
    blender.ask("place", rotation=[0.9, 0.3, 0.3, 0.1], focal_mm=None)
    truth = run.read_truth(blender.picture("truth", size=32))
    np.testing.assert_allclose(truth.maps["roughness"][truth.mask], 0.4, atol=1e-3)
    np.testing.assert_allclose(truth.maps["metal"][truth.mask], 0.8, atol=1e-3)
    (tmp_path / "bad.obj").write_text("v 0 0 0\n")
    with pytest.raises(BlenderError):
        blender.ask("build", shape={"file": str(tmp_path / "bad.obj")}, material=maps)


BLEND = """
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
mesh = bpy.data.meshes.new("tetrahedron")
mesh.from_pydata(corners, [], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
for x in (0, 3):
    item = bpy.data.objects.new("tetrahedron", mesh)
    item.location = (x, 0, 0)
    bpy.context.scene.collection.objects.link(item)
cutter = bpy.data.objects.new("cutter", mesh)
cutter.hide_render = True
bpy.context.scene.collection.objects.link(cutter)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
"""


RIGGED = """
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add()
cube = bpy.context.object
bpy.ops.object.armature_add()
cube.parent = bpy.context.object
cube.vertex_groups.new(name="Bone").add(range(8), 1, "REPLACE")
cube.modifiers.new("armature", "ARMATURE").object = cube.parent
bpy.ops.export_scene.gltf(filepath=sys.argv[1])
"""


BALL = """
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=3)
bpy.ops.wm.obj_export(filepath=sys.argv[1], export_normals=False)
"""


MIRRORED = """
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8)
ball = bpy.context.object
ball.data.normals_split_custom_set_from_vertices([v.co for v in ball.data.vertices])
ball.scale = (-1, 0.5, 1)
bpy.ops.export_scene.gltf(filepath=sys.argv[1])
"""


TWO_CUBES = """
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
for x, name in ((0, "first"), (3, sys.argv[2])):
    bpy.ops.mesh.primitive_cube_add(location=(x, 0, 0))
    layers = bpy.context.object.data.uv_layers
    layers[0].name = name
    if name == "none":
        layers.remove(layers[0])
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
"""


def run_blender(script, *arguments):
    command = [find_python(), "-c", script, *arguments]
    subprocess.run(command, check=True, capture_output=True)


def test_a_vertex_without_a_face_moves_nothing(blender, tmp_path):
    """Scans and meshes that were cut have some."""
    masks = []
    stray = PLY.replace("vertex 4", "vertex 5").replace("3 0 2 1", "9 4 0\n3 0 2 1", 1)
    for text in (PLY, stray):
        (tmp_path / "a.ply").write_text(text)
        shape = {"file": str(tmp_path / "a.ply")}
        material = {"uniform": LAMBERTIAN}
        assert blender.ask("build", shape=shape, material=material) == 4
        blender.ask("place", rotation=[0.9, 0.3, 0.3, 0.1], focal_mm=None)
        masks.append(run.read_truth(blender.picture("truth", size=32)).mask)
    np.testing.assert_array_equal(*masks)


def test_all_objects_of_a_blend_file_in_their_places(blender, tmp_path):
    file = tmp_path / "two.blend"
    run_blender(BLEND, file)
    material = {"uniform": LAMBERTIAN}
    assert blender.ask("build", shape={"file": str(file)}, material=material) == 8
    blender.ask("place", rotation=[1, 0, 0, 0], focal_mm=None)
    truth = run.read_truth(blender.picture("truth", size=SIZE))
    parts, _ = cv2.connectedComponents(truth.mask.astype(np.uint8))
    assert parts == 1 + 2  # the background and both of them


def test_bones_are_no_part_of_an_object(blender, tmp_path):
    file = tmp_path / "rigged.glb"
    run_blender(RIGGED, file)
    shape, material = {"file": str(file)}, {"uniform": LAMBERTIAN}
    assert blender.ask("build", shape=shape, material=material) == 6 * 4


def test_scans_without_normals_are_smooth(blender, tmp_path):
    """A ball of few faces has the normals of a sphere, not of its faces."""
    file = tmp_path / "ball.obj"
    run_blender(BALL, file)
    shape, material = {"file": str(file)}, {"uniform": LAMBERTIAN}
    blender.ask("build", shape=shape, material=material)
    blender.ask("place", rotation=[1, 0, 0, 0], focal_mm=None)
    truth = run.read_truth(blender.picture("truth", size=SIZE))
    normals, mask = sphere()
    inner = truth.mask & mask & (normals[..., 2] > 0.3)
    cosine = (truth.normals * normals).sum(-1)[inner]
    assert np.rad2deg(np.arccos(np.minimum(cosine, 1))).mean() < 1.5


def test_normals_of_parts_that_are_mirrored_and_flattened(blender, tmp_path):
    """An ellipsoid of few faces has the normals of its file, not of its faces."""
    file = tmp_path / "mirrored.glb"
    run_blender(MIRRORED, file)
    shape, material = {"file": str(file)}, {"uniform": LAMBERTIAN}
    blender.ask("build", shape=shape, material=material)
    blender.ask("place", rotation=[1, 0, 0, 0], focal_mm=None)
    truth = run.read_truth(blender.picture("truth", size=SIZE))
    ball, _ = sphere()
    half = np.zeros_like(ball)  # rows of the ball's picture squeezed to half
    half[SIZE // 4 : -SIZE // 4] = ball[::2]
    expected = half * [1, 2, 1]
    expected /= np.maximum(np.linalg.norm(expected, axis=-1, keepdims=True), 1e-9)
    inner = truth.mask & (half[..., 2] > 0.4)
    cosine = (truth.normals * expected).sum(-1)[inner]
    assert inner.sum() > 1000
    assert np.rad2deg(np.arccos(np.minimum(cosine, 1))).mean() < 2.5


@pytest.mark.parametrize("second", ["first", "second", "none"])
def test_textures_of_parts_with_coordinates_of_other_names(blender, tmp_path, second):
    file = tmp_path / "two.blend"
    run_blender(TWO_CUBES, file, second)
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[::4], stripes[1::4] = 255, 255
    cv2.imwrite(str(tmp_path / "x_basecolor.png"), stripes)
    maps = assets.find_materials(tmp_path)[tmp_path.name]
    blender.ask("build", shape={"file": str(file)}, material=maps)
    blender.ask("place", rotation=[1, 0, 0, 0], focal_mm=None)
    truth = run.read_truth(blender.picture("truth", size=SIZE))
    parts, labels = cv2.connectedComponents(truth.mask.astype(np.uint8))
    assert parts == 1 + 2
    for part in (1, 2):
        assert truth.maps["baseColor"][labels == part].std() > 0.2
