"""Every reader on miniature sets in the published layouts, to the pixel."""

import evaluation_data as data
import numpy as np
import pytest
from scipy.io import loadmat, savemat

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import open_benchmark, submission_bytes
from unips_jax.evaluation.benchmarks.base import distant_lights
from unips_jax.evaluation.benchmarks.luces import read_leds
from unips_jax.io.selection import is_photograph


def test_directions_of_lights_become_unit(tmp_path):
    lights = distant_lights(np.array([[0, 3, 4.0], [0, 0, 0.1]]), None, tmp_path)
    np.testing.assert_allclose(lights.directions, [[0, 0.6, 0.8], [0, 0, 1]])
    np.testing.assert_array_equal(lights.intensities, np.ones((2, 3)))


def test_diligent_gives_what_was_stored(tmp_path):
    data.make_diligent(tmp_path, objects=("ball",))
    mask, truth, directions, intensities = data.make_directional(
        tmp_path / "pmsData" / "ballPNG", images=4, seed=3
    )
    before = data.snapshot(tmp_path)
    item = open_benchmark("diligent", tmp_path, objects=("ball",))[0]
    rendered = data.shade(truth, directions) * intensities[:, None, None] / 2
    np.testing.assert_array_equal(item.images, data.to16(rendered))
    assert item.images.dtype == np.uint16
    np.testing.assert_array_equal(item.mask, mask)
    np.testing.assert_array_equal(item.normals, truth.astype(np.float32))
    np.testing.assert_allclose(item.lights.directions, directions, atol=1e-6)
    np.testing.assert_allclose(item.lights.intensities, intensities, rtol=1e-6)
    assert item.focal == np.inf
    assert data.snapshot(tmp_path) == before


def test_diligent_root_may_be_pmsdata_itself(tmp_path):
    data.make_diligent(tmp_path, images=2)
    names = [e.name for e in open_benchmark("diligent", tmp_path / "pmsData").entries]
    assert names == list(data.DILIGENT)
    assert len(open_benchmark("diligent", tmp_path)) == 10


def test_diligent_drops_the_corrupt_images_of_bear(tmp_path):
    data.make_diligent(tmp_path, images=4, objects=("bear",))
    benchmark = open_benchmark("diligent", tmp_path, objects=("bear",))
    item = benchmark[0]
    assert [p.name for p in benchmark.entries[0].images] == [
        "021.png",
        "022.png",
        "023.png",
        "024.png",
    ]
    folder = tmp_path / "pmsData" / "bearPNG"
    directions = np.loadtxt(folder / "light_directions.txt")
    np.testing.assert_allclose(item.lights.directions, directions[20:], atol=1e-6)
    shading = data.shade(item.normals, directions[20:])
    shading = shading * item.lights.intensities[:, None, None] / 2
    difference = np.abs(item.images / 65535 - shading)[:, item.mask]
    assert difference.max() < 1e-4
    assert item.notes == ("the first 20 images are corrupt: dropped",)


def test_diligent_drops_nothing_of_a_bear_without_the_corrupt_images(tmp_path):
    data.make_diligent(tmp_path, images=76, objects=("bear",))
    folder = tmp_path / "pmsData" / "bearPNG"
    for name in ("filenames.txt", "light_directions.txt", "light_intensities.txt"):
        lines = (folder / name).read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(lines[20:]))
    benchmark = open_benchmark("diligent", tmp_path, objects=("bear",))
    item = benchmark[0]
    assert len(item.images) == len(item.lights.directions) == 76
    assert benchmark.entries[0].images[0].name == "021.png" and item.notes == ()


def test_of_a_thinned_out_bear_the_corrupt_images_go_by_their_numbers(tmp_path):
    data.make_diligent(tmp_path, images=76, objects=("bear",))
    folder = tmp_path / "pmsData" / "bearPNG"
    for name in ("filenames.txt", "light_directions.txt", "light_intensities.txt"):
        lines = (folder / name).read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(lines[::3]))
    benchmark = open_benchmark("diligent", tmp_path, objects=("bear",))
    names = [path.name for path in benchmark.entries[0].images]
    assert names[0] == "022.png" and len(names) == 25
    assert benchmark[0].notes == ("the first 7 images are corrupt: dropped",)


def test_diligent_ignores_harvests_upside_down_text(tmp_path):
    data.make_diligent(tmp_path, objects=("harvest",), size=(13, 16))
    folder = tmp_path / "pmsData" / "harvestPNG"
    item = open_benchmark("diligent", tmp_path, objects=("harvest",))[0]
    text = np.loadtxt(folder / "normal.txt").reshape(13, 16, 3)
    stored = loadmat(folder / "Normal_gt.mat")["Normal_gt"]
    np.testing.assert_array_equal(item.normals, stored.astype(np.float32))
    assert np.abs(item.normals - text[::-1]).max() < 1e-6
    assert np.abs(item.normals - text).max() > 1


def test_diligent_keeps_and_reports_pot2s_zero_normals(tmp_path):
    data.make_diligent(tmp_path, objects=("pot2",))
    item = open_benchmark("diligent", tmp_path, objects=("pot2",))[0]
    assert (~item.normals[item.mask].any(-1)).sum() == 7
    assert item.notes == ("7 true normals of zero length count as 90 degrees",)


def test_diligent_needs_all_ten_objects_unless_told(tmp_path):
    data.make_diligent(tmp_path, objects=("ball", "cat"), images=2)
    with pytest.raises(InputError, match="bearPNG"):
        open_benchmark("diligent", tmp_path)
    assert len(open_benchmark("diligent", tmp_path, objects=("ball", "cat"))) == 2
    with pytest.raises(InputError, match="no object"):
        open_benchmark("diligent", tmp_path, objects=("ball", "elk"))


def test_diligent_reports_a_mask_of_another_size_than_published(tmp_path):
    data.make_diligent(tmp_path, objects=("ball",), images=1, size=(512, 612))
    (note,) = open_benchmark("diligent", tmp_path, objects=("ball",))[0].notes
    assert "published one 15791" in note


def test_diligent_mv_has_views_and_a_camera(tmp_path):
    data.make_diligent_mv(tmp_path, objects=("cow",))
    benchmark = open_benchmark("diligent-mv", tmp_path, objects=("cow",))
    assert [entry.name for entry in benchmark.entries] == [
        f"cow/view_{i:02d}" for i in range(1, 21)
    ]
    item = benchmark[6]
    assert item.focal == 3700
    assert item.tags == {"object": "cow", "view": "07"}
    np.testing.assert_allclose(
        item.lights.directions, data.lights(3, seed=7), atol=1e-6
    )


def test_diligent_mv_misses_a_view(tmp_path):
    data.make_diligent_mv(tmp_path, objects=("cow",))
    (tmp_path / "mvpmsData/cowPNG/view_13").rename(tmp_path / "gone")
    with pytest.raises(InputError, match="view_13"):
        open_benchmark("diligent-mv", tmp_path, objects=("cow",))
    (entry,) = open_benchmark("diligent-mv", tmp_path, objects=("cow/view_02",)).entries
    assert entry.name == "cow/view_02"


def test_diligent102_withholds_the_truth(tmp_path):
    data.make_diligent102(tmp_path, objects=("BALL_POM",))
    benchmark = open_benchmark("diligent102", tmp_path, objects=("BALL_POM",))
    item = benchmark[0]
    assert item.normals is None and item.images.shape == (3, 1001, 1001, 3)
    assert item.tags["category"] == "POM"
    with pytest.raises(InputError, match="BALL_PP"):
        open_benchmark("diligent102", tmp_path)


def test_diligent102_without_a_list_takes_numbered_images(tmp_path):
    data.make_diligent102(tmp_path, objects=("NUT_AL",))
    (tmp_path / "NUT_AL" / "filenames.txt").unlink()
    (entry,) = open_benchmark("diligent102", tmp_path, objects=("NUT_AL",)).entries
    assert [p.name for p in entry.images] == ["001.png", "002.png", "003.png"]


def test_submission_is_what_the_benchmark_reads_and_always_the_same(tmp_path):
    normals = np.random.default_rng(0).normal(size=(7, 5, 3)).astype(np.float32)
    first = submission_bytes(normals)
    assert first == submission_bytes(normals)
    (tmp_path / "BALL_POM.mat").write_bytes(first)
    stored = loadmat(tmp_path / "BALL_POM.mat")["Normal_est"]
    np.testing.assert_array_equal(stored, normals.astype(np.float64))


def test_luces_gives_truth_and_camera_but_no_distant_lights(tmp_path):
    data.make_luces(tmp_path, objects=("Ball", "Jar"))
    benchmark = open_benchmark("luces", tmp_path, objects=("Jar", "Ball"))
    assert [entry.name for entry in benchmark.entries] == ["Ball", "Jar"]
    item = benchmark[1]
    mask, normals = data.sphere(12, 16)
    assert item.images.shape == (52, 12, 16, 3)
    np.testing.assert_array_equal(
        item.images, data.to16(data.shade(normals, data.lights(52)))
    )
    np.testing.assert_allclose(
        item.normals, np.where(mask[..., None], normals, 0), atol=2e-5
    )
    assert item.focal == 22.5 and item.lights is None
    leds = read_leds(tmp_path / "data/Jar/led_params.txt")
    np.testing.assert_allclose(leds.positions, 200 * data.lights(52), atol=1e-4)


def test_uw_reads_lists_lights_and_the_grey_sphere(tmp_path):
    data.make_uw(tmp_path)
    benchmark = open_benchmark("uw", tmp_path)
    assert [entry.name for entry in benchmark.entries] == list(data.UW)
    items = data.by_name(benchmark)
    gray = items["gray"]
    assert gray.images.dtype == np.uint8 and len(gray.images) == 12
    assert [p.name for p in benchmark.entries[2].images][9:] == [
        "gray.9.png",
        "gray.10.png",
        "gray.11.png",
    ]
    np.testing.assert_allclose(gray.lights.directions, data.lights(12), atol=1e-5)
    mask, normals = data.sphere(30, 32)
    inside = normals[mask]
    cosine = np.sum(gray.normals[mask] * inside, -1) / np.linalg.norm(inside, axis=-1)
    assert np.rad2deg(np.arccos(np.minimum(cosine, 1))).mean() < 4
    assert items["owl"].normals is None
    assert "outline" in gray.notes[0]


def test_uw_without_lights_and_lists(tmp_path):
    data.make_uw(tmp_path, with_lights=False)
    for path in (tmp_path / "psmImages").glob("*.txt"):
        path.unlink()
    item = open_benchmark("uw", tmp_path / "psmImages", objects=("cat",))[0]
    assert item.lights is None and len(item.images) == 12


def test_uw_lights_away_from_the_viewer_are_turned(tmp_path):
    data.make_uw(tmp_path)
    rows = data.lights(12) * [1, 1, -1]
    path = tmp_path / "psmImages" / "lights.txt"
    path.write_text("12\n" + "\n".join(" ".join(map(str, row)) for row in rows))
    item = open_benchmark("uw", tmp_path, objects=("cat",))[0]
    np.testing.assert_allclose(item.lights.directions, data.lights(12), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "photograph"),
    [
        ("L_00.png", True),
        ("000.tif", True),
        ("IMG_1.JPG", True),
        ("maskot_1.png", True),
        ("normandy.jpg", True),
        ("metallic_ball.png", False),
        ("normal.tif", False),
        ("Normal_gt.png", False),
        ("mask.png", False),
        ("buddha.mask.png", False),
        ("depth.exr", False),
        ("baseColor.tif", False),
        ("roughness.tif", False),
        ("metal.tif", False),
        ("gt_normal.png", False),
        ("._L_00.png", False),
        ("notes.txt", False),
        ("scene_gt.png", False),
    ],
)
def test_what_is_a_photograph(tmp_path, name, photograph):
    assert is_photograph(tmp_path / name) is photograph


def test_fingerprint_follows_the_data_and_not_the_place(tmp_path):
    first = data.make_folder(tmp_path / "a")
    data.make_folder(tmp_path / "b")
    benchmark = open_benchmark("folder", first)
    before = benchmark.check(0)
    assert before == open_benchmark("folder", tmp_path / "b").check(0)
    assert before != benchmark.check(1)
    image = benchmark[0].images[1].copy()
    image[3, 4, 1] ^= 1
    data.write_image(first / "cup" / "IMG_9.PNG", image)
    assert benchmark.check(0) != before


def test_truth_facing_away_is_reported(tmp_path):
    data.make_directional(tmp_path / "pmsData" / "catPNG", images=2)
    path = tmp_path / "pmsData" / "catPNG" / "Normal_gt.mat"
    truth = loadmat(path)["Normal_gt"]
    savemat(path, {"Normal_gt": -truth})
    (note,) = open_benchmark("diligent", tmp_path, objects=("cat",))[0].notes
    assert "away from the viewer" in note


@pytest.mark.parametrize("others", [(), ("ball",)])
def test_a_misspelt_object_is_named_with_those_there_are(tmp_path, others):
    data.make_diligent(tmp_path / "d", objects=("ball", "bear", "cow"), images=2)
    data.make_folder(tmp_path / "f")
    data.make_ps_wild(tmp_path / "p", lightings=("mixed",))
    there = {"diligent": "ball, bear", "folder": "cup, shoe", "ps-wild": "mixed/obj000"}
    for name, names in there.items():
        wanted = (*(others if name == "diligent" else ()), "bal")
        with pytest.raises(InputError, match=f"no object 'bal' in .*; .* has {names}"):
            open_benchmark(name, tmp_path / name[0], objects=wanted)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no object 'bal' in .*empty$"):
        open_benchmark("diligent", tmp_path / "empty", objects=("bal",))


def test_objects_that_are_not_wanted_are_not_read(tmp_path):
    data.make_folder(tmp_path / "f")
    for path in (tmp_path / "f" / "shoe").glob("IMG*"):
        path.unlink()
    (found,) = open_benchmark("folder", tmp_path / "f", objects=("cup",)).entries
    assert found.name == "cup"
    data.make_ps_wild(tmp_path / "p")
    (tmp_path / "p" / "mixed" / "half.data").mkdir()
    (tmp_path / "p" / "mixed" / "obj001.data" / "meta.json").write_text("{")
    for wanted, count in (("obj000", 3), ("mixed/obj000", 1)):
        assert (
            len(open_benchmark("ps-wild", tmp_path / "p", objects=(wanted,))) == count
        )


def test_unknown_benchmark_and_missing_root(tmp_path):
    with pytest.raises(InputError, match="no benchmark 'x'"):
        open_benchmark("x", tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        open_benchmark("luces", tmp_path / "nowhere")
