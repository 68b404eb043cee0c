"""`unips relight`."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from plain_objects import hemisphere

from unips_jax import estimate_lights
from unips_jax.cli.relight import main
from unips_jax.io.color import as_linear
from unips_jax.io.door import NotWritten
from unips_jax.io.images import read_image
from unips_jax.lighting.light_files import write_lights
from unips_jax.pictures.animation import write_animation

NORMALS, MASK, _ = hemisphere(24)


@pytest.fixture
def result(tmp_path):
    folder = tmp_path / "thing"
    folder.mkdir()
    np.save(folder / "normals.npy", NORMALS)
    return folder


def test_command_writes_a_picture_and_a_turning_one(result, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [str(result), "-o", str(out), "--light", "1", "0", "0.5"]
    for kind in ("gif", "webp", "mp4"):
        assert main([*arguments, "--turn", kind, "--frames", "4"]) == 0
        image = cv2.imread(str(out / "relit.png"))
        assert image[12, 20].min() > 2 * image[12, 4].max()  # lit from the right
        record = json.loads((out / "relight.json").read_text())
        assert record["files"] == ["relit.exr", "relit.png", f"turning.{kind}"]
        frames = read_frames(out / f"turning.{kind}")
        assert len(frames) == 4
        # Counter-clockwise: right, up, left, down.
        for frame, (row, column) in zip(
            frames, ((12, 20), (3, 12), (12, 3), (20, 12)), strict=True
        ):
            assert frame[row, column].mean() > frame[23 - row, 23 - column].mean() + 40
    assert "grey, none given" in capsys.readouterr().out


def test_an_mp4_at_a_path_that_opencv_cannot_take(tmp_path):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    frames = [np.zeros((8, 8, 3), np.uint8)] * 2
    with pytest.raises(NotWritten, match="into a path in UTF-8 only; take gif or"):
        write_animation(folder / "turning.mp4", frames, fps=25)
    assert list(folder.iterdir()) == []


def read_frames(path):
    if path.suffix == ".mp4":
        video, frames = cv2.VideoCapture(str(path)), []
        while (read := video.read())[0]:
            frames.append(read[1])
        return frames
    from PIL import Image, ImageSequence

    with Image.open(path) as image:
        return [
            np.asarray(f.convert("RGB")).astype(int)
            for f in ImageSequence.Iterator(image)
        ]


def test_command_takes_an_environment_and_a_colour(result, tmp_path):
    around = np.zeros((16, 32, 3), np.float32)
    around[:, 24] = 5  # right
    cv2.imwrite(str(tmp_path / "around.hdr"), around)
    red = np.zeros((24, 24, 3), np.uint8)
    red[..., 2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), red)
    given = ["--environment", str(tmp_path / "around.hdr"), "--base-color"]
    out = ["-o", str(tmp_path / "out")]
    assert main([str(result), *out, *given, str(tmp_path / "red.png")]) == 0
    image = cv2.imread(str(tmp_path / "out" / "relit.png")).astype(int)
    assert image[12, 20, 2] > image[12, 4, 2] + 50
    assert image[12, 20, 2] > image[12, 20, 0] + 50
    # Turned by half a circle the light comes from the left.
    given = [*given[:2], "--yaw", "180"]
    assert main([str(result), *out, *given]) == 0
    image = cv2.imread(str(tmp_path / "out" / "relit.png")).astype(int)
    assert image[12, 4, 2] > image[12, 20, 2] + 50
    # What is behind comes to the left, counter-clockwise as seen from above.
    around[:], around[:, 16] = 0, 5
    cv2.imwrite(str(tmp_path / "around.hdr"), around)
    given, levels = [*given[:3], "90"], []
    for stops in ("0", "-1"):
        assert main([str(result), *out, *given, "--exposure", stops]) == 0
        linear = read_image(tmp_path / "out" / "relit.exr")
        picture = as_linear(read_image(tmp_path / "out" / "relit.png"), "srgb")
        np.testing.assert_allclose(picture, np.clip(linear, 0, 1), atol=0.006)
        assert linear[12, 4, 1] > 2 * linear[12, 20, 1]
        levels.append(linear)
    np.testing.assert_allclose(levels[1], levels[0] / 2, rtol=1e-4, atol=1e-6)


def test_command_takes_the_lights_of_photographs(result, tmp_path):
    """As the photographs of another object were lit, one picture for each."""
    directions = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8]])
    images = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, directions), 0)
    images = np.repeat(images[..., None], 3, -1).astype(np.float32)
    images[1] *= 0.5
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    lights = estimate_lights(images, NORMALS, MASK, guesses=directions)
    write_lights(earlier, ["a.png", "b.png"], lights)
    given = [str(result), "-o", str(tmp_path / "out"), "--roughness", "1"]
    for source, share in ((earlier, 0.5), (earlier / "lights.lp", 1)):
        assert main([*given, "--lights-from", str(source)]) == 0
        first, second = (
            as_linear(read_image(tmp_path / "out" / name), "srgb")[..., 0]
            for name in ("relit.png", "relit-01.png")
        )
        assert first[12, 19] > 2 * first[12, 4]
        np.testing.assert_allclose(
            second[:, ::-1][MASK], share * first[MASK], atol=0.05
        )
        record = json.loads((tmp_path / "out" / "relight.json").read_text())
        assert record["files"] == ["relit-01.png", "relit.exr", "relit.png"]
        assert record["lights_from"] == str(source) and record["light"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--light", "0", "0", "0"], "--light: expected a direction, not 0"),
        (["--lights-from", "thing"], "expected a result with lights.json"),
        (
            ["--light", "1", "0", "1", "--lights-from", "thing"],
            "--light: expected one kind of light, got --lights-from too",
        ),
        (["--lights-from", "thing", "--turn", "gif"], "--turn: expected a light that"),
        (["--roughness", "2"], "--roughness: expected 0.03 to 1.0, got 2.0"),
        (["--environment", "absent.hdr"], "absent.hdr: "),
        (["--base-color", "small.png"], "expected the normals' size, 24 x 24"),
        (["--yaw", "90"], "--yaw: expected something to use it for, got none"),
        (["--fps", "12"], "--fps: expected something to use it for, got none; add --t"),
        (["--lights-from", "empty.lp"], "empty.lp: expected lights, one a line"),
        (["--lights-from", "zero.lp"], "zero.lp: expected lights, one a line"),
    ],
)
def test_bad_options_are_one_line(options, message, result, capsys, monkeypatch):
    monkeypatch.chdir(result.parent)
    cv2.imwrite("small.png", np.full((4, 5), 255, np.uint8))
    Path("empty.lp").write_text("")
    Path("zero.lp").write_text("0\n")
    assert main(["thing", "-o", "out", *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (result.parent / "out").exists()
