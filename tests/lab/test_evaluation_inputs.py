"""What other programs are given, and the example as a function and a program."""

import runpy
import sys
from pathlib import Path

import cv2
import evaluation_data as data
import numpy as np
import pytest
from evaluation_folders import errors_of, tables_of

from unips_jax.baselines.method import Observed, Unsupported
from unips_jax.cli import evaluate as evaluation
from unips_jax.evaluation import publish

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def test_inputs_are_what_methods_are_given_and_lead_back(tmp_path):
    """What another program would do: photographs in, normals of the crop out."""
    root = data.make_ps_wild(tmp_path / "data", lightings=("directional",))
    named = ["--benchmark", "ps-wild", "--root", str(root), "--no-pictures"]
    subsets = ["--crop-size", "16", "--num-images", "2", "all", "--seeds", "0", "1"]
    command = [*named, *subsets, "--workdir", str(tmp_path / "work")]
    assert evaluation.main([*command, "--write-inputs", "-m", "constant"]) == 0
    inputs = tmp_path / "work" / "inputs"
    names = sorted(path.name for path in inputs.iterdir())
    assert names == ["2-seed-0", "2-seed-1", "all"]
    for folder in inputs.glob("*/*.data"):
        photographs = sorted(folder.glob("L_*.png"))
        assert len(photographs) == (4 if folder.parent.name == "all" else 2)
        image = cv2.imread(str(photographs[0]), cv2.IMREAD_UNCHANGED)
        assert image.shape == (16, 16, 3) and image.dtype == np.uint16
        assert np.loadtxt(folder / "light_directions.txt").shape[1] == 3
        mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_UNCHANGED) > 0
        flat = np.where(mask[..., None], np.float32([0, 0, 1]), 0)
        made = tmp_path / "made" / folder.parent.name
        made.mkdir(parents=True, exist_ok=True)
        np.save(made / f"{folder.stem}.npy", flat)
    assert evaluation.main([*command, "-m", f"files:{tmp_path / 'made'}"]) == 0
    rows = tables_of(tmp_path / "work")["spread"]["rows"]
    by_method = {(row[0], row[1]): row[2] for row in rows}
    for images in (2, "all"):
        same = by_method["constant", images]
        assert by_method["made", images] == pytest.approx(same, abs=1e-6)


@pytest.mark.parametrize("scale", [1.0, 1e-5])
def test_inputs_of_float_photographs_have_all_levels(tmp_path, scale):
    """Whatever their unit is, and whatever burns beside the object."""
    images = scale * np.linspace(0.1, 0.8, 2 * 400 * 3).reshape(2, 20, 20, 3)
    images[:, 0, 0] = 5000
    mask = np.ones((20, 20), bool)
    mask[0, 0] = False
    seen = Observed(images.astype(np.float32), mask)
    publish._write_observed(tmp_path, seen, None)
    stored = cv2.imread(str(tmp_path / "L_002.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    expected = images[1] / images[:, mask].max() * 65535
    np.testing.assert_allclose(stored[mask], expected[mask], atol=0.6)


def test_the_example_is_the_same_as_a_function_and_as_a_program(tmp_path, monkeypatch):
    root = data.make_diligent(tmp_path / "data", images=6, objects=("ball", "cow"))
    monkeypatch.chdir(EXAMPLES.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    work, made = tmp_path / "work", tmp_path / "made"
    named = ["--benchmark", "diligent", "--root", str(root), "--no-pictures"]
    command = [*named, "--objects", "ball", "cow", "--workdir", str(work)]
    assert evaluation.main([*command, "--write-inputs", "-m", "constant"]) == 0
    script = runpy.run_path(str(EXAMPLES / "by_example.py"))
    script["main"](work / "inputs", made)
    function = "python:examples.by_example:by_example:neighbours=5"
    assert evaluation.main([*command, "-m", f"files:{made}", function]) == 0
    found = errors_of(work)
    assert found["made"] < 3 < 30 < found["constant"]
    # The program's photographs were rounded to 16 bits.
    assert found["by_example:neighbours=5"] == pytest.approx(found["made"], abs=0.05)
    # Without lights there is nothing to compare with, and that is no crash.
    with pytest.raises(Unsupported, match="needs the lights"):
        script["by_example"]()(Observed(np.ones((1, 2, 2, 3)), np.ones((2, 2), bool)))
    for name in work.glob("inputs/*.data/light_directions.txt"):
        name.unlink()
    script["main"](work / "inputs", tmp_path / "none")
    assert not (tmp_path / "none").exists()
