"""What ships of three.js is what the tool makes, with its licence."""

import json
import re
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
ASSETS = ROOT / "unips_jax" / "viewer" / "assets"
SOURCES = ROOT / "tools" / "viewer"


@pytest.fixture(scope="module")
def tool():
    return runpy.run_path(str(ROOT / "tools" / "bundle_viewer.py"))


def test_the_version_is_the_pinned_one():
    pinned = json.loads((SOURCES / "package.json").read_text())["devDependencies"]
    lock = json.loads((SOURCES / "package-lock.json").read_text())["packages"]
    three = lock["node_modules/three"]
    assert three["version"] == pinned["three"] and three["integrity"]
    assert f"three.js {pinned['three']}, MIT" in (ASSETS / "three.min.js").read_text()
    assert "MIT License" in (ASSETS / "three.LICENSE").read_text()
    for name, text in ((path.name, path.read_text()) for path in ASSETS.glob("*.js")):
        assert not re.search("</script|<!--", text, re.IGNORECASE), name


def test_the_light_of_the_environments(tool):
    """Against the integral over the sphere, for normals of all directions."""
    load, grid = tool["load_tables"], tool["directions_of"]
    towards, solid = grid(*tool["TABLE_SIZE"])
    tables = load()
    normals = np.eye(3)[[0, 1, 2]] * [[1], [-1], [1]]
    shipped = json.loads((ASSETS / "environments.json").read_text())
    assert shipped == tool["irradiance"]()
    for name, number in tool["ENVIRONMENTS"].items():
        cosine = np.maximum(normals @ towards.reshape(-1, 3).T, 0)  # [3, K]
        light = (tables.radiance[number, 0] * solid[..., None]).reshape(-1, 3)
        sun = np.maximum(normals @ tables.sun_directions[number], 0)[:, None]
        exact = cosine @ light + sun * tables.sun_colors[number]
        basis = tool["_basis"](normals)
        found = basis @ np.array(shipped[name])
        scale = exact.mean() / found.mean()
        # Nine harmonics hold irradiance to some 10% at a point.
        np.testing.assert_allclose(found * scale, exact, atol=0.2 * exact.max())


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="npm is not installed")
def test_bundling_anew_gives_the_same_bytes(tool):
    script, licence = tool["bundle"]()
    assert script == (ASSETS / "three.min.js").read_bytes()
    assert licence == (ASSETS / "three.LICENSE").read_bytes()
