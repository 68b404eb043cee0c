"""PS-Wild's sets in their published and rendered layouts, to the pixel."""

import json

import evaluation_data as data
import numpy as np
import OpenEXR
import pytest

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import open_benchmark
from unips_jax.evaluation.benchmarks.ps_wild import manifest


def test_rendered_ps_wild_has_masks_lights_and_categories(tmp_path):
    data.make_ps_wild(tmp_path)
    benchmark = open_benchmark("ps-wild", tmp_path)
    assert [entry.name for entry in benchmark.entries] == [
        f"{lighting}/obj{i:03d}" for lighting in data.PS_WILD_LIGHTINGS for i in (0, 1)
    ]
    items = data.by_name(benchmark)
    item = items["directional/obj001"]
    mask, normals = data.sphere(24, 24, radius=24 * 0.35)
    np.testing.assert_array_equal(item.mask, mask)
    np.testing.assert_allclose(item.normals[mask], normals[mask], atol=2e-5)
    assert (item.normals[~mask] == 0).all()
    assert item.tags["category"] == "metal" and item.tags["lighting"] == "directional"
    np.testing.assert_allclose(
        item.lights.directions, data.lights(4, seed=1), atol=1e-6
    )
    meta = tmp_path / "directional" / "obj001.data" / "meta.json"
    colors = np.arange(1.0, 13).reshape(4, 3)
    facts = json.loads(meta.read_text()) | {"light_intensities": colors.tolist()}
    meta.write_text(json.dumps(facts))
    item = data.by_name(open_benchmark("ps-wild", tmp_path))["directional/obj001"]
    np.testing.assert_array_equal(item.lights.intensities, colors)
    assert items["mixed/obj001"].lights is None
    meta = tmp_path / "mixed" / "obj001.data" / "meta.json"
    meta.write_text('{"category": "", "shape": "ball"}')
    tags = data.by_name(open_benchmark("ps-wild", tmp_path))["mixed/obj001"].tags
    assert "category" not in tags and tags["shape"] == "ball"


@pytest.mark.parametrize(
    ("text", "focal"),
    [("{}", None), ('{"focal_mm": null}', np.inf), ('{"focal": 33.5}', 33.5)],
)
def test_ps_wild_knows_orthographic_cameras(tmp_path, text, focal):
    data.make_ps_wild(tmp_path)
    (tmp_path / "mixed" / "obj001.data" / "meta.json").write_text(text)
    benchmark = open_benchmark("ps-wild", tmp_path)
    assert data.by_name(benchmark)["mixed/obj001"].focal == focal


def test_ps_wild_test_takes_masks_from_normals_and_the_manifest(tmp_path):
    data.make_ps_wild_test(tmp_path)
    (tmp_path / "environment").rename(tmp_path / "HDRI")
    benchmark = open_benchmark("ps-wild", tmp_path)
    assert len(benchmark) == 150
    lightings = [entry.tags["lighting"] for entry in benchmark.entries]
    assert lightings[::50] == ["directional", "environment", "mixed"]
    _, normals = data.sphere(16, 16, radius=6)
    item = benchmark[58]
    np.testing.assert_array_equal(item.mask, normals.any(-1))
    # Figure 11: the second material of bunnydoll's pair is the tenth object.
    assert benchmark.entries[9].tags["material"] == "wood-parquet-59"
    assert benchmark.entries[9].tags["category"] == "Wood"
    counts = {}
    for entry in benchmark.entries[:50]:
        category = entry.tags["category"]
        counts[category] = counts.get(category, 0) + 1
    assert sum(counts.values()) == 50 and len(counts) == 6


def test_ps_wild_materials_by_name_come_before_position(tmp_path):
    data.make_ps_wild_test(tmp_path, objects=1)
    folder = tmp_path / "mixed" / "00.data"
    folder.rename(tmp_path / "mixed" / "dolphin_explosion-blue-1.data")
    entries = {e.name: e for e in open_benchmark("ps-wild", tmp_path).entries}
    tags = entries["mixed/dolphin_explosion-blue-1"].tags
    assert (tags["category"], tags["material"]) == ("Floor", "explosion-blue-1")
    assert "category" not in entries["directional/00"].tags


def test_manifest_is_the_papers():
    assert len(manifest()) == 50
    assert len({row["object"] for row in manifest()}) == 25


def test_ps_wild_training_folder_is_read_and_left_alone(tmp_path):
    data.make_ps_wild_train(tmp_path)
    before = data.snapshot(tmp_path)
    benchmark = open_benchmark("ps-wild-train", tmp_path)
    item = benchmark[0]
    assert item.name == "anvil" and item.images.shape == (10, 16, 16, 3)
    for i in range(len(benchmark)):
        benchmark.check(i)
    assert data.snapshot(tmp_path) == before


@pytest.mark.parametrize("suffix", [".tif", ".exr"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_photographs_that_are_not_finite_are_refused(tmp_path, suffix, value):
    data.make_ps_wild_train(tmp_path)
    pixels = np.full((16, 16, 3), 0.5, np.float32)
    for path in sorted((tmp_path / "anvil.data").glob("0*.tif")):
        path.unlink()
        pixels[3, 4, 1] = value if path.stem == "004" else 0.5
        if suffix == ".tif":
            data.write_image(path, pixels)
        else:
            with OpenEXR.File({}, {"RGB": pixels.copy()}) as file:
                file.write(str(path.with_suffix(".exr")))
    benchmark = open_benchmark("ps-wild-train", tmp_path)
    message = rf"004\{suffix}: expected finite values, got 1 NaN or infinite"
    for read in (benchmark.check, benchmark.__getitem__):
        with pytest.raises(InputError, match=message):
            read(0)


def test_ps_wild_masked_pixels_without_truth_are_left_out_and_reported(tmp_path):
    data.make_ps_wild(tmp_path, objects=1)
    folder = tmp_path / "mixed" / "obj000.data"
    data.write_mask(folder / "mask.png", np.ones((24, 24), bool))
    benchmark = open_benchmark("ps-wild", tmp_path, objects=("mixed/obj000",))
    item = benchmark[0]
    mask, _ = data.sphere(24, 24, radius=24 * 0.3)
    np.testing.assert_array_equal(item.mask, mask)
    assert item.notes == (
        f"{(~mask).sum()} masked pixels have no true normal: left out",
    )
