"""What Cycles renders, against closed forms and against our own scenes.

Needs a Python with `bpy` (`UNIPS_BPY_PYTHON`); skipped without, unless
`UNIPS_REQUIRE_BPY` is set.
"""

import base64
import json
import os
import signal
import subprocess
import sys
import time

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.cli import render
from unips_jax.cycles import assets, run
from unips_jax.cycles.blender_process import Blender, BlenderError, find_python
from unips_jax.cycles.environments import HEIGHT, WIDTH
from unips_jax.errors import InputError
from unips_jax.lighting.reflectance import Surface, reflectance

SIZE = 64
LAMBERTIAN = {"diffuse": [0.8, 0.5, 0.2]}
METAL = {"Base Color": [0.8, 0.5, 0.2], "Roughness": 0.5, "Metallic": 1.0}
TOWARDS = np.array([0.5, 0.3, 0.8]) / np.linalg.norm([0.5, 0.3, 0.8])


@pytest.fixture(scope="module")
def blender():
    try:
        python = find_python()
    except InputError as error:
        if os.environ.get("UNIPS_REQUIRE_BPY"):
            raise
        pytest.skip(f"bpy not importable: {error}")
    with Blender(python) as process:
        yield process


def sphere(size=SIZE):
    """Normals and mask of the unit sphere in its frame."""
    c = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(c, -c)
    z2 = 1 - x * x - y * y
    normals = np.stack([x, y, np.sqrt(np.maximum(z2, 0))], -1)
    return normals * (z2 > 0)[..., None], z2 > 0


def build(blender, material, size=SIZE):
    blender.ask("build", shape={"kind": "sphere"}, material={"uniform": material})
    blender.ask("place", rotation=[1, 0, 0, 0], focal_mm=None)
    return run.read_truth(blender.picture("truth", size=size))


def photograph(blender, mask, *lamps, seed=1, environment=None, samples=64):
    given = {"lamps": lamps, "environment": environment, "denoise": False}
    size = mask.shape[0]
    return run.read_photograph(
        blender.picture("image", size=size, samples=samples, seed=seed, **given), mask
    )


def sun(direction, irradiance=np.pi):
    direction = np.asarray(direction) / np.linalg.norm(direction)
    return {
        "kind": "sun",
        "direction": direction.tolist(),
        "irradiance": [irradiance] * 3,
    }


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
