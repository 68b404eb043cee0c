"""The import rules of docs/architecture.md, held against the code."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "unips_jax"


def test_imports_point_downwards():
    command = "from importlinter.cli import lint_imports_command as run; run()"
    result = subprocess.run(
        [sys.executable, "-c", command, "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_the_root_is_small_and_its_names_are_its_own():
    modules = {path.stem for path in PACKAGE.glob("*.py")}
    rooms = {
        path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()
    }
    inner = {path.stem for room in rooms for path in (PACKAGE / room).rglob("*.py")}
    assert len(modules) <= 12
    shared = (modules & (rooms | inner)) - {"__init__"}
    assert not shared


@pytest.mark.parametrize(
    "room", sorted(p.parent.name for p in PACKAGE.glob("*/__init__.py"))
)
def test_every_room_is_on_the_map(room):
    assert f"`{room}/`" in (ROOT / "docs" / "architecture.md").read_text()
