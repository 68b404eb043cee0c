import json
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import jax
import numpy as np
import pytest

from unips_jax.cli import render
from unips_jax.errors import InputError
from unips_jax.io.claims import claim
from unips_jax.io.ps_wild import focal_facts, write_folder
from unips_jax.provenance import _reached
from unips_jax.scenes import SHAPE_KINDS, Scene, folders
from unips_jax.surface.depth_files import read_depth


@pytest.fixture
def scene():
    mask = np.zeros((8, 12), bool)
    mask[2:6, 3:10] = True
    normals = np.where(mask[..., None], [0.6, 0.0, 0.8], 0.0).astype(np.float32)
    ramp = np.linspace(0, 1, 2 * 8 * 12 * 3, dtype=np.float32)
    return Scene(
        images=ramp.reshape(2, 8, 12, 3),
        mask=mask,
        normals=normals,
        light_kind=np.int32(0),
        shape_kind=np.int32(1),
        material=np.int32(2),
        focal=np.float32(0),
        light_directions=np.tile(np.float32([0, 0, 1]), (2, 1)),
        light_means=np.tile(np.float32([0, 0, 1]), (2, 1)),
        light_intensities=np.ones((2, 3), np.float32),
        base_color=np.full((8, 12, 3), 0.5, np.float32),
        roughness=np.full((8, 12), 0.5, np.float32),
        metallic=np.zeros((8, 12), np.float32),
    )


def write(folder, scene, facts):
    write_folder(folder, scene.images, scene.mask, scene.normals, facts)


def _read(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_a_folder_holds_what_was_drawn(tmp_path, scene):
    folder = tmp_path / "directional" / "obj000.data"
    write(folder, scene, {"seed": 3, **folders.describe(scene)})
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["L_00.png", "L_01.png", "mask.png", "meta.json", "normal.tif"]
    image = _read(folder / "L_01.png")[..., ::-1]
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image / 65535, scene.images[1], atol=1e-5)
    np.testing.assert_array_equal(_read(folder / "mask.png") > 0, scene.mask)
    coded = _read(folder / "normal.tif")[..., ::-1].astype(np.float64)
    normals = 2 * coded / 65535 - 1
    np.testing.assert_allclose(
        normals[scene.mask], scene.normals[scene.mask], atol=2e-5
    )
    assert np.all(coded[~scene.mask] == 32768)
    np.testing.assert_array_equal(
        np.abs(1 - np.linalg.norm(normals, axis=-1)) < 1e-3, scene.mask
    )
    facts = json.loads((folder / "meta.json").read_text())
    assert facts["seed"] == 3 and facts["material"] == "wood"
    assert facts["light"] == "directional" and facts["focal_mm"] is None
    assert facts["light_directions"] == [[0, 0, 1]] * 2
    assert [path.name for path in folder.parent.iterdir()] == ["obj000.data"]


def test_light_beyond_white_is_white_and_depth_ends_with_the_object(tmp_path, scene):
    images = [np.full((8, 12, 3), [-0.5, 0.5, 1.5])] * 2
    depth = np.full((8, 12), 7, np.float32)
    write_folder(tmp_path / "a", images, scene.mask, scene.normals, {}, depth=depth)
    image = _read(tmp_path / "a" / "L_00.png")[..., ::-1]
    np.testing.assert_array_equal(image[0, 0], [0, 32768, 65535])
    found = read_depth(tmp_path / "a" / "depth.exr")
    assert not scene.mask.all()
    np.testing.assert_array_equal(found, np.where(scene.mask, 7, 0))


def test_focal_lengths_are_for_a_frame_that_is_cropped(scene):
    """So that nobody takes the optical axis to be in the picture's middle."""
    facts = folders.describe(scene._replace(focal=np.float32(18)))
    assert facts["focal_mm"] == 18 and "focal" not in facts
    assert focal_facts(18, 12) == {"focal_mm": 18, "focal": 6}  # of 12 pixels' width


def test_a_folder_written_again_has_no_photographs_of_the_earlier(tmp_path):
    """What is the user's stays."""
    mask, normals = np.ones((8, 8), bool), np.zeros((8, 8, 3), np.float32)
    folder = tmp_path / "a.data"
    maps = {"roughness": np.full((8, 8), 0.5)}
    write_folder(folder, np.ones((5, 8, 8, 3)), mask, normals, {}, maps=maps)
    (folder / "lights.txt").write_text("mine")
    name, depth = "0_{:02d}.png", np.ones((8, 8))
    three = np.ones((3, 8, 8, 3))
    write_folder(folder, three, mask, normals, {}, name=name, depth=depth)
    write_folder(folder, np.ones((2, 8, 8, 3)), mask, normals, {})
    names = sorted(path.name for path in folder.iterdir())
    assert names == (
        ["L_00.png", "L_01.png", "lights.txt", "mask.png", "meta.json", "normal.tif"]
    )


def test_facts_may_be_arrays(tmp_path):
    mask, normals = np.ones((8, 8), bool), np.zeros((8, 8, 3), np.float32)
    facts = {"size": np.int64(8), "light_directions": np.eye(3, dtype=np.float32)}
    write_folder(tmp_path / "a.data", np.ones((3, 8, 8, 3)), mask, normals, facts)
    meta = json.loads((tmp_path / "a.data" / "meta.json").read_text())
    assert meta["size"] == 8 and meta["light_directions"] == np.eye(3).tolist()
    with pytest.raises(TypeError, match="facts: expected values that JSON holds"):
        write_folder(tmp_path / "b.data", (), mask, normals, {"a": object()})
    assert not (tmp_path / "b.data").exists()


def test_photographs_of_ones_own_are_not_replaced(tmp_path):
    mask, normals = np.ones((8, 8), bool), np.zeros((8, 8, 3), np.float32)
    folder = tmp_path / "cup.data"
    folder.mkdir()
    for name in ("L_001.png", "light_setup.png"):
        (folder / name).write_bytes(b"mine")
    with pytest.raises(InputError, match=r"such as L_001\.png; choose another"):
        write_folder(folder, np.ones((2, 8, 8, 3)), mask, normals, {})
    assert sorted(path.name for path in folder.iterdir()) == (
        ["L_001.png", "light_setup.png"]
    )
    (folder / "meta.json").write_text('{"camera": "mine"}')
    with pytest.raises(InputError, match="choose another"):
        write_folder(folder, np.ones((2, 8, 8, 3)), mask, normals, {})
    # Nor are they where an earlier version wrote, but for names that its own have.
    (folder / "L_001.png").unlink()
    (folder / "meta.json").write_text('{"light": "mixed"}')
    write_folder(folder, np.ones((2, 8, 8, 3)), mask, normals, {})
    assert (folder / "light_setup.png").read_bytes() == b"mine"


def test_a_failure_leaves_nothing_behind(tmp_path, scene):
    with pytest.raises(TypeError):
        write(tmp_path / "obj000.data", scene, {"seed": object()})
    assert list(tmp_path.iterdir()) == []


def test_the_sheet_has_a_tile_per_scene(scene):
    many = jax.tree.map(lambda leaf: np.stack([leaf] * 4), scene)
    many = many._replace(images=np.stack([scene.images[[0, 1, 1]]] * 4))
    sheet = folders.contact_sheet(many, columns=2)
    assert sheet.shape == (2 * (16 + 4), 2 * (24 + 4), 3) and sheet.dtype == np.uint8


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "expected -o DIR"),
        (["-o", "x", "--size", "30"], "multiple of 4, got 30"),
        (["-o", "x", "--objects", "0"], "--objects: expected at least 1"),
        (["--sheet", "x.txt"], "--sheet: expected a file ending"),
        (["--sheet", "folder.png"], "--sheet: expected a file's name"),
        (["--sheet", "file/x.png"], "--sheet file: cannot be a folder"),
        (["-o", "file"], "-o file: cannot be a folder"),
    ],
)
def test_bad_arguments_are_named(monkeypatch, tmp_path, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.png").mkdir()
    assert render.main(arguments) == 2
    assert message in capsys.readouterr().err


def test_engines_are_not_abbreviated(tmp_path, capsys):
    assert render.main(["--eng", "cycles", "-o", str(tmp_path)]) == 2
    assert "no option --eng: perhaps --engine;" in capsys.readouterr().err


def _stand_in(monkeypatch, scene):
    """Renders the scene, always the same."""
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene)
    monkeypatch.setattr(folders, "render_batch", lambda *_, **__: batch)


def test_trees_are_kept_unless_of_other_code(monkeypatch, tmp_path, capsys, scene):
    _stand_in(monkeypatch, scene)
    arguments = ["-o", str(tmp_path), "--objects", "1", "--images", "2"]
    totals = []
    monkeypatch.setattr(
        folders, "track", lambda items, _, *, total: totals.append(total) or items
    )
    assert render.main(arguments) == 0 and render.main(arguments) == 0
    assert totals == [3, 0]  # what is there does not count as progress
    monkeypatch.setattr(folders, "code_hash", lambda *_: "other")
    assert render.main(arguments) == 2
    assert "expected scenes of this version" in capsys.readouterr().err
    (tmp_path / "directional" / "obj000.data" / "meta.json").unlink()
    assert render.main(arguments) == 2
    assert "obj000.data: expected a folder of" in capsys.readouterr().err


def test_shapes_come_in_turn(monkeypatch, tmp_path, scene, capsys):
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], scene)
    drawn = []
    monkeypatch.setattr(
        folders, "render_batch", lambda *_, shape, **__: drawn.append(shape) or batch
    )
    arguments = ["-o", str(tmp_path), "--objects", "3", "--images", "2"]
    assert render.main([*arguments, "--shapes", "relief", "plate"]) == 0
    kinds = [SHAPE_KINDS[kind] for kind in drawn[::3]]
    assert kinds == ["relief", "plate", "relief"] and len(drawn) == 9
    assert render.main([*arguments, "--shapes", "relief"]) == 2
    assert "'shapes': ['relief', 'plate']" in capsys.readouterr().err


def test_rows_of_the_sheet_take_shapes_in_turn(monkeypatch, tmp_path, scene):
    row = jax.tree.map(lambda leaf: np.stack([leaf] * 8), scene)
    row = row._replace(images=row.images[:, [0, 1, 1]])
    drawn = []
    monkeypatch.setattr(
        folders,
        "render_batch",
        lambda *_, shape=None, **__: drawn.append(shape) or row,
    )
    arguments = ["--sheet", str(tmp_path / "sheet.png")]
    assert render.main(arguments) == 0 and drawn == [None] * 8
    assert render.main([*arguments, "--shapes", "relief", "plate"]) == 0
    assert [SHAPE_KINDS[kind] for kind in drawn[8:]] == ["relief", "plate"] * 4


def test_several_processes_share_a_tree(monkeypatch, tmp_path, scene):
    _stand_in(monkeypatch, scene)
    leftover = tmp_path / "mixed" / ".unips-killed"
    leftover.mkdir(parents=True)
    leftover.with_suffix(".lock").touch()
    (tmp_path / ".locks").mkdir()
    arguments = ["-o", str(tmp_path), "--objects", "2", "--images", "2"]
    with ThreadPoolExecutor() as pool:
        with claim(tmp_path / ".locks" / "directional-000"):
            others = [pool.submit(render.main, arguments) for _ in range(2)]
            while len(list(tmp_path.glob("*/*.data"))) < 5:
                time.sleep(0.01)
            assert not any(status.done() for status in others)
        assert [status.result(timeout=60) for status in others] == [0, 0]
    assert len(list(tmp_path.glob("*/*.data"))) == 6 and not leftover.exists()


@pytest.mark.slow
def test_trees_are_reproducible_and_kept(tmp_path, capsys):
    arguments = ["--objects", "2", "--images", "2", "--size", "32", "--seed", "4"]
    assert render.main(["-o", str(tmp_path / "a"), *arguments]) == 0
    assert render.main(["-o", str(tmp_path / "b"), *arguments]) == 0
    first = sorted((tmp_path / "a").glob("*/*/*"))
    assert len(first) == 2 * 3 * 5
    for path in first:
        twin = tmp_path / "b" / path.relative_to(tmp_path / "a")
        assert path.read_bytes() == twin.read_bytes()
    masks = {
        (tmp_path / "a" / name / "obj000.data" / "mask.png").read_bytes()
        for name in folders.LIGHTINGS
    }
    assert len(masks) == 1
    stamp = first[0].stat().st_mtime_ns
    assert render.main(["-o", str(tmp_path / "a"), *arguments]) == 0
    assert first[0].stat().st_mtime_ns == stamp
    assert render.main(["-o", str(tmp_path / "a"), *arguments[:-1], "5"]) == 2
    message = capsys.readouterr().err
    assert "expected a folder of {'seed': 5, 'size': 32, 'images': 2}" in message


def test_trees_know_the_renderer_they_are_of():
    reached = _reached(f"unips_jax.{name}" for name in folders._CODE)
    assert {"unips_jax.scenes.shading", "unips_jax.scenes.draws"} <= set(reached)


def test_seeds_have_32_bits(tmp_path, capsys):
    arguments = ["-o", str(tmp_path / "o"), "--objects", "1", "--seed", str(2**32)]
    assert render.main(arguments) == 2
    assert "--seed: expected less than 2^32, got 4294967296" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
