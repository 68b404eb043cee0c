"""tools/real_sets.py: the photographs and masks by which weights are chosen."""

import importlib
import json
from pathlib import Path

import evaluation_data as data
import numpy as np
import pytest

from unips_jax.errors import InputError

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture(scope="module")
def real_sets():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOLS)
        yield importlib.import_module("real_sets")


@pytest.fixture(scope="module")
def spheres(real_sets):
    return real_sets.spheres


def truth(case):
    return case.normals * case.mask[..., None]


def test_wrong_masks_are_wrong_by_euclidean_pixels(real_sets):
    y, x = np.mgrid[:40, :40] - 19.5
    distance = np.hypot(x, y)
    mask = distance < 12
    np.testing.assert_array_equal(real_sets.wrong_mask(mask, 0), mask)
    for offset in (-3, -1, 1, 2, 5):
        found = real_sets.wrong_mask(mask, offset)
        assert abs(np.sqrt(found.sum() / np.pi) - 12 - offset) < 0.4
        assert found[distance < 11 + offset].all()
        assert not found[distance > 13 + offset].any()


def test_a_mask_that_fills_the_frame_has_no_border(real_sets):
    mask = np.ones((8, 8), bool)
    np.testing.assert_array_equal(real_sets.wrong_mask(mask, -2), mask)


def test_spheres_are_lit_as_they_say(spheres):
    """Least squares with their lamps finds the normals of a matt one."""
    images = spheres.photograph_sphere(spheres.LOOKS["matt, black wall"])
    normals = spheres.sphere_normals()
    inner = (spheres.depth_inside() > 3) & (images.min((0, 3)) > 0.02)
    assert inner.sum() > 3000
    lamps = spheres.lamps(10)
    found = np.linalg.pinv(lamps) @ images[:, inner].mean(-1)
    found = found / np.linalg.norm(found, axis=0)
    cosine = np.sum(found.T * normals[inner], -1)
    assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() < 1.5
    assert normals[20, 80, 1] > 0.9 and normals[80, 138, 0] > 0.9


def test_spheres_mix_with_the_wall(spheres):
    depth = spheres.depth_inside()
    images = spheres.photograph_sphere(spheres.LOOKS["matt, bright wall"])[0]
    wall = images[depth < -1]
    np.testing.assert_allclose(wall, wall[0, 0], rtol=1e-4)
    border = images[abs(depth) < 0.3]
    assert border.mean() < 0.75 * wall.mean()
    assert border.mean() > 1.5 * images[(depth > 0.8) & (depth < 1.2)].mean()


def test_masks_of_spheres_grow_and_the_same_pixels_count(real_sets, spheres):
    cases = list(real_sets.sphere_cases((-2, 0, 5)))
    assert len(cases) == 3 * len(spheres.LOOKS)
    small, exact, large = cases[:3]
    assert small.mask.sum() < exact.mask.sum() < large.mask.sum()
    assert np.all(small.mask | ~small.scored)
    np.testing.assert_array_equal(small.scored, large.scored)
    assert real_sets.score(small, truth(small)) < 1e-2


def test_diligent_may_lack_objects_and_has_wrong_masks(real_sets, tmp_path):
    data.make_diligent(tmp_path, images=5, objects=("ball", "cow"), size=(32, 40))
    cases = list(real_sets.diligent_cases(tmp_path, (3, None), (-1, 2)))
    by_group = {}
    for case in cases:
        by_group.setdefault(case.group, []).append(case)
    assert {g: [c.name for c in cs] for g, cs in by_group.items()} == dict.fromkeys(
        (
            "diligent, 3 images",
            "diligent, all",
            "diligent, mask -1 px",
            "diligent, mask +2 px",
        ),
        ["ball", "cow"],
    )
    few, many = (by_group[f"diligent, {n}"][0] for n in ("3 images", "all"))
    assert len(few.images) == 3 and len(many.images) == 5
    wrong = by_group["diligent, mask +2 px"][0]
    assert wrong.mask.sum() > few.mask.sum() > wrong.scored.sum() > 0


def test_known_lamps_give_the_normals_of_a_matt_object(real_sets, tmp_path):
    mask, normals = data.sphere(24, 28)
    lamps = data.lights(6, seed=2)
    folder = tmp_path / "thing.data"
    for i, image in enumerate(data.shade(normals, lamps)):
        data.write_image(folder / f"Image_{i}.png", data.to16(image))
    data.write_mask(folder / "mask.png", mask)
    data.write_table(folder / "light_directions.txt", lamps.T)
    (case,) = real_sets.lamp_cases(folder)
    lit = mask & np.all(np.einsum("hwc,nc->nhw", normals, lamps) > 0, axis=0)
    case = case._replace(scored=lit)
    assert case.name == "thing" and lit.sum() > 100
    assert real_sets.score(case, normals) < 0.1
    (folder / "light_directions.txt").unlink()
    with pytest.raises(InputError, match=r"light_directions\*\.txt, found none"):
        list(real_sets.lamp_cases(folder))


def test_the_command_has_means_objects_and_the_constant(
    real_sets, tmp_path, capsys, monkeypatch
):
    tilt = np.float32([0, np.sin(0.1), np.cos(0.1)])
    monkeypatch.setattr(
        real_sets, "unips", lambda source: lambda images, mask: mask[..., None] * tilt
    )
    monkeypatch.setattr(real_sets, "sphere_cases", lambda: iter(()))
    data.make_ps_wild(tmp_path / "mini", lightings=("directional",))
    dev = tmp_path / "diligent_dev"
    data.make_diligent(dev, images=12, objects=("ball",), size=(32, 40))
    arguments = ["--weights", "a", "b", "--photographs", str(tmp_path)]
    arguments += ["--ps-wild", str(tmp_path / "mini")]
    assert not real_sets.main([*arguments, "--json"])
    shown = capsys.readouterr()
    cat = tmp_path / "photos" / "psbox_cat.data"
    assert shown.err.strip() == f"skipped {cat}: no such folder"
    found = json.loads(shown.out)
    masks = [f"diligent, mask {offset:+d} px" for offset in real_sets.OFFSETS]
    wanted = ["diligent, 10 images", "diligent, all", "mini, directional"]
    assert sorted(found) == sorted([*wanted, *masks])
    for rows in found.values():
        for row in rows.values():
            assert list(row) == ["a", "b", "constant normal"]
            assert row["a"] == row["b"] != row["constant normal"] < 45
    rows = dict(real_sets.table_rows(found))
    mean = np.mean([rows[f"  directional/obj00{i}"] for i in range(2)], axis=0)
    np.testing.assert_allclose(rows["mini, directional"], mean)
    assert not real_sets.main(arguments)
    lines = capsys.readouterr().out.splitlines()
    (line,) = (line for line in lines if "mini, directional" in line)
    figures = [f"{figure:.2f}" for figure in rows["mini, directional"]]
    assert all(figure in line for figure in figures)
