"""Faults planted in photographs are found, and sound photographs pass."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from capture_checks import STRIPES, check, moved
from estimate_runs import run
from picture_files import with_orientation
from PIL import Image
from plain_objects import PLAIN, lights, photographs

from unips_jax.capture.check import _look_at_cameras
from unips_jax.capture.folder import check_photographs
from unips_jax.capture.light import look_at_light, rough_lights
from unips_jax.cli import main as cli
from unips_jax.cli.demo import SAMPLE
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select


@pytest.mark.parametrize("name", PLAIN)
def test_sound_photographs_pass(name):
    options = {**PLAIN[name], "count": 8, "srgb": True}
    images, mask = photographs(4, **options)
    assert check(images, mask) == []


def test_honest_photographs_hardly_warn():
    """Of more than fifty sets one warns at most, of what is not so."""
    true = {"linear": {"probably linear"}, "three photographs": {"few photographs"}}
    false = []
    for name, options in PLAIN.items():
        for seed in (0, 1, 2):
            images, mask = photographs(seed, **{"count": 8, **options})
            kinds = {finding.kind for finding in check(images, mask)}
            false += [(name, seed, kind) for kind in kinds - true.get(name, set())]
    assert len(false) <= 1, false


def test_a_hole_through_which_the_background_is_seen_is_no_fault():
    images, mask = photographs(4, count=8)
    row, column = np.argwhere(mask).mean(axis=0).astype(int)
    hole = np.zeros_like(mask)
    hole[row : row + 4, column : column + 3] = True
    (finding,) = check(images, mask & ~hole)
    assert finding.text.startswith("small holes in the mask: 1 of together 12 pixels")
    seen = images.copy()
    seen[:, hole] //= 16
    assert check(seen, mask & ~hole) == []


def test_black_specks_leave_no_holes_in_a_suggested_mask(tmp_path):
    images, mask = photographs(4, count=8)
    rows, columns = np.argwhere(cv2.erode(mask.astype(np.uint8), np.ones((25, 25)))).T
    images[:, rows[::400], columns[::400]] = 0
    for index, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{index}.png"), image[..., ::-1])
    report = check_photographs(select(tmp_path))
    assert report.findings == () and report.capture.mask_rule
    assert report.capture.mask[rows[::400], columns[::400]].all()


def test_real_photographs_and_the_sample_pass(shared_dir):
    for folder in (*sorted((shared_dir / "photos").glob("*.data")), SAMPLE):
        if folder == SAMPLE:
            folder = folder / "obj000.data"
        selection = select(folder)
        report = check_photographs(selection)
        assert report.findings == () and report.capture is not None


def test_exposure_focus_and_duplicates():
    images, mask = photographs(9, **STRIPES)
    images[0] = np.minimum(images[0] * 2.2, 255)
    images[2] = images[2] // 9
    images[4] = images[3]
    images[6] = cv2.GaussianBlur(images[6], (0, 0), 2.5)
    found = {finding.kind: finding.files for finding in check(images, mask)}
    assert found == {
        "saturated": ("0.png",),
        "underexposed": ("2.png",),
        "duplicates": ("4.png",),
        "out of focus": ("6.png",),
    }


def test_a_camera_whose_white_lies_lower_saturates_too():
    images, mask = photographs(9)
    for dtype in (np.uint16, np.float32):
        raw = images.astype(dtype) * dtype(16)
        raw[1] = np.minimum(raw[1], 1800)
        (finding,) = check(raw, mask)
        assert finding.text.startswith("saturated: 1.png ")


def test_one_photograph_without_the_lamp():
    images, mask = photographs(9)
    images[5] = 7 + images[5] // 60
    kinds = {finding.kind: finding for finding in check(images, mask)}
    assert kinds["unlit"].files == ("5.png",)
    assert "--dark 5.png subtracts it" in kinds["unlit"].text


def test_a_photograph_of_the_dark_hides_nothing_of_the_others():
    images, mask = photographs(3, directions=lights(8, np.linspace(-60, 60, 8)))
    images[5] = np.random.default_rng(0).poisson(0.03, images[5].shape)
    kinds = {finding.kind for finding in check(images, mask)}
    assert kinds == {"unlit", "light from one side"}


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize(
    ("azimuths", "side", "other"),
    [((-60, 60), "right", "left"), ((30, 150), "top", "bottom")],
)
def test_light_from_one_side(seed, azimuths, side, other):
    directions = lights(8, np.linspace(*azimuths, 8))
    images, mask = photographs(seed, directions=directions)
    (finding,) = check(images, mask)
    assert finding.text.startswith(f"light from one side only, the {side}: ")
    assert finding.text.endswith(f"with light from the {other}")


def test_light_along_the_lens():
    images, mask = photographs(3, directions=lights(8, elevation=85), noise=0.002)
    kinds = [finding.kind for finding in check(images, mask)]
    assert kinds in (["light along the lens"], ["same light"])
    images, mask = photographs(3, directions=lights(8, elevation=82))
    assert [f.kind for f in check(images, mask)] == ["light along the lens"]


def test_light_from_a_sky_reaches_both_sides():
    directions = lights(8, np.linspace(60, 120, 8))
    images, mask = photographs(3, directions=directions, srgb=False)
    ambient = images.max(axis=0, keepdims=True).astype(float)
    assert [f.kind for f in look_at_light(images, mask, "linear")]
    surroundings = np.rint(
        0.4 * images + 0.6 * ambient[:, mask].mean() * mask[..., None]
    )
    assert look_at_light(surroundings.astype(np.uint8), mask, "linear") == []


def test_a_relief_shows_no_light_along_the_lens():
    """Its outline says nothing of its shape."""
    rng = np.random.default_rng(0)
    height = cv2.GaussianBlur(rng.normal(size=(180, 220)), (0, 0), 4) * 100
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(down)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    mask = np.zeros((180, 220), bool)
    mask[20:160, 30:190] = True
    values = np.maximum(normals @ lights(8).T, 0).transpose(2, 0, 1) * mask
    images = np.repeat(values[..., None] * 200, 3, -1).astype(np.uint8)
    assert look_at_light(images, mask, "linear") == []


def test_lights_are_roughly_right():
    directions = lights(12, elevation=50)
    images, mask = photographs(3, directions=directions, second=(0.2, 0.2, 0.2))
    found = rough_lights(images, mask, "srgb").directions
    turn = np.degrees(
        np.angle((found[:, 0] + 1j * found[:, 1]) / (directions @ [1, 1j, 0]))
    )
    assert np.abs(turn).max() < 30
    assert rough_lights(images, np.ones_like(mask), "srgb") is None
    # Of a small object in a large picture too.
    around = (300, 300), (400, 400)
    images, mask = np.pad(images, ((0, 0), *around, (0, 0))), np.pad(mask, around)
    np.testing.assert_allclose(rough_lights(images, mask, "srgb").directions, found)
    thin = np.zeros((20, 9000), bool)
    thin[5:15, 3000:3200] = True
    rough_lights(np.zeros((4, *thin.shape, 3), np.uint8), thin, "srgb")


def test_linear_values_of_matte_objects_are_told():
    images, mask = photographs(3, srgb=False)
    (finding,) = check(images, mask)
    assert finding.kind == "probably linear" and "--transfer linear" in finding.text
    assert check(images, mask, "linear", "--transfer") == []


def test_cameras_and_exposures():
    images, mask = photographs(3)
    cameras = ("Maker One",) * 6 + ("Maker Two", "")
    exposures = (0.02,) * 5 + (0.08, 0.02, 0)
    mixed, changes = check(images, mask, cameras=cameras, exposures=exposures)
    assert mixed.text.startswith("mixed cameras: Maker One and Maker Two (6.png)")
    assert changes.text.startswith("exposure changes: 5.png x4 of the usual")
    for factor, count in ((1.2, 0), (1.35, 1), (1 / 1.35, 1)):  # a third of a stop
        exif = SimpleNamespace(cameras=(), exposures=(0.02,) * 3 + (0.02 * factor,))
        assert len(list(_look_at_cameras(exif, list("abcd")))) == count


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "pot"
    folder.mkdir()
    for index, image in enumerate(photographs(10, **STRIPES)[0]):
        exif = Image.Exif()
        exif[0x010F], exif[0x0110] = "Maker", "One\0"
        exif.get_ifd(0x8769).update({0x829A: 1 / 50, 0x829D: 8.0, 0x8827: 200})
        picture = Image.fromarray(image)
        picture.save(folder / f"{index}.jpg", quality=95, exif=exif)
    return folder


@pytest.mark.parametrize(
    ("left", "notes", "said"),
    [
        (0.93, (), "no object found: the whole image is taken as one surface, and a"),
        (0.1, ("9 pixels are black: left out",), "no object found: all that is not bl"),
    ],
)
def test_an_object_that_was_not_found_is_told(left, notes, said):
    images, mask = photographs(4)
    mask[: round(left * len(mask))] = True
    mask[round(left * len(mask)) :] = False
    finding = check(images, mask, mask_contrast=0.3, notes=notes)[0]
    assert finding.kind == "no object" and finding.text.startswith(said)
    found = check(images, mask, mask_contrast=0.7, mask_rule="plain background")
    assert "no object" not in [finding.kind for finding in found]


def test_what_files_tell(folder):
    capture = read_capture(select(folder))
    assert capture.cameras == ("Maker One",) * 8
    np.testing.assert_allclose(capture.exposures, 200 / 50 / 64)


def findings(capsys, *arguments):
    assert cli.main(["check", *map(str, arguments), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def test_the_command(folder, capsys):
    assert cli.main(["check", str(folder)]) == 0
    out, _ = capsys.readouterr()
    assert "8 photographs" in out and "suggested by plain background (0." in out
    assert "nothing found that is wrong" in out
    (report,) = findings(capsys, folder)
    assert report["findings"] == [] and report["mask_suggested"]
    assert report["transfer"] == "srgb" and report["width"] == 220


def test_records_are_in_any_consoles_encoding(folder):
    place = folder.rename(folder.with_name("Büste 像"))
    shown = subprocess.run(
        [sys.executable, "-m", "unips_jax", "check", str(place), "--json"],
        env={**os.environ, "PYTHONIOENCODING": "cp437"},
        capture_output=True,
        check=True,
    )
    assert json.loads(shown.stdout)[0]["folder"] == str(place)


def test_files_that_do_not_fit_together(folder, capsys):
    image = Image.open(folder / "1.jpg")
    image.crop((0, 0, 200, 160)).save(folder / "1.jpg")
    turned = folder / "2.jpg"
    turned.write_bytes(with_orientation(turned.read_bytes(), 3))
    (folder / "3.jpg").write_bytes(b"no photograph")
    cv2.imwrite(str(folder / "4.png"), cv2.imread(str(folder / "4.jpg")) * np.uint16(9))
    (folder / "4.jpg").unlink()
    first, second = findings(capsys, folder, folder.parent / "pot")
    assert first == second
    kinds = {finding["kind"]: finding for finding in first["findings"]}
    assert list(kinds) == [
        "unreadable",
        "mixed sizes",
        "mixed types",
    ]
    assert kinds["mixed sizes"]["files"] == ["1.jpg"]
    assert (
        "1.jpg has 200 x 160 pixels, the others 220 x 180"
        in (kinds["mixed sizes"]["text"])
    )
    (note,) = (note for note in first["notes"] if "orientation" in note)
    assert "2.jpg; turned so that their edges fit" in note
    assert kinds["unreadable"]["files"] == ["3.jpg"]
    assert kinds["mixed types"]["files"] == ["4.png"]


def test_estimate_tells_and_registers(folder, tmp_path, calls, capsys):  # noqa: F811
    path = str(folder / "6.jpg")
    image = cv2.imread(path)
    cv2.imwrite(path, moved(image, 12, -7), [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert run(folder, "-o", tmp_path / "a") == 0
    out, err = capsys.readouterr()
    assert err.startswith(f"warning: {folder}: moved: 6.jpg 14 pixels")
    record = json.loads((tmp_path / "a/pot/normals.json").read_text())
    assert [f["kind"] for f in record["findings"]] == ["moved"]
    assert run(folder, "-o", tmp_path / "b", "--register") == 0
    out, err = capsys.readouterr()
    assert re.search(r"moved     back: 6.jpg \+1[12]\.\d -[67]\.\d pixels", out)
    assert err == ""
    record = json.loads((tmp_path / "b/pot/normals.json").read_text())
    np.testing.assert_allclose(record["moved_back"]["6.jpg"], [12, -7], atol=0.3)
    inside = calls[1]["mask"]
    before, after = (
        np.abs(c["images"][6].astype(float) - image[..., ::-1])[inside].mean()
        for c in calls
    )
    assert after < 0.2 * before


def test_finding_is_plain_data():
    images, mask = photographs(3, count=3)
    (finding,) = check(images, mask)
    assert json.loads(json.dumps(finding.record()))["kind"] == "few photographs"
    assert dataclasses.asdict(finding)["files"] == ()
