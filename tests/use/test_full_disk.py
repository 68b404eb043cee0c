"""Disks that are full: one line, exit status 2, and nothing half-written."""

import cv2
import numpy as np
import pytest
from plain_objects import hemisphere
from small_disk import small_disk

from unips_jax.cli.estimate import main as estimate
from unips_jax.cli.relight import main as relight
from unips_jax.cli.surface import main as surface

KILOBYTES = (8, 16, 24, 40, 64, 100)
SURFACE = {
    "depth": [],
    "ply": ["--mesh", "ply"],
    "obj": ["--mesh", "obj"],
    "glb": ["--mesh", "glb"],
}
RELIGHT = {
    "picture": [],
    "mp4": ["--turn", "mp4", "--frames", "12"],
    "gif": ["--turn", "gif", "--frames", "12"],
    "webp": ["--turn", "webp", "--frames", "12"],
}


@pytest.fixture
def normals(tmp_path):
    rng = np.random.default_rng(0)
    normals = hemisphere(64)[0]
    noisy = normals + 0.1 * rng.standard_normal(normals.shape) * (normals != 0)
    path = tmp_path / "normals.npy"
    np.save(path, noisy.astype(np.float32))
    return path


def check(command, arguments, disk, capsys):
    """Fills the disk: how often it was full."""
    full = 0
    for size in KILOBYTES:
        with small_disk(disk / f"{size}", size * 1024) as place:
            status = command([*arguments, "-o", str(place / "out")])
            error = capsys.readouterr().err
            if status == 0:
                continue
            full += 1
            assert status == 2 and error.count("error: ") == 1
            assert "out" in error and "cannot be written" in error
            assert error.splitlines()[-1].startswith("error: ")
            assert not [path for path in place.rglob("*") if path.is_file()]
    return full


@pytest.mark.parametrize("kind", SURFACE)
def test_surface(kind, normals, tmp_path, capsys):
    assert check(surface, [str(normals), *SURFACE[kind]], tmp_path, capsys) >= 2


@pytest.mark.parametrize("kind", RELIGHT)
def test_relight(kind, normals, tmp_path, capsys):
    assert check(relight, [str(normals), *RELIGHT[kind]], tmp_path, capsys) >= 2


@pytest.mark.usefixtures("calls")
@pytest.mark.parametrize(
    "options", [[], ["--exr"], ["--mat"], ["--lights", "--base-color", "--rti"]]
)
def test_estimate(options, tmp_path, capsys):
    folder = tmp_path / "thing"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(3):
        image = rng.integers(40, 200, (64, 64, 3), np.uint8)
        cv2.imwrite(str(folder / f"{index}.png"), image)
    arguments = [str(folder), "--mask", "none", *options]
    assert check(estimate, arguments, tmp_path, capsys) >= 2
