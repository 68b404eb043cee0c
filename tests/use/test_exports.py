"""Files for a purpose, opened again by trimesh."""

import io
import json
import os
import struct
import zipfile

import cv2
import numpy as np
import pytest
from gltf_reader import read_glb
from picture_files import png, save
from plain_objects import hemisphere, rippled_dome

from unips_jax.cli.surface import main as surface
from unips_jax.io.normals import write_normals
from unips_jax.io.results import write_record
from unips_jax.surface.exports import Scale, blender_model, printable

trimesh = pytest.importorskip("trimesh", reason="the extra [mesh] is not installed")


def test_a_model_gives_back_every_pixels_normal(tmp_path):
    depth, normals, colors = rippled_dome()
    data, facts = blender_model(depth, normals, name="dome", colors=colors)
    path = tmp_path / "dome.glb"
    path.write_bytes(data)
    read = trimesh.load(path, force="mesh", process=False)
    assert len(read.faces) == facts["faces"] > 500
    assert read.extents.max() == pytest.approx(1) == facts["longest_side"]
    assert facts["size"] == "scale unknown: the longest side is 1 m"
    material = read.visual.material
    inside = np.isfinite(depth)
    found = np.asarray(material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(found[inside], colors[inside])
    # As a renderer does: the frame between vertices, and the map's normal in it.
    content, accessor = read_glb(path)
    names = content["meshes"][0]["primitives"][0]["attributes"]
    n, t = accessor(names["NORMAL"]), accessor(names["TANGENT"])
    place = accessor(names["TEXCOORD_0"]) * 64 - 0.5
    np.testing.assert_allclose(place, np.rint(place), atol=1e-3)  # pixels' middles
    column, row = np.rint(place).astype(int).T
    texture = np.asarray(material.normalTexture.convert("RGB")) / 127.5 - 1
    given = texture[row, column]
    b = np.cross(n, t[:, :3]) * t[:, 3:]
    found = given[:, :1] * t[:, :3] + given[:, 1:2] * b + given[:, 2:] * n
    cosine = (found * normals[row, column]).sum(-1) / np.linalg.norm(found, axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 1
    np.testing.assert_allclose(np.linalg.norm(n, axis=-1), 1, atol=1e-5)
    np.testing.assert_allclose((n * t[:, :3]).sum(-1), 0, atol=1e-5)
    (tmp_path / "down.glb").write_bytes(
        blender_model(depth, normals, name="dome", directx=True)[0]
    )
    down = trimesh.load(tmp_path / "down.glb", force="mesh").visual.material
    turned = np.asarray(down.normalTexture.convert("RGB")) / 127.5 - 1
    np.testing.assert_allclose(turned, texture * [1, -1, 1], atol=1e-6)


def test_a_known_scale_is_kept(tmp_path):
    depth, normals, _ = rippled_dome()
    data, facts = blender_model(
        0.5 * depth, normals, Scale(None, 0.5, "mm"), name="dome"
    )
    read = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh")
    assert read.extents.max() == pytest.approx(0.5e-3 * 56, rel=0.05)
    assert facts["size"] == "from the scale given, in mm"
    solid, facts = printable(0.5 * depth, Scale(None, 0.5, "mm"))
    read = trimesh.load(io.BytesIO(solid), file_type="stl")
    assert read.extents.max() == pytest.approx(0.5 * 57, rel=0.05)


def test_black_paint_is_no_hole_in_a_models_colours(tmp_path):
    depth, normals, colors = rippled_dome()
    colors = np.full_like(colors, 200)
    colors[28:34, 28:34] = 0
    colors[~np.isfinite(depth)] = 0
    (tmp_path / "dome.glb").write_bytes(
        blender_model(depth, normals, name="dome", colors=colors)[0]
    )
    read = trimesh.load(tmp_path / "dome.glb", force="mesh", process=False)
    found = np.asarray(read.visual.material.baseColorTexture.convert("RGB"))
    colors[~np.isfinite(depth)] = 200  # outside the surface the nearest one's
    np.testing.assert_array_equal(found, colors)


def test_a_models_tangents_are_those_of_its_texture_coordinates(tmp_path):
    """Blender reads no others: to the right in the picture, along the surface."""
    row, column = np.mgrid[:80, :80] - 39.5
    depth = (0.012 * (row**2 + column**2)).astype(np.float32)  # slopes up to 43 degrees
    slopes = np.stack([0.024 * column, -0.024 * row, np.ones_like(row)], -1)
    normals = slopes / np.linalg.norm(slopes, axis=-1, keepdims=True)
    data, _ = blender_model(depth, normals.astype(np.float32), name="bowl")
    (tmp_path / "bowl.glb").write_bytes(data)
    content, accessor = read_glb(tmp_path / "bowl.glb")
    names = content["meshes"][0]["primitives"][0]["attributes"]
    x = accessor(names["TEXCOORD_0"])[:, 0] * 80 - 40
    along = np.stack([np.ones_like(x), 0 * x, -0.024 * x], -1)
    cosine = (along * accessor(names["TANGENT"])[:, :3]).sum(-1)
    cosine /= np.linalg.norm(along, axis=-1)
    inside = abs(x) < 36  # the frame's normals are blurred, at borders from one side
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1)))[inside].max() < 1


def test_a_model_does_not_bridge_gaps_of_the_mask():
    """Two planes, one far behind the other, three pixels apart, on a grid of five."""
    depth = np.zeros((60, 90), np.float32)
    depth[:, 41:44] = np.nan
    depth[:, 44:] = 300
    normals = np.broadcast_to(np.float32([0, 0, 1]), (*depth.shape, 3))
    data, _ = blender_model(depth, normals, name="shards", max_faces=420)
    read = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh")
    assert np.ptp(read.vertices[read.faces][..., 2], axis=1).max() < 1e-3
    assert read.body_count == 2


@pytest.mark.parametrize("focal", [None, 500.0])
def test_a_model_does_not_bridge_jumps(focal):
    """Two steps of 30 pixels, and a slope that falls as far over 32."""
    depth = np.full((64, 96), 500, np.float32)
    depth[:, 21:] -= 30
    depth[:, 60:92] += np.linspace(0, 30, 32, dtype=np.float32)
    depth[:, 92:] += 30
    depth[43:] += 30
    normals = np.broadcast_to(np.float32([0, 0, 1]), (*depth.shape, 3))
    for cut, bridged in ((20.0, False), (40.0, True)):
        data, _ = blender_model(
            depth, normals, Scale(focal), name="steps", max_faces=500, cut=cut
        )
        read = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh")
        assert read.body_count == (1 if bridged else 4)


@pytest.mark.parametrize("faces", [20_000, 9_000, 3_000])
def test_a_model_has_no_spikes_at_an_outline(faces):
    """A disc that stands 100 pixels above a plane, on grids of 2, 3 and 5 pixels."""
    row, column = np.mgrid[:200, :200] - 99.5
    depth = np.where(np.hypot(row, column) < 60, 400, 500).astype(np.float32)
    normals = np.broadcast_to(np.float32([0, 0, 1]), (*depth.shape, 3))
    data, _ = blender_model(
        depth, normals, Scale(None, 1.0, "m"), name="disc", max_faces=faces
    )
    read = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh")
    assert np.ptp(read.vertices[read.faces][..., 2], axis=1).max() < 1e-3
    assert len(read.faces) > 0.6 * faces


@pytest.mark.parametrize("focal", [None, 90.0])
def test_a_models_vertices_lie_on_their_rays(focal, tmp_path):
    depth, normals, _ = rippled_dome()
    depth = depth + 100
    data, _ = blender_model(depth, normals, Scale(focal, 1.0, "m"), name="dome")
    (tmp_path / "dome.glb").write_bytes(data)
    content, accessor = read_glb(tmp_path / "dome.glb")
    names = content["meshes"][0]["primitives"][0]["attributes"]
    pixel = np.rint(accessor(names["TEXCOORD_0"]) * 64 - 0.5).astype(int)
    column, row = pixel.T
    away = depth[row, column]
    size = away / focal if focal else 1
    rays = np.stack([(column - 31.5) * size, (31.5 - row) * size, -away], -1)
    off = accessor(names["POSITION"]) - rays
    np.testing.assert_allclose(off, np.broadcast_to(off[0], off.shape), atol=1e-3)


@pytest.mark.parametrize("focal", [None, 90.0])
def test_a_print_is_watertight_and_stands_on_a_base(focal):
    depth, _, _ = rippled_dome()
    depth += 100 if focal else 0
    depth[20:24, 20:24] = np.nan  # a hole
    depth[[39, 39, 41, 41], [39, 40, 40, 41]] = np.nan  # two that meet in (40, 40)
    depth[:4, :4] = 3.0  # another part
    data, facts = printable(depth, Scale(focal))
    read = trimesh.load(io.BytesIO(data), file_type="stl")
    assert read.is_watertight and read.is_winding_consistent
    assert read.volume > 0 and read.body_count == 1
    assert len(read.vertices) > 2 * 2000  # of the dome, not of the other part
    assert read.extents.max() == pytest.approx(100, rel=1e-5)
    assert len(read.faces) == facts["faces"]
    base = read.vertices[:, 2] < read.bounds[0, 2] + 1e-4
    assert base.sum() == len(read.vertices) / 2


def test_a_deep_print_is_as_long_as_it_says():
    depth = np.broadcast_to(8.0 * np.abs(np.arange(30) - 15), (40, 30))
    for longest in (None, 50.0):
        data, facts = printable(depth.copy(), longest_mm=longest)
        read = trimesh.load(io.BytesIO(data), file_type="stl")
        assert read.extents.argmax() == 2
        assert read.extents.max() == pytest.approx(longest or 100, rel=1e-5)
        assert facts["longest_side"] == pytest.approx(longest or 100, rel=1e-5)


def test_a_print_has_as_many_triangles_as_asked_for():
    depth, _, _ = rippled_dome()
    whole, facts = printable(depth)
    data, fewer = printable(depth, max_faces=600)
    small, large = (trimesh.load(io.BytesIO(x), file_type="stl") for x in (data, whole))
    assert small.is_watertight and fewer["faces"] < 1600 < facts["faces"]
    assert small.volume == pytest.approx(large.volume, rel=0.15)  # less its edge
    np.testing.assert_allclose(small.extents, large.extents, rtol=0.1)


def test_a_coarser_print_is_one_solid_where_a_bridge_is_lost():
    depth = np.full((65, 160), np.nan, np.float32)
    for column, radius in ((32, 30), (120, 24)):
        place = np.mgrid[:65, :160] - np.array([32, column])[:, None, None]
        depth[np.hypot(*place) < radius] = 3.0
    depth[33:36, 60:100] = 3.0  # between every fourth row
    assert _bodies(depth, None) == 1
    assert _bodies(depth, 900) == 1


def _bodies(depth, max_faces):
    data, _ = printable(depth, max_faces=max_faces)
    solid = trimesh.load(io.BytesIO(data), file_type="stl")
    assert solid.is_watertight
    return solid.body_count


def test_the_command_writes_all_three(tmp_path):
    folder = tmp_path / "cat"
    folder.mkdir()
    np.save(folder / "normals.npy", hemisphere(48)[0])
    cv2.imwrite(str(folder / "base_color.png"), np.full((48, 48, 3), 99, np.uint8))
    os.utime(folder / "normals.npy", (0, 0))  # a ZIP begins in 1980
    out = tmp_path / "out"
    arguments = [str(folder), "-o", str(out), "--export", "blender", "print", "archive"]
    assert surface([*arguments, "--mesh", "ply"]) == 0
    mesh = trimesh.load(out / "mesh.ply", process=False)
    assert (mesh.visual.vertex_colors[:, :3] == 99).all()
    model = trimesh.load(out / "cat.glb", force="mesh")
    assert model.visual.material.baseColorTexture.getpixel((24, 24))[0] == 99
    assert trimesh.load(out / "cat.stl").is_watertight
    with zipfile.ZipFile(out / "cat.zip") as packed:
        names = set(packed.namelist())
        text = packed.read("cat/cat-README.txt").decode()
    wanted = {
        "cat-normals.npy",
        "cat-depth.exr",
        "cat-height.png",
        "cat-surface.json",
        "cat.glb",
        "cat.stl",
    }
    assert {f"cat/{name}" for name in wanted} <= names
    assert "cat-height.png: height for displacement" in text
    assert "cat.stl: the surface as a solid on a base" in text
    record = json.loads((out / "surface.json").read_text())
    assert record["exports"]["print"]["longest_side"] == pytest.approx(100)
    assert "surface.json" in record["exports"]["archive"]
    assert sorted([*record["files"], "surface.json"]) == sorted(os.listdir(out))


@pytest.mark.parametrize(
    ("normal_map", "said"),
    [("opengl", "y up (OpenGL)"), ("directx", "y down (DirectX)")],
)
def test_an_archive_states_the_normals_convention(tmp_path, normal_map, said):
    folder = tmp_path / "cat"
    folder.mkdir()
    write_normals(folder, hemisphere(24)[0], normal_map=normal_map)
    record = {"folder": "", "images": {}, "options": {"normal_map": normal_map}}
    write_record(folder, record)
    out = tmp_path / "out"
    assert surface([str(folder), "-o", str(out), "--export", "archive"]) == 0
    with zipfile.ZipFile(out / "cat.zip") as packed:
        assert said in packed.read("cat/cat-README.txt").decode()
    # Of a file it is what the reader says.
    file, out = str(folder / "normals.png"), str(tmp_path / "of_file")
    stated = ["--normal-map", normal_map, "--export", "archive"]
    assert surface([file, "-o", out, *stated]) == 0
    with zipfile.ZipFile(tmp_path / "of_file" / "normals.zip") as packed:
        assert said in packed.read("normals/normals-README.txt").decode()


@pytest.mark.parametrize(
    ("folder", "name"), [("coin_v1.2", "coin_v1.2"), ("caf\udce9", "caf\ufffd")]
)
def test_files_have_the_folders_name(tmp_path, folder, name):
    """With a dot, and in an encoding of its own."""
    (tmp_path / folder).mkdir()
    np.save(tmp_path / folder / "normals.npy", hemisphere(24)[0])
    out = tmp_path / "out"
    assert surface([str(tmp_path / folder), "-o", str(out), "--export", "archive"]) == 0
    with zipfile.ZipFile(out / f"{name}.zip") as packed:
        assert f"{name}/{name}-depth.exr" in packed.namelist()


def test_a_photographs_own_curve_is_undone_and_its_faults_are_named(tmp_path, capsys):
    np.save(tmp_path / "n.npy", hemisphere(24)[0])
    gamma = {b"gAMA": struct.pack(">I", 55556)}  # 1 / 1.8
    (tmp_path / "a.png").write_bytes(
        png(np.full((24, 24, 3), 128, np.uint8), 2, 8, gamma)
    )
    arguments = [str(tmp_path / "n.npy"), "-o", str(tmp_path / "out"), "--mesh", "ply"]
    assert surface([*arguments, "--photograph", str(tmp_path / "a.png")]) == 0
    colors = trimesh.load(tmp_path / "out" / "mesh.ply").visual.vertex_colors
    assert np.unique(colors[:, :3]) == pytest.approx(146, abs=1)
    broken = np.full((24, 24, 3), 0.5, np.float32)
    broken[3, 4] = np.nan
    save(tmp_path / "a.exr", broken)
    capsys.readouterr()
    assert surface([*arguments, "--photograph", str(tmp_path / "a.exr")]) == 2
    assert "a.exr: expected finite values, got 3" in capsys.readouterr().err
