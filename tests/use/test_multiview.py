"""Several views of an object, read back by the conventions of those who read them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from picture_files import png_with_orientation

from unips_jax.cli.multiview import main
from unips_jax.io.cameras import read_sfm_data, sfm_data_of
from unips_jax.io.images import read_image, read_image_file, turned, write_image
from unips_jax.io.normals import decode_normals, write_normals
from unips_jax.io.orientation import normals_as_stored
from unips_jax.io.results import file_hash, write_record

WIDTH, HEIGHT, FOCAL = 60, 44, 70.0
RADIUS, MIDDLE = 0.5, np.array([0.3, -0.2, 4.0])
OFFSET = np.array([1.5, -2.0])  # of the principal point


def rotation(angle):
    """World to camera: turned about the vertical, then tilted a little."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    tilt = np.array([[1, 0, 0], [0, 0.96, -0.28], [0, 0.28, 0.96]])
    return tilt @ turn


def camera(index):
    turn = rotation(0.7 * index)
    return turn, MIDDLE - turn.T @ [0, 0, 3.0]  # it looks at the middle


def seen(index, width=WIDTH, height=HEIGHT):
    """Normals of a sphere (x right, y up, z towards the viewer), by tracing rays."""
    turn, center = camera(index)
    scale = width / WIDTH
    y, x = np.mgrid[:height, :width] + 0.5
    middle = scale * (np.array([WIDTH, HEIGHT]) / 2 + OFFSET)
    rays = np.stack([x - middle[0], y - middle[1], 0 * x + FOCAL * scale], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    to = turn @ (MIDDLE - center)
    along = rays @ to
    inside = along**2 - to @ to + RADIUS**2
    depth = along - np.sqrt(np.maximum(inside, 0))
    normals = (rays * depth[..., None] - to) / RADIUS * [1, -1, -1]
    return (normals * (inside > 0)[..., None]).astype(np.float32)


def sfm_data(folder, version):
    """As AliceVision writes it: text for numbers, matrices column by column."""
    if version in ("1.0", "1.2.1"):
        point = OFFSET if version == "1.2.1" else np.array([WIDTH, HEIGHT]) / 2 + OFFSET
        lens = {"pxFocalLength": str(FOCAL), "pxInitialFocalLength": "-1"}
    else:
        point = OFFSET
        lens = {"sensorWidth": "36", "focalLength": str(36 * FOCAL / WIDTH)}
        lens["pixelRatio"] = "1"
    lens |= {"intrinsicId": "77", "type": "pinhole", "distortionParams": []}
    lens |= {"width": str(WIDTH), "height": str(HEIGHT)}
    lens["principalPoint"] = [str(value) for value in point]
    views, poses = [], []
    for index in range(3):
        turn, center = camera(index)
        for light in range(2):
            number = 100 * index + light
            path = str(folder / f"place{index}" / f"{light}.png")
            view = {"viewId": str(number), "poseId": str(5 + index), "path": path}
            view |= {"intrinsicId": "77", "width": str(WIDTH), "height": str(HEIGHT)}
            views.append(view | {"metadata": {"a": "b"}})
        transform = {"rotation": [str(value) for value in turn.T.ravel()]}
        transform["center"] = [str(value) for value in center]
        pose = {"transform": transform, "locked": "0"}
        poses.append({"poseId": str(5 + index), "pose": pose})
    number = [*version.split("."), "0"][:3]
    content = {"version": number, "views": views}
    return content | {"intrinsics": [lens], "poses": poses}


def write_results(folder, index, *, half=False, color=True):
    photographs = folder / f"place{index}"
    for light in range(2):
        image = np.full((HEIGHT, WIDTH, 3), 90 + light, np.uint8)
        write_image(photographs / f"{light}.png", image)
    result = folder / "results" / f"place{index}"
    result.mkdir(parents=True)
    size = (WIDTH // 2, HEIGHT // 2) if half else (WIDTH, HEIGHT)
    write_normals(result, seen(index, *size))
    if color:
        base = np.full((*size[::-1], 3), 1000 * (index + 1), np.uint16)
        write_image(result / "base_color.png", base)
    names = ("0.png", "1.png")
    images = {name: file_hash(photographs / name) for name in names}
    write_record(result, {"folder": str(photographs), "images": images})
    return result


def record_anew(folder):
    """After its files were changed."""
    record = json.loads((folder / "normals.json").read_text())
    (folder / "normals.json").unlink()
    write_record(folder, record)


def given(tmp_path, version="1.2", **options):
    content = sfm_data(tmp_path, version)
    (tmp_path / "in.sfm").write_text(json.dumps(content))
    return [str(write_results(tmp_path, index, **options)) for index in range(3)]


@pytest.mark.parametrize("version", ["1.0", "1.2", "1.2.1"])
def test_idr_cameras_project_as_the_views_do(tmp_path, version, capsys):
    results = given(tmp_path, version, half=version == "1.0")
    out = tmp_path / "out"
    assert (
        main([*results[::-1], "--sfm", str(tmp_path / "in.sfm"), "-o", str(out)]) == 0
    )
    assert "3 views" in capsys.readouterr().out
    cameras = np.load(out / "cameras.npz")
    for index in range(3):
        normals = decode_normals(read_image(out / "normal" / f"{index:03}.png"))
        mask = cv2.imread(str(out / "mask" / f"{index:03}.png"), 0) > 0
        truth = seen(index, mask.shape[1], mask.shape[0])
        np.testing.assert_array_equal(mask, (truth != 0).any(-1))
        np.testing.assert_allclose(normals[mask], truth[mask], atol=2e-5)
        # As IDR and NeuS take it apart: K, R and t of world_mat times scale_mat.
        world, scale = (cameras[f"{name}_mat_{index}"] for name in ("world", "scale"))
        matrix, turn, place = cv2.decomposeProjectionMatrix((world @ scale)[:3])[:3]
        factor = mask.shape[1] / WIDTH
        expected = factor * (np.array([WIDTH, HEIGHT]) / 2 + OFFSET)
        np.testing.assert_allclose(matrix[:2, 2] / matrix[2, 2], expected, rtol=1e-6)
        assert matrix[0, 0] / matrix[2, 2] == pytest.approx(FOCAL * factor)
        np.testing.assert_allclose(turn, camera(index)[0], atol=1e-9)
        # The unit sphere is the object's: the middle within 6%, little of it outside.
        np.testing.assert_allclose(scale[:3, 3], MIDDLE, atol=0.06 * RADIUS)
        assert 0.98 * RADIUS < scale[0, 0] < 1.12 * RADIUS
        place = scale[:3, :3] @ (place[:3] / place[3]).ravel() + scale[:3, 3]
        np.testing.assert_allclose(place, camera(index)[1], atol=1e-6)
        # The middle normal turned to the world looks at the camera.
        towards = camera(index)[1] - MIDDLE
        y, x = np.mgrid[: mask.shape[0], : mask.shape[1]] + 0.5
        spot = world @ [*(MIDDLE + RADIUS * towards / np.linalg.norm(towards)), 1]
        column, row = (spot[:2] / spot[2]).astype(int)
        turned = camera(index)[0].T @ (normals[row, column] * [1, -1, -1])
        assert turned @ towards / np.linalg.norm(towards) > 0.99


@pytest.mark.parametrize(("orientation", "back"), [(3, 3), (6, 8), (8, 6)])
def test_results_are_turned_as_the_cameras_pictures(tmp_path, orientation, back):
    """SfMData has pictures as they are stored, results as viewers show them."""
    (tmp_path / "plain").mkdir()
    given(tmp_path / "plain")
    results = str(tmp_path / "plain" / "results" / "*")
    command = ["--sfm", str(tmp_path / "plain" / "in.sfm"), "-o"]
    assert main([results, *command, str(tmp_path / "expected")]) == 0
    results = given(tmp_path)
    for index, folder in enumerate(map(Path, results)):
        for path in (tmp_path / f"place{index}").iterdir():
            path.write_bytes(png_with_orientation(path.read_bytes(), orientation))
        write_normals(folder, normals_as_stored(seen(index), back))
        color = read_image(folder / "base_color.png")
        write_image(folder / "base_color.png", turned(color, orientation))
        record_anew(folder)
    command = ["--sfm", str(tmp_path / "in.sfm"), "-o", str(tmp_path / "out")]
    assert main([*results, *command]) == 0
    found, expected = (
        np.load(tmp_path / n / "cameras.npz") for n in ("out", "expected")
    )
    for name in expected:
        np.testing.assert_allclose(found[name], expected[name], atol=1e-9)
    for name in ("normal", "mask", "albedo"):
        pictures = (tmp_path / n / name / "001.png" for n in ("out", "expected"))
        difference = np.subtract(*(read_image(p).astype(int) for p in pictures))
        assert np.abs(difference).max() <= 1  # 0 is halfway between two levels
    color = read_image_file(tmp_path / "out" / "albedo" / "001.png")
    assert color.encoding.transfer == "srgb"  # by its tag


@pytest.mark.parametrize("orientation", range(1, 9))
def test_normals_turn_with_their_picture(orientation):
    height = cv2.GaussianBlur(np.random.default_rng(0).random((20, 30)), (0, 0), 3)

    def normals(height):
        down, right = np.gradient(height)
        return np.stack([-right, down, np.ones_like(height)], -1)

    shown = normals(turned(height, orientation))
    np.testing.assert_allclose(normals_as_stored(shown, orientation), normals(height))


def test_nothing_of_an_earlier_run_stays(tmp_path):
    """But for what is the user's."""
    results, out = given(tmp_path), tmp_path / "out"
    command = ["--sfm", str(tmp_path / "in.sfm"), "-o", str(out)]
    assert main([*results, *command]) == 0
    (out / "notes.txt").write_text("mine")
    (Path(results[0]) / "base_color.png").unlink()
    record_anew(Path(results[0]))
    assert main([*results[:2], *command]) == 0
    assert not (out / "albedo").exists() and not (out / "albedos.sfm").exists()
    assert sorted(path.name for path in (out / "normal").iterdir()) == (
        ["000.png", "001.png"]
    )
    assert (out / "notes.txt").read_text() == "mine"


def test_without_photographs_a_warning_says_that_none_are_turned(tmp_path, capsys):
    results = given(tmp_path)
    command = ["--sfm", str(tmp_path / "in.sfm"), "-o", str(tmp_path / "out")]
    assert main([*results, *command]) == 0
    assert "to tell how EXIF turned them" not in capsys.readouterr().err
    for path in tmp_path.glob("place0/*.png"):
        path.unlink()
    assert main([*results, *command]) == 0
    (warned,) = capsys.readouterr().err.splitlines()
    assert f"warning: {results[0]}: none of its photographs is there" in warned


def test_crops_are_refused(tmp_path, capsys):
    results = given(tmp_path)
    path = Path(results[1]) / "normals.json"
    record = json.loads(path.read_text()) | {"options": {"reader": "official"}}
    path.write_text(json.dumps(record))
    command = ["--sfm", str(tmp_path / "in.sfm"), "-o", str(tmp_path / "out")]
    assert main([*results, *command]) == 2
    assert "got those of a square crop (--reader official)" in capsys.readouterr().err


def test_pictures_of_another_shape_are_refused(tmp_path, capsys):
    results = given(tmp_path)
    write_normals(Path(results[1]), seen(1, HEIGHT, HEIGHT))
    record_anew(Path(results[1]))
    command = ["--sfm", str(tmp_path / "in.sfm"), "-o", str(tmp_path / "out")]
    assert main([*results, *command]) == 2
    said = "expected normals of the shape of pose 6, 60 x 44, got 44 x 44"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("version", ["1.0", "1.2"])
def test_sfm_data_has_scaled_lenses_and_pictures(tmp_path, version):
    results = given(tmp_path, version, half=True)
    out = tmp_path / "out"
    assert main([*results, "--sfm", str(tmp_path / "in.sfm"), "-o", str(out)]) == 0
    original = sfm_data(tmp_path, version)
    for kind in ("normal", "mask", "albedo"):
        data = json.loads((out / f"{kind}s.sfm").read_text())
        assert [view["viewId"] for view in data["views"]] == ["0", "100", "200"]
        assert data["poses"] == original["poses"]
        for index, view in enumerate(data["views"]):
            assert view["path"] == str((out / kind / f"{index:03}.png").resolve())
            assert (view["width"], view["height"]) == ("30", "22")
        (lens,) = data["intrinsics"]
        assert (lens["width"], lens["height"]) == (str(WIDTH // 2), str(HEIGHT // 2))
        # Millimetres stay, pixels are half as many.
        before = original["intrinsics"][0]
        assert lens.get("focalLength") == before.get("focalLength")
        if version == "1.0":
            assert float(lens["pxFocalLength"]) == FOCAL / 2
        for found, point in zip(
            lens["principalPoint"], before["principalPoint"], strict=True
        ):
            assert float(found) == pytest.approx(float(point) / 2)
    color = cv2.imread(str(out / "albedo" / "002.png"), cv2.IMREAD_UNCHANGED)
    assert color.dtype == np.uint16 and (color == 3000).all()


def test_focal_lengths_of_columns_and_rows(tmp_path):
    content = sfm_data(tmp_path, "1.0")
    content["intrinsics"][0]["pxFocalLength"] = ["50", "40"]
    (tmp_path / "in.sfm").write_text(json.dumps(content))
    cameras, _ = read_sfm_data(tmp_path / "in.sfm")
    for found in cameras:
        np.testing.assert_allclose(np.diag(found.matrix), [50, 40, 1])


def test_lenses_of_another_size_have_numbers_of_their_own(tmp_path):
    """Of three views by lens 77, one at half size; another lens has the next number."""
    content = sfm_data(tmp_path, "1.2")
    content["intrinsics"].append(content["intrinsics"][0] | {"intrinsicId": "78"})
    for view in content["views"][4:]:
        view["intrinsicId"] = "78"
    (tmp_path / "in.sfm").write_text(json.dumps(content))
    cameras, _ = read_sfm_data(tmp_path / "in.sfm")
    whole, half = (WIDTH, HEIGHT), (WIDTH // 2, HEIGHT // 2)
    found = sfm_data_of(content, cameras, ["a", "b", "c"], [whole, half, whole])
    widths = {lens["intrinsicId"]: lens["width"] for lens in found["intrinsics"]}
    assert widths == {"77": str(WIDTH), "79": str(WIDTH // 2), "78": str(WIDTH)}
    assert [view["intrinsicId"] for view in found["views"]] == ["77", "79", "78"]


def test_what_does_not_belong_is_refused(tmp_path, capsys):
    results = given(tmp_path, color=False)
    sfm, out = str(tmp_path / "in.sfm"), str(tmp_path / "out")

    def refused(arguments, text):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert text in error and error.count("\n") == 1
        assert not (tmp_path / "out").exists()

    refused(["--sfm", sfm, "-o", out], "expected folders of results")
    refused(
        [results[0], "--sfm", sfm, "-o", out], "expected views from different sides"
    )
    refused([*results, results[0], "--sfm", sfm, "-o", out], "got 5 again")
    refused([str(tmp_path), "--sfm", sfm, "-o", out], "normals.json: cannot be read")
    content = sfm_data(tmp_path / "elsewhere", "1.2")
    (tmp_path / "other.sfm").write_text(json.dumps(content))
    other = ["--sfm", str(tmp_path / "other.sfm"), "-o", out]
    refused([*results, *other], "expected photographs of a pose")
    for text in ("[]", "{", '{"views": [], "intrinsics": []}'):
        (tmp_path / "other.sfm").write_text(text)
        refused([*results, *other], "expected ")
    content = sfm_data(tmp_path, "1.2")
    content["intrinsics"][0]["pixelRatio"] = "0.5"
    (tmp_path / "other.sfm").write_text(json.dumps(content))
    refused([*results, *other], "other.sfm: expected lenses of pixelRatio 1, got 0.5")
    content = sfm_data(tmp_path, "1.2")
    for view in content["views"]:  # two cameras of a rig, a pose for both
        view["subPoseId"] = view["path"][-5]
    (tmp_path / "other.sfm").write_text(json.dumps(content))
    refused([*results, *other], "expected one camera a pose, got several of a rig")
    # Without colours there is no albedo; distortion is not passed over in silence.
    content = sfm_data(tmp_path, "1.2")
    content["intrinsics"][0]["distortionParams"] = ["0.1"]
    (tmp_path / "in.sfm").write_text(json.dumps(content))
    assert main([*results, "--sfm", sfm, "-o", out]) == 0
    assert "its lenses distort" in capsys.readouterr().err
    assert not (tmp_path / "out" / "albedos.sfm").exists()


def test_results_are_turned_as_their_records_say(tmp_path):
    (tmp_path / "plain").mkdir()
    results = given(tmp_path / "plain", color=False)
    cameras = ["--sfm", str(tmp_path / "plain" / "in.sfm"), "-o"]
    assert main([*results, *cameras, str(tmp_path / "expected")]) == 0
    for index, folder in enumerate(map(Path, results)):
        write_normals(folder, normals_as_stored(seen(index), 8))
        record = json.loads((folder / "normals.json").read_text())
        (folder / "normals.json").write_text(json.dumps(record | {"orientation": 6}))
        record_anew(folder)
    assert main([*results, *cameras, str(tmp_path / "out")]) == 0
    found, expected = (
        read_image(tmp_path / name / "normal" / "001.png").astype(int)
        for name in ("out", "expected")
    )
    assert np.abs(found - expected).max() <= 1
