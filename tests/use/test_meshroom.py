"""The Meshroom node, by Meshroom's documented interface: it is on no package index.

Descriptions are checked against the arguments and types that attributes of Meshroom
2026.1.0 take; computing is done by the command itself, called in this process.
"""

import contextlib
import importlib.util
import io
import json
import logging
import sys
import types
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import OpenEXR
import pytest
from small_networks import lively_network
from training_runs import write_objects

from unips_jax.cli.main import main
from unips_jax.io.images import write_image
from unips_jax.io.normals import read_normals
from unips_jax.io.selection import SUFFIXES
from unips_jax.weights import save_weights

PLUGIN = Path(__file__).resolve().parents[2] / "integrations" / "meshroom"
COMMON = set(
    "name label description value group advanced enabled invalidate semantic visible "
    "exposed".split()
)
ATTRIBUTES = {
    "File": (str, set()),
    "IntParam": (int, {"range", "validValue", "errorMessage"}),
    "StringParam": (str, {"uidIgnoreValue", "validValue", "errorMessage"}),
    "ChoiceParam": (
        str,
        {"values", "exclusive", "joinChar", "validValue", "errorMessage"},
    ),
}


def attribute(kind, type_, allowed):
    def describe(**given):
        assert {"name", "label", "description", "value"} <= set(given) <= allowed
        assert isinstance(given["value"], type_)
        assert all(isinstance(end, int) for end in given.get("range", ()))
        assert isinstance(given.get("values", []), list)
        return types.SimpleNamespace(kind=kind, **given)

    return describe


@pytest.fixture
def node(monkeypatch):
    desc = types.ModuleType("meshroom.core.desc")
    desc.Node = type("Node", (), {})
    desc.Level = types.SimpleNamespace(INTENSIVE=3, NORMAL=1, NONE=0)
    for kind, (type_, own) in ATTRIBUTES.items():
        setattr(desc, kind, attribute(kind, type_, COMMON | own))
    core = types.ModuleType("meshroom.core")
    core.desc = desc
    for name in ("meshroom", "meshroom.core", "meshroom.core.desc"):
        monkeypatch.setitem(sys.modules, name, core if name[-4:] == "core" else desc)
    path = PLUGIN / "meshroom" / "unips" / "UniPSNormals.py"
    spec = importlib.util.spec_from_file_location("UniPSNormals", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def call(command, **_):
        assert command[0] == "unips"
        with (
            contextlib.redirect_stderr(io.StringIO()) as errors,
            contextlib.redirect_stdout(io.StringIO()),
        ):
            status = main(command[1:])
        return types.SimpleNamespace(returncode=status, stderr=errors.getvalue())

    monkeypatch.setattr(module.subprocess, "run", call)
    return module


def compute(module, output, **values):
    """What Meshroom does: values of the attributes, then `processChunk`."""
    described = module.UniPSNormals()
    given = {a.name: a.value for a in described.inputs} | values
    assert set(given) == {a.name for a in described.inputs}
    attributes = {k: types.SimpleNamespace(value=v) for k, v in given.items()}
    attributes["output"] = types.SimpleNamespace(value=str(output))
    chunk = types.SimpleNamespace(
        node=types.SimpleNamespace(**attributes), logger=logging.getLogger("node")
    )
    described.processChunk(chunk)


@pytest.fixture
def poses(tmp_path):
    (tmp_path / "set").mkdir()
    write_objects(tmp_path / "set")
    save_weights(tmp_path / "small.safetensors", lively_network())
    return tmp_path


def test_descriptions_hold_what_choices_need(node):
    for attribute in node.UniPSNormals.inputs:
        if attribute.kind == "ChoiceParam":
            assert attribute.value in attribute.values
    assert "Meshroom 2026.1.0" in node.UniPSNormals.__doc__
    (output,) = node.UniPSNormals.outputs
    assert output.value == "{nodeCacheFolder}"


def test_poses_of_sfm_data_by_seed_format_and_convention(node, poses):
    views = [
        {"viewId": str(i), "poseId": str(pose), "path": str(path)}
        for pose in (0, 1)
        for i, path in enumerate((poses / "set" / f"object{pose}.data").glob("0*"))
    ]
    (poses / "in.sfm").write_text(json.dumps({"version": ["1"], "views": views}))
    masks = poses / "masks"
    masks.mkdir()
    mask = np.zeros((16, 16), np.uint8)
    mask[4:12, 4:12] = 255
    for pose in (0, 1):
        cv2.imwrite(str(masks / f"{pose}.png"), mask)
    given = {
        "input": str(poses / "in.sfm"),
        "maskFolder": str(masks),
        "weights": str(poses / "small.safetensors"),
        "maxImages": 2,
    }
    compute(node, poses / "a", **given, seed=1)
    compute(node, poses / "b", **given, seed=1, convention="opencv")
    compute(node, poses / "c", **given, seed=3, outputFormat="png")
    files = {p.name for p in (poses / "a").iterdir()}
    assert files == {
        "poses.json",
        *(f"{p}_normals.{s}" for p in (0, 1) for s in ("png", "exr", "json")),
    }
    assert not (poses / "c" / "0_normals.exr").exists()
    exr = OpenEXR.File(str(poses / "a" / "0_normals.exr")).channels()["RGB"].pixels
    turned = OpenEXR.File(str(poses / "b" / "0_normals.exr")).channels()["RGB"].pixels
    assert exr.shape == (16, 16, 3)
    np.testing.assert_array_equal(turned, exr * np.float32([1, -1, -1]))
    np.testing.assert_array_equal(np.linalg.norm(exr, axis=-1) > 0.5, mask > 0)
    png = read_normals(poses / "a" / "0_normals.png")
    np.testing.assert_allclose(png, exr, atol=2e-5)
    other = read_normals(poses / "c" / "0_normals.png")
    assert np.abs(other - png).max() > 1e-3  # drawn by another seed
    records = [
        json.loads((poses / run / "0_normals.json").read_text()) for run in ("a", "c")
    ]
    assert all(len(record["images"]) == 2 for record in records)


def test_a_folder_is_read_as_by_the_command(node, poses):
    root, rock = poses / "places", poses / "places" / "rock"
    rng = np.random.default_rng(0)
    for name in ("0.jpg", "0.tif", "1.jpg", "1.tif", "2.png"):
        write_image(rock / name, rng.integers(30, 220, (16, 16, 3), np.uint8))
    mask = np.zeros((16, 16), np.uint8)
    mask[4:12, 4:12] = 255
    write_image(rock / "Mask.png", mask)
    (rock / "._0.jpg").write_bytes(b"of macOS")
    write_image(root / ".thumbs" / "0.png", mask)
    (root / "phone").mkdir()
    (root / "phone" / "0.heic").write_bytes(b"no image")
    weights = ["--weights", str(poses / "small.safetensors")]
    given = {"input": str(root), "weights": weights[1], "failurePolicy": "skip"}
    compute(node, poses / "out", **given)
    assert main(["estimate", str(rock), "-o", str(poses / "own"), *weights]) == 0
    outcome = json.loads((poses / "out" / "poses.json").read_text())
    assert outcome.pop("rock") == "done" and list(outcome) == ["phone"]
    assert "phone/0.heic: expected " in outcome["phone"]
    found, expected = (
        json.loads((poses / file).read_text())
        for file in ("out/rock_normals.json", "own/rock/normals.json")
    )
    for fact in ("images", "mask_pixels", "folder"):
        assert found[fact] == expected[fact]
    assert len(found["images"]) == 3 and found["mask_pixels"] == 64
    assert node.IMAGES == SUFFIXES


def test_views_are_read_without_hidden_files_under_their_mask(node, poses):
    places = poses / "places"
    rng = np.random.default_rng(0)
    for name in ("0.png", "normal_1.png"):  # named by SfMData: no map
        write_image(places / name, rng.integers(30, 220, (16, 16, 3), np.uint8))
    mask = np.zeros((16, 16), np.uint8)
    mask[4:12, 4:12] = 255
    write_image(places / "Mask.png", mask)
    (places / "._0.png").write_bytes(b"of macOS")
    names = ("._0.png", "0.png", "normal_1.png")
    views = [{"poseId": "7", "path": str(Path("places", name))} for name in names]
    (poses / "in.sfm").write_text(json.dumps({"views": views}))
    weights = str(poses / "small.safetensors")
    compute(node, poses / "out", input=str(poses / "in.sfm"), weights=weights)
    record = json.loads((poses / "out" / "7_normals.json").read_text())
    assert list(record["images"]) == ["0000_0.png", "0001_normal_1.png"]
    assert record["mask_pixels"] == 64


def test_masks_of_the_mask_folder_by_any_name(node, tmp_path):
    photograph, masks = tmp_path / "scan[1].png", tmp_path / "masks"
    with pytest.raises(RuntimeError, match="Mask Folder: expected a folder, got"):
        node._mask("7", [photograph], str(masks))
    masks.mkdir()
    assert node._mask("7", [photograph, tmp_path / "b.png"], str(masks)) is None
    (masks / "scan[1].png").touch()
    found = node._mask("7", [photograph, tmp_path / "b.png"], str(masks))
    assert found == masks / "scan[1].png"
    for name in ("bust.1.png", "bust.txt", "bust.PNG"):
        (masks / name).touch()
    assert node._mask("bust", [photograph], str(masks)) == masks / "bust.PNG"
    assert node._mask("bust.1", [photograph], str(masks)) == masks / "bust.1.png"


def test_folders_of_one_pose_are_named(node, tmp_path):
    for name in ("rock", "rock.data"):
        write_image(tmp_path / name / "0.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(RuntimeError, match=r"pose rock, got rock and rock\.data; ren"):
        node.find_poses(tmp_path)


def test_failures_stop_or_are_skipped(node, poses):
    broken = poses / "set" / "object0.data"
    for path in broken.iterdir():
        path.write_bytes(b"no image")
    mask = np.zeros((16, 16), np.uint8)
    mask[4:12, 4:12] = 255
    for index in range(5):
        cv2.imwrite(str(poses / f"object{index}.png"), mask)
    given = {
        "input": str(poses / "set"),
        "maskFolder": str(poses),
        "weights": str(poses / "small.safetensors"),
        "outputFormat": "png",
    }
    with pytest.raises(
        RuntimeError, match="object0 gave no normals: .*set/object0.data/0"
    ):
        compute(node, poses / "stop", **given)
    assert list(json.loads((poses / "stop" / "poses.json").read_text())) == ["object0"]
    compute(node, poses / "skip", **given, failurePolicy="skip")
    outcome = json.loads((poses / "skip" / "poses.json").read_text())
    assert [outcome[f"object{i}"] == "done" for i in range(5)] == [False] + [True] * 4
    assert len(list((poses / "skip").glob("*_normals.png"))) == 4
    assert not list((poses / "skip").glob(".*"))


WINDOWS = {
    "unips": ["unips"],
    r"C:\unips\unips.exe": [r"C:\unips\unips.exe"],
    r'"C:\My tools\python.exe" -m x': [r"C:\My tools\python.exe", "-m", "x"],
}


@pytest.fixture
def addon(monkeypatch):
    """The Blender add-on's module, without Blender: it only calls the command."""
    properties = "BoolProperty EnumProperty FloatProperty IntProperty StringProperty"
    modules = {
        "bpy": {"types": mock.MagicMock(AddonPreferences=object, Operator=object)},
        "bpy.props": dict.fromkeys(properties.split(), dict),
        "mathutils": {"Vector": None},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(PLUGIN.with_name("blender"))
    yield importlib.import_module("unips_material")
    for name in ("unips_material", "unips_material.lights", "unips_material.relief"):
        del sys.modules[name]


def test_commands_are_split_as_the_system_writes_paths(
    node, addon, tmp_path, monkeypatch
):
    place = tmp_path / "my tools"
    place.write_text("")
    for module in (node, addon):
        assert module._words(str(place)) == [str(place)]
        assert module._words("'/my tools/x' -m y") == ["/my tools/x", "-m", "y"]
    monkeypatch.setattr(sys, "platform", "win32")
    for command, words in WINDOWS.items():
        assert node._words(command) == addon._words(command) == words


def test_names_in_files_and_messages_may_have_any_letters(
    node, addon, tmp_path, monkeypatch
):
    """As under Windows, where text is UTF-8 only if that is asked for."""
    monkeypatch.undo()  # the process is really started
    monkeypatch.setenv("PYTHONIOENCODING", "cp1252")
    monkeypatch.setattr(io, "text_encoding", lambda given, *_: given or "cp1252")
    script = tmp_path / "unips.py"
    script.write_text("import sys; sys.exit('error: Büste, 像')", "utf-8")
    command = f"{sys.executable} {script}"
    with pytest.raises(RuntimeError, match="Büste, 像"):
        node._run(node._words(command))
    with pytest.raises(addon.UnipsError, match="Büste, 像"):
        addon.estimate(tmp_path, command=command, weights="", max_images=0, seed=0)
    views = {"views": [{"poseId": 1, "path": "Büste.png"}], "photographs": "Büste"}
    file = tmp_path / "in.sfm"
    file.write_text(json.dumps(views, ensure_ascii=False), "utf-8")
    assert node.find_poses(file) == {"1": [tmp_path / "Büste.png"]}
    assert addon.lights.read_lights(file) == "Büste"


def test_a_command_that_is_not_there_is_named(node, poses, monkeypatch):
    monkeypatch.undo()  # the process is really started
    with pytest.raises(RuntimeError, match="/no/unips: expected the command"):
        node._run(["/no/unips", "estimate"])
    with pytest.raises(RuntimeError, match="expected an SfMData file"):
        node.find_poses(poses / "nothing")
