"""Evaluations on a bad day: methods that fail, truths that are none, names alike."""

import csv

import cv2
import evaluation_data as data
import numpy as np
import pytest
from evaluation_folders import errors_of, run, tables_of

from unips_jax.cli import evaluate as evaluation
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files, open_benchmark
from unips_jax.evaluation.methods import UnipsOptions, load_variants

METHODS = """
import numpy as np
from unips_jax.baselines.method import Estimated, Unsupported

def flat(observed):
    return np.broadcast_to(np.float32([0, 0, 1]), (*observed.mask.shape, 3))

def failing():
    def run(observed):
        if observed.mask.shape[1] == 21:  # the shoe
            raise np.linalg.LinAlgError("Singular\\nmatrix")
        return flat(observed)
    return run

def silent():
    def run(observed):
        raise Unsupported
    return run

def boastful():
    return lambda observed: Estimated(flat(observed), {"mae_deg": 1.0})

def plain(tilt=0):
    return flat
"""


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Where methods of one's own are, and two folders `cup` and `shoe` with truth."""
    (tmp_path / "bad_day_methods.py").write_text(METHODS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return data.make_folder(tmp_path / "sets")


def test_a_method_that_fails_on_one_object_is_named_and_the_rest_is_there(
    folders, tmp_path, capsys
):
    work = tmp_path / "work"
    request = ["-m", "python:bad_day_methods:failing"]
    assert run(folders, work, *request) == 2
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0 and "1 of 4 results are missing" in error
    assert "'failing' failed on shoe: LinAlgError: Singular matrix (bad_day" in error
    rows = {row[0]: row[1:] for row in tables_of(work)["objects"]["rows"]}
    assert rows["shoe"][0] == "failed" and isinstance(rows["shoe"][1], float)
    remarks = tables_of(work)["remarks"]["rows"]
    assert any("failed: LinAlgError" in row[2] for row in remarks)
    assert run(folders, work, *request) == 2  # nothing of it was kept: tried again
    assert "'failing' failed on shoe" in capsys.readouterr().err


def test_a_method_that_gives_no_reason(folders, tmp_path):
    given = ["--benchmark", "folder", "--root", str(folders)]
    given += ["--workdir", str(tmp_path / "work")]
    assert evaluation.main([*given, "-m", "python:bad_day_methods:silent"]) == 0
    rows = tables_of(tmp_path / "work")["objects"]["rows"]
    assert [row[1] for row in rows[:2]] == ["unsupported"] * 2
    remarks = tables_of(tmp_path / "work")["remarks"]["rows"]
    assert any("the method gave no reason" in row[2] for row in remarks)


def test_figures_may_not_have_a_score_s_name(folders, tmp_path, capsys):
    request = ["-m", "python:bad_day_methods:boastful"]
    assert run(folders, tmp_path / "work", *request) == 2
    assert "of other names than the scores', got mae_deg" in capsys.readouterr().err
    text = (tmp_path / "work" / "tables" / "figures.csv").read_text()
    assert "boastful" not in text


def test_methods_of_one_name_can_be_named(folders):
    request = "python:bad_day_methods:plain"
    named = f"{request}:name=Mine,tilt=3"
    found = load_variants([request, named], UnipsOptions(()))
    assert [variant.label for variant in found] == ["plain", "Mine", "constant"]
    with pytest.raises(InputError, match="called 'constant'; .* add name="):
        load_variants([f"{request}:name=constant"], UnipsOptions(()))


def test_objects_of_one_name_in_two_sets_are_two(tmp_path):
    for place in ("mini", "real"):
        data.make_ps_wild(tmp_path / "root" / place, objects=1, images=2)
    lit = tmp_path / "root" / "real" / "directional" / "obj000.data"
    _, normals = data.sphere(24, 24, radius=9)  # another object
    data.write_image(lit / "normal.tif", data.encode16(normals))
    (lit / "mask.png").unlink()
    given = ["--benchmark", "ps-wild", "--root", str(tmp_path / "root"), "--workdir"]
    given += [str(tmp_path / "work"), "--no-pictures", "--protocol", "native"]
    assert evaluation.main([*given, "-m", "constant"]) == 0
    with (tmp_path / "work" / "tables" / "figures.csv").open() as file:
        rows = [r for r in csv.DictReader(file) if r["measure"] == "mae_deg"]
    assert len(rows) == 6
    assert {row["object"] for row in rows} == {"mini/obj000", "real/obj000"}
    assert tables_of(tmp_path / "work")["spread"]["rows"][0][-1] == 2
    chosen = open_benchmark("ps-wild", tmp_path / "root", objects=("mini/obj000",))
    assert len(chosen) == 3


def test_fifty_folders_of_other_names_are_given_no_materials(tmp_path):
    data.make_ps_wild_test(tmp_path)
    lit = tmp_path / "directional"
    for folder in list(lit.iterdir()):
        folder.rename(lit / f"pebble{folder.name}")
    entries = open_benchmark("ps-wild", tmp_path).entries
    assert all("material" not in entry.tags for entry in entries[:50])
    assert all("material" in entry.tags for entry in entries[50:])


@pytest.mark.parametrize("background", [0, 32768, 65535])
def test_where_the_truth_has_no_normal_is_left_out_of_a_mask(tmp_path, background):
    folder = data.make_folder(tmp_path) / "cup"
    inside, normals = data.sphere(20, 20)
    stored = data.encode16(normals, background=background)
    data.write_image(folder / "normal.png", stored)
    wide = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3))) > 0
    data.write_mask(folder / "mask.png", wide)
    item = open_benchmark("folder", tmp_path)[0]
    np.testing.assert_array_equal(item.mask, normals.any(-1) & wide)
    lost = (wide & ~normals.any(-1)).sum()
    assert f"{lost} masked pixels have no true normal: left out" in item.notes


def test_truth_with_y_down_is_remarked(tmp_path):
    for sign, said in ((1, False), (-1, True)):
        folder = data.make_folder(tmp_path / str(sign), size=40) / "cup"
        _, normals = data.sphere(40, 40)
        turned = data.encode16(normals * [1, sign, 1])
        data.write_image(folder / "normal.png", turned)
        notes = open_benchmark("folder", folder.parent)[0].notes
        assert any("y may point down" in note for note in notes) == said


def test_folders_whose_truth_has_another_name_are_named(tmp_path, capsys):
    root = data.make_folder(tmp_path / "sets")
    (root / "shoe" / "normal.png").rename(root / "shoe" / "normal_map.png")
    (root / "notes").mkdir()
    assert run(root, tmp_path / "work", "-m", "constant") == 0
    assert capsys.readouterr().err.startswith("warning: shoe: photographs, but no")
    assert run(root, tmp_path / "work", "-m", "constant", "--objects", "cup") == 0
    assert not capsys.readouterr().err


def test_floats_above_1_are_divided_in_ps_wild_too(tmp_path):
    """`woodham` clips at 1."""
    data.make_ps_wild(tmp_path / "root", objects=1, images=5, lightings=["directional"])
    folder = tmp_path / "root" / "directional" / "obj000.data"
    _, normals = data.sphere(24, 24, radius=24 * 0.3)
    for i, image in enumerate(data.shade(normals, data.lights(5, seed=0))):
        (folder / f"L_{i:02d}.png").unlink()
        assert cv2.imwrite(str(folder / f"L_{i:02d}.tif"), np.float32(8 * image))
    item = open_benchmark("ps-wild", tmp_path / "root")[0]
    assert item.images.max() == 1 and "photographs divided by" in item.notes[-1]
    given = ["--benchmark", "ps-wild", "--root", str(tmp_path / "root"), "--workdir"]
    given += [str(tmp_path / "work"), "--no-pictures", "--protocol", "native"]
    assert evaluation.main([*given, "-m", "woodham", "least-squares"]) == 0
    errors = errors_of(tmp_path / "work")
    assert errors["woodham"] < errors["least-squares"] + 1


def test_a_photograph_that_exif_turns_fits_as_for_estimate(tmp_path):
    from picture_files import png_with_orientation

    folder = tmp_path / "cup"
    inside, normals = data.sphere(20, 26)
    data.write_image(folder / "normal.png", data.encode16(normals))
    data.write_mask(folder / "mask.png", inside)
    for i, image in enumerate(data.shade(normals, data.lights(3))):
        if i == 1:
            image = np.rot90(image)  # as stored; orientation 6 turns it back
        data.write_image(folder / f"{i}.png", data.to16(image))
    path = folder / "1.png"
    path.write_bytes(png_with_orientation(path.read_bytes(), 6))
    item = open_benchmark("folder", tmp_path)[0]
    assert item.images.shape == (3, 20, 26, 3)


def test_every_damage_of_an_archive_names_the_file(tmp_path):
    path = tmp_path / "zgt.npz"
    rng = np.random.default_rng(0)
    np.savez_compressed(path, zgt=rng.normal(size=(20, 20)))
    whole = path.read_bytes()
    refused = 0
    for place in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[place] ^= 0x55
        path.write_bytes(damaged)
        try:
            files.read_npz(path, "zgt")
        except InputError as error:
            refused += 1
            assert str(path) in str(error)
    assert refused > 50
