"""What a release states: version, licences of what ships, citation."""

import re
import tomllib
from pathlib import Path

import unips_jax
from unips_jax import errors

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT / "unips_jax" / "assets"
VIEWER = ROOT / "unips_jax" / "viewer" / "assets" / "LICENSES.md"


def test_version_is_the_same_everywhere():
    changelog = (ROOT / "CHANGELOG.md").read_text()
    versions = re.findall(r"^## (\d\S*) - \d{4}-\d\d-\d\d$", changelog, re.MULTILINE)
    citation = (ROOT / "CITATION.cff").read_text()
    assert versions[0] == unips_jax.__version__
    assert f"\nversion: {unips_jax.__version__}\n" in citation
    integrations = ROOT / "integrations"
    for name in (
        "blender/unips_material/blender_manifest.toml",
        "meshroom/pyproject.toml",
    ):
        text = (integrations / name).read_text()
        assert re.search(r'^version = "(.*)"$', text, re.M)[1] == versions[0], name
    add_on = (integrations / "blender/unips_material/__init__.py").read_text()
    numbers = re.search(r'"version": \((.*)\)', add_on)[1].split(", ")
    assert ".".join(numbers) == versions[0]
    released = re.search(rf"^## {re.escape(versions[0])} - (\S+)$", changelog, re.M)
    assert f'\ndate-released: "{released[1]}"\n' in citation


def test_every_asset_has_a_licence_that_the_package_names():
    rows = re.findall(
        r"^\| `([^`]+)` \|.*\| (\S+) \|$", (ASSETS / "LICENSES.md").read_text(), re.M
    )
    licences = {name.rstrip("/"): licence for name, licence in rows}
    assert set(licences) == {p.name for p in ASSETS.iterdir()} - {"LICENSES.md"}
    assert set(re.findall(r"Apache-2.0|MIT|CC0-1.0", VIEWER.read_text())) == {
        "Apache-2.0",
        "CC0-1.0",
        "MIT",
    }
    licences["viewer"] = "MIT"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(project["license"].split(" AND ")) == set(licences.values())


def test_every_weights_file_has_a_model_card():
    cards = (ROOT / "docs" / "models.md").read_text()
    for file in ASSETS.glob("*.safetensors"):
        assert f"\n## {file.name}\n" in cards


def test_install_hints_name_the_packages_of_the_extras():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extra, packages in project["optional-dependencies"].items():
        if extra in errors._EXTRAS:
            hint = errors.install_hint(extra).removeprefix("pip install ").split()
            names = {re.match(r"[\w-]+", package)[0] for package in packages}
            assert set(hint) == names, extra
