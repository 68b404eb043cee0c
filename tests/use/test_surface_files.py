"""Files of depth and meshes, read back by other programs' readers."""

import struct

import cv2
import numpy as np
import pytest
from gltf_reader import read_glb
from PIL import Image
from scipy.spatial import cKDTree

from unips_jax.errors import InputError
from unips_jax.surface.depth_files import write_depth
from unips_jax.surface.mesh import mesh_of_depth, write_mesh

trimesh = pytest.importorskip("trimesh", reason="the extra [mesh] is not installed")


def bowl(height=13, width=17):
    row, column = np.mgrid[:height, :width].astype(np.float32)
    depth = 0.05 * ((column - 8) ** 2 + 2 * (row - 5) ** 2)
    depth[0, :4] = np.nan
    return depth


def test_depth_files_hold_the_depth(tmp_path):
    import OpenEXR

    depth = bowl()
    facts = write_depth(tmp_path, depth, unit="mm")
    channels = OpenEXR.File(str(tmp_path / "depth.exr")).channels()
    np.testing.assert_array_equal(channels["Z"].pixels, depth)
    levels = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert levels.dtype == np.uint16
    assert np.array_equal(levels == 0, np.isnan(depth))
    near, far = np.nanmin(depth), np.nanmax(depth)
    read = near + (levels - 1.0) * (far - near) / 65534
    np.testing.assert_allclose(read[levels > 0], depth[levels > 0], atol=1e-4)
    heights = cv2.imread(str(tmp_path / "height.png"), cv2.IMREAD_UNCHANGED)
    # Towards the viewer: the nearest pixel is the brightest.
    assert heights[np.unravel_index(np.nanargmin(depth), depth.shape)] == 65535
    assert heights[np.unravel_index(np.nanargmax(depth), depth.shape)] == 0
    for name, steps in (("depth.png", 65534), ("height.png", 65535)):
        text = Image.open(tmp_path / name).text["Description"]
        assert f" * {float(far - near) / steps:.9g} mm," in text
    text = Image.open(tmp_path / "height.png").text["Description"]
    assert text == facts["height.png"] and f"full scale {far - near:.9g} mm" in text


@pytest.mark.parametrize("depth", [np.full((3, 4), np.nan), np.ones((3, 4))])
def test_flat_and_empty_depth(depth, tmp_path):
    write_depth(tmp_path, depth.astype(np.float32), unit="pixels")
    levels = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(levels, np.where(np.isnan(depth), 0, 1))


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_mesh_is_read_back(suffix, tmp_path):
    depth = bowl()
    mesh = mesh_of_depth(depth, pixel_size=2.0)
    colors = np.random.default_rng(0).integers(0, 256, (*depth.shape, 3), np.uint8)
    path = tmp_path / f"mesh{suffix}"
    count = write_mesh(path, mesh, colors=colors, unit="mm")
    read = trimesh.load(path, force="mesh", process=False)
    scale = 1e-3 if suffix == ".glb" else 1.0
    assert len(read.faces) == count == 2 * 12 * 16 - 2 * 3 - 1
    np.testing.assert_allclose(read.vertices, mesh.vertices * scale, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    expected = colors.reshape(-1, 3)[mesh.pixels] / 255
    if suffix != ".glb":
        painted = read.visual.vertex_colors[:, :3] / 255
    else:  # trimesh does not know that integers of 16 bits are normalised
        content, accessor = read_glb(path)
        attributes = content["meshes"][0]["primitives"][0]["attributes"]
        painted = accessor(attributes["COLOR_0"])[:, :3]
        bounds = content["accessors"][attributes["POSITION"]]
        np.testing.assert_allclose(bounds["min"], read.vertices.min(0), atol=1e-6)
        np.testing.assert_allclose(bounds["max"], read.vertices.max(0), atol=1e-6)
        expected = np.where(
            expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4
        )
    np.testing.assert_allclose(painted, expected, atol=0.003)
    unit = b"unit: m" if suffix == ".glb" else b"unit: mm"
    assert suffix == ".glb" or unit in path.read_bytes()


def test_dark_photographs_keep_their_levels_in_glb(tmp_path):
    """Of 64 dark levels 14 were left when colours had 8 linear bits."""
    depth = np.zeros((8, 8), np.float32)
    colors = np.repeat(np.arange(64, dtype=np.uint8).reshape(8, 8, 1), 3, -1)
    path = tmp_path / "mesh.glb"
    write_mesh(path, mesh_of_depth(depth), colors=colors)
    content, accessor = read_glb(path)
    number = content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    found = content["accessors"][number]
    assert found["normalized"] and found["componentType"] == 5123
    assert len(np.unique(accessor(number)[:, 0])) == 64
    # A mesh without a material is metal, seen from one side.
    (material,) = content["materials"]
    assert content["meshes"][0]["primitives"][0]["material"] == 0
    assert material["doubleSided"]
    assert material["pbrMetallicRoughness"]["metallicFactor"] == 0


def test_glb_is_whole(tmp_path):
    path = tmp_path / "mesh.glb"
    write_mesh(path, mesh_of_depth(bowl()))
    data = path.read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))


def test_mesh_faces_the_viewer_and_stands_upright():
    depth = bowl()
    mesh = mesh_of_depth(depth)
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    top = mesh.vertices[mesh.pixels // 17 == 1]
    bottom = mesh.vertices[mesh.pixels // 17 == 12]
    assert top[:, 1].min() > bottom[:, 1].max()
    nearest = mesh.vertices[mesh.pixels == np.nanargmin(depth)]
    assert nearest[0, 2] == mesh.vertices[:, 2].max()


def test_perspective_vertices_lie_on_their_rays():
    depth = bowl() + 40
    mesh = mesh_of_depth(depth, focal=50.0, principal_point=(3.0, 4.0))
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose(50 * x / -z + 3, mesh.pixels % 17, atol=1e-4)
    np.testing.assert_allclose(-50 * y / -z + 4, mesh.pixels // 17, atol=1e-4)
    np.testing.assert_allclose(-z, depth.ravel()[mesh.pixels], rtol=1e-6)


@pytest.mark.parametrize(
    ("focal", "side", "depths"),
    [
        (None, 1.0, (0, 30)),
        (None, 0.1, (0, 3)),
        (20.0, 1.0, (40, 100)),
        (20.0, 1.0, (1, 3)),
    ],
)
def test_jumps_are_not_bridged(focal, side, depths):
    depth = np.full((6, 8), depths[0], np.float32)
    depth[:, 4:] = depths[1]
    whole = mesh_of_depth(depth, focal=focal, pixel_size=side, cut=None)
    cut = mesh_of_depth(depth, focal=focal, pixel_size=side, cut=10.0)
    assert len(whole.faces) == 2 * 5 * 7
    assert len(cut.faces) == 2 * 5 * 6
    parts = trimesh.Trimesh(cut.vertices, cut.faces, process=False).body_count
    assert parts == 2


def test_simplified_mesh_keeps_shape_and_colors(tmp_path):
    pytest.importorskip(
        "fast_simplification", reason="fast-simplification is not installed"
    )
    row, column = np.mgrid[:60, :60].astype(np.float32)
    depth = 0.01 * ((column - 30) ** 2 + (row - 30) ** 2)
    colors = np.zeros((60, 60, 3), np.uint8)
    colors[:, 30:] = 200
    path = tmp_path / "mesh.ply"
    count = write_mesh(path, mesh_of_depth(depth), colors=colors, max_faces=800)
    read = trimesh.load(path, process=False)
    assert count == len(read.faces) <= 800
    x, y, z = read.vertices.T
    assert np.abs(z + 0.01 * ((x - 0.5) ** 2 + (y + 0.5) ** 2)).max() < 0.2
    bright = read.visual.vertex_colors[:, 0] > 100
    assert bright[x > 2].all() and not bright[x < -2].any()


def test_simplified_meshes_are_the_same_in_any_unit(tmp_path):
    pytest.importorskip(
        "fast_simplification", reason="fast-simplification is not installed"
    )
    row, column = np.mgrid[:60, :60].astype(np.float32) - 29.5
    depth = 0.01 * (row**2 + column**2) - np.maximum(0, 6 - abs(column))
    meshes = []
    for side in (1.0, 2e-5):
        write_mesh(
            tmp_path / "mesh.ply",
            mesh_of_depth(side * depth, pixel_size=side),
            max_faces=400,
        )
        meshes.append(trimesh.load(tmp_path / "mesh.ply").vertices / side)
    # As far as rounding decides between edges; without units, 0.9 at most.
    off = cKDTree(meshes[0]).query(meshes[1])[0]
    assert np.median(off) < 0.01, np.quantile(off, [0.5, 0.9, 1])


def test_bad_meshes_are_one_line(tmp_path):
    with pytest.raises(InputError, match="expected a mesh ending in .ply, .obj, .glb"):
        write_mesh(tmp_path / "mesh.stl", mesh_of_depth(bowl()))
    lonely = np.full((4, 4), np.nan, np.float32)
    lonely[1, 1] = 1
    with pytest.raises(InputError, match="got no triangle"):
        write_mesh(tmp_path / "mesh.ply", mesh_of_depth(lonely))
    with pytest.raises(ValueError, match="cut: expected above 0, got 0"):
        mesh_of_depth(bowl(), cut=0)
