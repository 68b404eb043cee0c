"""The import rules of docs/architecture.md, held against the code."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "unips_jax"


def test_imports_point_downwards():
    pytest.importorskip("importlinter", reason="import-linter is not installed")
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


# What writes past the door of `io/door.py`, by file: how often, and why that is right.
# `cycles/blender` runs inside Blender, which sees nothing of ours.
DIRECT = {
    "app/objects.py": (2, "links, in a folder that appears at once; a lock"),
    "app/work.py": (1, "moves frames from another disk, within `writing`"),
    "cycles/blender_process.py": (1, "Blender's own messages, in a temporary folder"),
    "io/door.py": (4, "the door"),
    "io/results.py": (6, "folders that appear at once: linked, renamed, set aside"),
    "pictures/animation.py": (1, "under the name that `new_path` gives"),
    "training/checkpoints.py": (1, "orbax writes `N.partial`; its errors are named"),
}
# Functions and methods that write the file that they are given, or change its name.
_OF_PATHS = "write_text write_bytes rename symlink_to hardlink_to touch".split()
_OF_TARGETS = (
    "tofile savez savez_compressed savetxt savemat imwrite imsave VideoWriter "
    "save_file savefig to_csv ZipFile TarFile save export save_checkpointables "
    "save_checkpointables_async".split()
)
_OF_MODULES = {
    "os": "rename renames replace link symlink".split(),
    "shutil": "copy copy2 copyfile copytree move".split(),
    "json": ["dump"],
    "pickle": ["dump"],
}


def _is_direct(call):
    """Whether a call writes files otherwise than through the door."""
    function = call.func
    if not isinstance(function, ast.Name | ast.Attribute):
        return False
    name = function.id if isinstance(function, ast.Name) else function.attr
    owner = getattr(function, "value", None)
    module = getattr(owner, "id", getattr(owner, "attr", ""))
    if name == "open":
        values = [*call.args, *(k.value for k in call.keywords)]
        modes = [str(v.value) for v in values if isinstance(v, ast.Constant)]
        return any(len(mode) <= 3 and set(mode) & set("wax+") for mode in modes)
    if owner is None:  # of ours, or from a module that writes into memory
        return name == "patiently"  # which is given what renames
    first = getattr(call.args[0], "id", "other") if call.args else None
    if name in _OF_PATHS or name in _OF_MODULES.get(module, ()):
        return True
    if name == "replace":  # a path's: texts and records take more
        return len(call.args) == 1 and not call.keywords and module != "dataclasses"
    if name == "write":  # an open file was counted where it was opened
        return isinstance(owner, ast.Call) and first != "data"
    in_memory = first in (None, "data", "buffer") or module in ("checkpoints", "export")
    return name in _OF_TARGETS and not in_memory


def _uses_door(node):
    """Whether it is a `with` that opens the file by the door."""
    return isinstance(node, ast.With) and any(
        getattr(getattr(item.context_expr, "func", None), "id", "") == "new_file"
        for item in node.items
    )


def _direct_writers(node):
    """The lines of calls that write past the door."""
    if _uses_door(node):
        return []
    own = [node.lineno] if isinstance(node, ast.Call) and _is_direct(node) else []
    children = ast.iter_child_nodes(node)
    return own + [line for child in children for line in _direct_writers(child)]


def test_files_are_written_through_one_door():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        lines = _direct_writers(ast.parse(path.read_text("utf-8")))
        if lines and not name.startswith("cycles/blender/"):
            found[name] = lines
    expected = {name: count for name, (count, _) in DIRECT.items()}
    changed = {
        name: found.get(name, [])
        for name in found.keys() | expected.keys()
        if len(found.get(name, [])) != expected.get(name, 0)
    }
    assert not changed, f"write through `io/door.py` (file: lines): {changed}"


@pytest.mark.parametrize(
    "line",
    [
        "open(path, 'w')",
        "open(path, mode='ab')",
        "path.open('wb')",
        "path.write_text(text)",
        "path.write_bytes(data)",
        "part.replace(path)",
        "patiently(part.rename, path)",
        "np.save(path, normals)",
        "np.savez(path, **arrays)",
        "cv2.imwrite(str(path), picture)",
        "Image.fromarray(picture).save(path)",
        "OpenEXR.File(header, pixels).write(str(path))",
        "scipy.io.savemat(path, content)",
        "shutil.copy(first, second)",
        "json.dump(record, file)",
        "mesh.export(path)",
        "zipfile.ZipFile(path, 'w')",
    ],
)
def test_new_writers_would_be_seen(line):
    assert _direct_writers(ast.parse(line)) == [1]
    assert not _direct_writers(ast.parse(f"with new_file(path) as file:\n    {line}"))
