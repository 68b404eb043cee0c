"""`unips surface`, and depth and mesh of `unips estimate`."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image
from plain_objects import hemisphere

from unips_jax.cli.estimate import main as estimate
from unips_jax.cli.surface import main as surface
from unips_jax.errors import InputError
from unips_jax.io.color import srgb_encode
from unips_jax.io.normals import encode_normals
from unips_jax.io.photographs import select
from unips_jax.surface.outputs import focal_of, photograph_colors
from unips_jax.viewer.page import notes_in

trimesh = pytest.importorskip("trimesh", reason="the extra [mesh] is not installed")


def read_depth(folder):
    import OpenEXR

    return OpenEXR.File(str(folder / "depth.exr")).channels()["Z"].pixels


@pytest.fixture
def files(tmp_path):
    normals, mask, _ = hemisphere()
    np.save(tmp_path / "normals.npy", normals)
    cv2.imwrite(str(tmp_path / "map.png"), encode_normals(normals)[..., ::-1])
    down = encode_normals(normals * [1, -1, 1])[..., ::-1]
    cv2.imwrite(str(tmp_path / "directx.png"), down)
    away = encode_normals(normals * [1, -1, -1])[..., ::-1]
    cv2.imwrite(str(tmp_path / "opencv.png"), away)
    cv2.imwrite(str(tmp_path / "mask.png"), np.uint8(255 * mask))
    photo = np.zeros((48, 48, 3), np.uint8)
    photo[:24, :, 2] = 255  # red above
    cv2.imwrite(str(tmp_path / "photo.png"), photo)
    return tmp_path


@pytest.mark.parametrize(
    "given",
    [
        ["normals.npy"],
        ["map.png"],
        ["directx.png", "--normal-map", "directx"],
        ["opencv.png", "--normal-map", "opencv"],
    ],
)
def test_depth_in_millimetres(given, files, capsys):
    name, *options = given
    arguments = [str(files / name), "-o", str(files / "out"), *options]
    assert surface([*arguments, "--scale", "0.5", "--unit", "mm"]) == 0
    _, mask, truth = hemisphere()
    error = read_depth(files / "out")[mask] - 0.5 * truth[mask]
    assert np.abs(error - error.mean()).max() < 0.1
    record = json.loads((files / "out" / "surface.json").read_text())
    assert record["unit"] == "mm" and record["islands"] == 1
    assert record["far"] - record["near"] == pytest.approx(0.5 * 21.6, abs=1.5)
    assert "farthest" in capsys.readouterr().out


def test_mesh_with_the_photographs_colors(files):
    arguments = [str(files), "-o", str(files / "out"), "--mesh", "ply"]
    photo = ["--photograph", str(files / "photo.png"), "--mask"]
    scale = ["--scale", "0.5", "--unit", "mm"]
    assert surface([*arguments, *scale, *photo, str(files / "mask.png")]) == 0
    mesh = trimesh.load(files / "out" / "mesh.ply", process=False)
    red = mesh.visual.vertex_colors[:, 0] == 255
    assert np.array_equal(red, mesh.vertices[:, 1] > 0)
    across, depth = np.ptp(mesh.vertices, axis=0)[[0, 2]]
    columns = cv2.imread(str(files / "mask.png"), 0).any(axis=0).sum()
    assert across == pytest.approx(0.5 * (columns - 1), abs=1.1)
    assert depth == pytest.approx(0.5 * 21.6, abs=1.5)


def test_depth_is_a_prior_of_the_next(files):
    first = [str(files / "normals.npy"), "-o", str(files / "one"), "--focal", "90"]
    assert surface([*first, "--scale", "600", "--unit", "mm"]) == 0
    one = read_depth(files / "one")
    second = [*first[:2], str(files / "two"), *first[3:]]
    assert surface([*second, "--prior", str(files / "one" / "depth.exr")]) == 0
    # Measured: 0.0013 where the normal faces away from the camera, elsewhere 1e-5.
    np.testing.assert_allclose(read_depth(files / "two"), one, rtol=0.005)
    record = json.loads((files / "two" / "surface.json").read_text())
    assert record["unit"] == "prior's units"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--max-faces", "9"], "--max-faces: expected something to use it for, got"),
        (["--directx"], "--directx: expected something to use it for, got none"),
        (["--focal", "far"], "--focal: expected pixels above 0, or exif, got far"),
        (["--focal", "exif"], "--focal exif: expected a photograph, got none"),
        (["--scale", "0"], "--scale: expected above 0, got 0.0"),
        (["--scale", "0.5"], "--scale 0.5: expected its unit, got none; add --unit mm"),
        (
            ["--scale", "9", "--unit", "inch", "--export", "print"],
            "--unit inch: expected one of m, cm, mm with --export blender or print",
        ),
        (["--prior", "z.npy", "--focal", "90"], "expected a depth above 0 at some"),
        (["--prior", "nan.npy"], "--prior: expected a depth at some pixel"),
        (["--mask", "small.png"], "expected the normals' size, 48 x 48, got 5 x 4"),
        (["--prior", "mask.png"], "expected depth as an EXR with channel Z"),
        (["--photograph", "photo.png", "--focal", "exif"], "expected EXIF data"),
    ],
)
def test_bad_options_are_one_line(options, message, files, capsys, monkeypatch):
    monkeypatch.chdir(files)
    cv2.imwrite("small.png", np.full((4, 5), 255, np.uint8))
    np.save("z.npy", np.full((48, 48), -500.0))
    np.save("nan.npy", np.full((48, 48), np.nan))
    assert surface(["normals.npy", "-o", "out", *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (files / "out").exists()


def test_a_model_and_a_mesh_of_one_name_are_refused(files, capsys):
    (files / "normals.npy").rename(files / "mesh.npy")
    given = [str(files / "mesh.npy"), "-o", str(files / "out"), "--mesh", "glb"]
    assert surface([*given, "--export", "blender"]) == 2
    assert "got mesh.glb for both; rename" in capsys.readouterr().err


def test_bad_normals_are_one_line(files, capsys):
    np.save(files / "flat.npy", np.ones((4, 5)))
    np.save(files / "none.npy", np.zeros((4, 5, 3)))
    for name, message in (
        ("flat.npy", "expected normals, [H, W, 3], got (4, 5)"),
        ("none.npy", "expected normals, got none"),
        ("absent.npy", "cannot be read"),
    ):
        assert surface([str(files / name), "-o", str(files / "out")]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1


def test_files_of_others_names_stay(files):
    """Names that another command's results have are the reader's own here."""
    first = [str(files / "normals.npy"), "-o", str(files / "out")]
    assert surface(first) == 0
    for name in ("normals.png", "base_color.png", "mine.png"):
        (files / "out" / name).write_bytes((files / "map.png").read_bytes())
    assert surface(first) == 0
    assert surface([str(files / "out" / "normals.png"), *first[1:]]) == 0
    for name in ("normals.png", "base_color.png", "mine.png"):
        assert (files / "out" / name).is_file()


def test_folders_of_others_are_left_alone(files, capsys):
    assert surface([str(files / "normals.npy"), "-o", str(files)]) == 2
    assert "got one with other files" in capsys.readouterr().err


def noise(folder):
    """A folder of two photographs of nothing."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(2):
        image = rng.integers(40, 200, (40, 44, 3), np.uint8)
        cv2.imwrite(str(folder / f"{index}.png"), image)
    return folder


def test_estimate_writes_depth_and_mesh(tmp_path):
    folder = noise(tmp_path / "thing")
    arguments = [str(folder), "-o", str(tmp_path / "out"), "--mesh", "obj"]
    assert estimate([*arguments, "--focal", "80", "--view"]) == 0
    out = tmp_path / "out" / "thing"
    record = json.loads((out / "normals.json").read_text())
    names = {"depth.exr", "depth.png", "height.png", "mesh.obj", "normals.npy"}
    names |= {"view.html"}
    assert names <= set(record["files"])
    assert record["surface"]["camera"] == "perspective"
    assert record["surface"]["focal_px"] == 80
    depth = read_depth(out)
    assert np.exp(np.log(depth).mean()) == pytest.approx(1, abs=1e-4)
    assert estimate([*arguments, "--focal", "80", "--view"]) == 0  # up to date
    # What a reader wrote into the page is in the next one too.
    html, notes = (out / "view.html").read_text(), {"notes": [], "views": [1]}
    html = html.replace('id="notes">{}<', f'id="notes">{json.dumps(notes)}<')
    (out / "view.html").write_text(html)
    assert estimate([*arguments, "--focal", "90", "--view"]) == 0
    assert notes_in(out / "view.html") == notes
    # A page of version 0.2.0 has no place for notes: it is of the normals before.
    (out / "view.html").write_text("no notes")
    assert estimate([*arguments, "--focal", "95"]) == 0
    assert not (out / "view.html").exists()
    # The results are no photographs, should they be read as a folder of them.
    (out / "photo.png").write_bytes((folder / "0.png").read_bytes())
    assert select(out).names == ("photo.png",)


def test_of_a_wire_all_is_written_but_the_mesh(tmp_path, capsys):
    folder = noise(tmp_path / "wire")
    row = np.zeros((40, 44), np.uint8)
    row[20, 5:40] = 255
    cv2.imwrite(str(folder / "mask.png"), row)
    assert estimate([str(folder), "-o", str(tmp_path / "out"), "--mesh", "ply"]) == 0
    warned = capsys.readouterr().err
    assert "warning: no mesh: mesh.ply: expected a surface of more than" in warned
    out = tmp_path / "out" / "wire"
    names = {path.name for path in out.iterdir()}
    assert {"normals.npy", "depth.exr"} <= names and "mesh.ply" not in names
    record = json.loads((out / "normals.json").read_text())
    assert any(text.startswith("no mesh: ") for text in record["warnings"])


def test_focal_without_depth_is_refused(tmp_path, capsys):
    assert estimate([str(tmp_path), "-o", str(tmp_path / "o"), "--focal", "9"]) == 2
    assert "--focal: expected a depth to use it for" in capsys.readouterr().err


def test_pixels_of_a_focal_length_are_compared_with_the_longer_side():
    for size in ((400, 100), (100, 400)):
        assert focal_of("100", None, None, size) == 100
        with pytest.raises(InputError, match="sees 127 degrees on 400 pixels"):
            focal_of("99", None, None, size)


def test_colours_of_linear_photographs_reach_white():
    encoded = np.uint8([[[10, 20, 100]]])
    np.testing.assert_array_equal(photograph_colors(encoded, "srgb"), encoded)
    linear = np.float32([[[0.01, 0.05, 0.1]]])
    expected = np.rint(255 * srgb_encode(linear / 0.1))
    found = photograph_colors(linear, "linear").astype(int)
    np.testing.assert_allclose(found, expected, atol=1)


def test_a_focal_length_in_exif_is_the_depths(tmp_path):
    """50 mm for a 35 mm film, in a photograph of 40 x 44."""
    folder = noise(tmp_path / "thing")
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 50
    for path in folder.glob("*.png"):
        Image.open(path).save(path.with_suffix(".jpg"), exif=exif)
        path.unlink()
    arguments = [str(folder), "-o", str(tmp_path / "out"), "--depth"]
    assert estimate([*arguments, "--focal", "exif"]) == 0
    record = json.loads((tmp_path / "out" / "thing" / "normals.json").read_text())
    expected = 50 / np.hypot(36, 24) * np.hypot(40, 44)
    assert record["surface"]["focal_px"] == pytest.approx(expected, rel=1e-3)


def test_models_of_a_perspective_camera_are_along_rays(files):
    arguments = [str(files / "normals.npy"), "-o", str(files / "out"), "--focal", "90"]
    assert surface([*arguments, "--mesh", "ply", "--export", "blender"]) == 0
    mesh = trimesh.load(files / "out" / "mesh.ply", process=False)
    x, y, z = mesh.vertices.T
    for place in (90 * x / -z + 23.5, 90 * y / -z + 23.5):
        np.testing.assert_allclose(place, np.rint(place), atol=0.01)
    (path,) = (files / "out").glob("*.glb")
    model = trimesh.load(path, force="mesh")
    shape, expected = (m.extents / m.extents[0] for m in (model, mesh))
    np.testing.assert_allclose(shape, expected, rtol=0.3)  # at the rim one has more
