"""Protocols, scores, methods, the runner and its tables."""

import csv
import json
from functools import partial

import evaluation_data as data
import jax
import numpy as np
import pytest
from scipy.io import loadmat

from unips_jax import eval as evaluation
from unips_jax import streaming
from unips_jax.baselines.method import Estimated, Unsupported
from unips_jax.command import InputError
from unips_jax.config import ModelConfig
from unips_jax.evaluation import methods, protocols, runner, summary
from unips_jax.evaluation.benchmarks import Item, open_benchmark
from unips_jax.evaluation.methods import UnipsOptions, Variant, load_variants
from unips_jax.evaluation.protocols import Box, Protocol
from unips_jax.evaluation.scores import from_json, score
from unips_jax.evaluation.store import Store
from unips_jax.evaluation.tables import files_of
from unips_jax.weights import init_params, save_weights

NO_WEIGHTS = UnipsOptions(())


def item_of(images, mask, normals=None, **rest):
    fields = {"lights": None, "focal": None, "tags": {"object": "x"}, "notes": ()}
    return Item("x", images, mask, normals, **{**fields, **rest})


# Protocols


def test_box_is_square_around_the_mask_with_a_margin():
    mask = np.zeros((40, 60), bool)
    mask[10:17, 20:40] = True
    assert protocols.square_box(mask) == Box(10 - (28 - 7) // 2, 20 - 4, 28)


def test_crop_of_its_own_size_passes_unchanged():
    rng = np.random.default_rng(0)
    mask = np.zeros((30, 33), bool)
    mask[7:15, 9:20] = rng.random((8, 11)) < 0.7
    mask[7, 9] = mask[14, 19] = True
    images = rng.integers(0, 65536, (3, 30, 33, 3), dtype=np.uint16)
    normals = rng.normal(size=(30, 33, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    case = protocols.show(
        item_of(images, mask, normals, focal=50.0), Protocol("crop", 19), [2, 0]
    )
    rows, columns = slice(2, 21), slice(5, 24)
    np.testing.assert_array_equal(case.mask, mask[rows, columns])
    expected = images[[2, 0], rows, columns] / np.float32(65535)
    np.testing.assert_array_equal(
        case.images, np.where(case.mask[..., None], expected, 0)
    )
    np.testing.assert_allclose(
        case.normals[case.mask], normals[rows, columns][case.mask], atol=1e-6
    )
    assert case.focal == 50


def test_crop_averages_masked_pixels_alone():
    mask = np.zeros((16, 16), bool)
    mask[4:12, 4:12] = True
    mask[4, 4] = False
    images = np.full((1, 16, 16, 3), 7.0, np.float32)
    images[0, 4, 4] = 1000
    images[0, 5, 4] = 10
    case = protocols.show(item_of(images, mask, focal=32.0), Protocol("crop", 8), [0])
    assert case.mask[2:6, 2:6].all() and case.mask.sum() == 16
    np.testing.assert_allclose(case.images[0, 2, 2], 8)
    np.testing.assert_allclose(case.images[0, 3, 3], 7)
    assert (case.images[0, 0] == 0).all()
    assert case.focal == 16


def test_crop_beyond_the_border_is_black():
    mask = np.ones((10, 10), bool)
    images = np.full((1, 10, 10, 3), 255, np.uint8)
    case = protocols.show(item_of(images, mask), Protocol("crop", 18), [0])
    np.testing.assert_array_equal(case.mask, np.pad(mask, 4))
    np.testing.assert_array_equal(case.images[0, ..., 0], np.pad(mask, 4))


def test_crop_keeps_zero_normals_zero_and_others_unit():
    mask, normals = data.sphere(64, 64)
    normals = np.where(np.arange(64)[:, None, None] < 32, normals, 0)
    images = np.ones((1, 64, 64, 3), np.float32)
    case = protocols.show(
        item_of(images, mask, normals.astype(np.float32)), Protocol("crop", 24), [0]
    )
    length = np.linalg.norm(case.normals, axis=-1)
    assert set(np.round(length, 5).ravel()) == {0, 1}
    assert (length[case.mask] == 0).sum() > 50


def test_focal_of_unknown_cameras_is_the_papers():
    mask, _ = data.sphere(32, 32)
    item = item_of(np.ones((1, 32, 32, 3), np.float32), mask)
    crop = Protocol("crop", 16)
    assert protocols.show(item, crop, [0]).focal is None
    assert protocols.show(item, crop, [0], crop_focal_ratio=1.0).focal == 16
    native = protocols.show(item, Protocol("native"), [0], crop_focal_ratio=1.0)
    assert native.focal is None


def test_subsets_are_nested_fixed_and_sorted():
    chosen = [protocols.choose_images(n, 32, seed=0) for n in (1, 4, 8, 16, 32)]
    for smaller, larger in zip(chosen, chosen[1:], strict=False):
        assert set(smaller) < set(larger)
    np.testing.assert_array_equal(chosen[-1], np.arange(32))
    np.testing.assert_array_equal(chosen[1], FOUR_OF_32)
    other = protocols.choose_images(4, 32, seed=1)
    assert other.tolist() != chosen[1].tolist()


FOUR_OF_32 = [7, 8, 21, 27]


def test_protocol_is_checked():
    with pytest.raises(InputError, match="crop or native"):
        Protocol("squint")
    with pytest.raises(InputError, match="at least 8"):
        Protocol("crop", 4)


# Scores


def tilted(*degrees):
    angles = np.deg2rad(degrees)
    return np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)[None]


def test_score_by_hand():
    true = tilted(0, 10, 20, 40, 80, 100, 0)
    true[0, 6] = 0
    estimate = tilted(0, 14, 30, 65, 40, 100, 5)
    estimate[0, 5] = np.nan
    mask = np.ones((1, 7), bool)
    found = score(estimate.astype(np.float32), true.astype(np.float32), mask)
    errors = [0, 4, 10, 25, 40, 90, 90]
    assert found.pixels == 7
    assert found.mae == pytest.approx(np.mean(errors), abs=1e-4)
    assert found.median == pytest.approx(25, abs=1e-4)
    shares = [100 * n / 7 for n in (2, 3, 3, 4)]
    np.testing.assert_allclose(found.within, shares)
    assert sum(found.histogram) == 7 and len(found.histogram) == 180
    assert found.histogram[90] == 2 and found.histogram[0] == 1
    # The true normal of zero length is 90 degrees from the viewer: the last bin.
    assert found.view_pixels == (2, 1, 1, 0, 0, 3)
    np.testing.assert_allclose(found.view_sums, (4, 10, 25, 0, 0, 220), atol=1e-3)
    assert (found.zero_truth, found.invalid) == (1, 1)
    again = from_json(json.loads(json.dumps(found._asdict())))
    assert again == found


def test_score_counts_only_the_mask():
    true, estimate = tilted(0, 0), tilted(10, 90)
    found = score(estimate, true, np.array([[True, False]]))
    assert found.pixels == 1 and found.mae == pytest.approx(10, abs=1e-4)


# Methods


def test_options_are_read_and_reach_the_method():
    request = "least-squares:colour=mean,keep=(0.2,0.8)"
    variant, constant = load_variants([request], NO_WEIGHTS)
    assert variant.label == "least-squares:colour=mean,keep=(0.2, 0.8)"
    assert constant.label == "constant"
    assert variant.key["options"] == {"colour": "mean", "keep": (0.2, 0.8)}


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ("phong", "no method 'phong'"),
        ("l1:iterations", "expected option=value"),
        ("l1:steps=3", "steps"),
        ("least-squares:keep=(0.9,0.1)", "0 <= low < high <= 1"),
        ("gcnet", "expected a file of weights"),
        ("gcnet:weights=nowhere.safetensors", "expected a file of weights"),
        ("unips:size=3", "--canonical-size"),
    ],
)
def test_bad_requests(request_, message):
    with pytest.raises(InputError, match=message):
        load_variants([request_], NO_WEIGHTS)


@pytest.mark.parametrize("name", ["classical", "variational", "mpm"])
def test_baselines_are_where_the_registry_says(name):
    assert load_variants([name], NO_WEIGHTS)[-1].label == "constant"


def test_what_a_row_must_tell_is_in_its_label(tmp_path):
    weights = tmp_path / "mine.safetensors"
    weights.touch()
    request = f"gcnet:weights={weights},normals=woodham,per=stack"
    oracle, gcnet, _ = load_variants(["mpm:sign=oracle", request], NO_WEIGHTS)
    assert gcnet.label == "gcnet:weights=mine,normals=woodham,per=stack,norm=range01"
    assert oracle.label == "mpm\N{DAGGER}" and oracle.oracle
    assert "chosen by the truth" in oracle.about


def small_weights(path, seed=0):
    config = ModelConfig(
        canonical_size=32,
        patch_channels=(4, 6),
        embed_dim=8,
        depths=(1,),
        num_heads=(1,),
        communication_heads=2,
        context_dim=8,
        hidden_dim=16,
        aggregation_layers=1,
        aggregation_heads=2,
        aggregation_mlp_dim=16,
        pma_mlp_dim=16,
        predictor_dim=8,
    )
    # Shapes alone are traced: initialising costs compiling for nothing.
    shapes = jax.eval_shape(partial(init_params, config), jax.random.key(0))
    rng = np.random.default_rng(seed)
    params = jax.tree.map(
        lambda leaf: 0.3 * rng.standard_normal(leaf.shape, np.float32), shapes
    )
    save_weights(path, config, params)
    return path


def test_unips_variants_get_their_own_settings(tmp_path, monkeypatch):
    def estimate(params, images, mask, *, config, uniform_contexts):
        return config.canonical_size, uniform_contexts

    monkeypatch.setattr(streaming, "estimate_photographs", estimate)
    weights = small_weights(tmp_path / "a.safetensors")
    options = UnipsOptions([str(weights)], (32, 48), True)
    variants = load_variants(["unips"], options)
    assert {variant.label: variant.run(None, None) for variant in variants[:-1]} == {
        "unips canonical 32": (32, False),
        "unips canonical 32 uniform contexts": (32, True),
        "unips canonical 48": (48, False),
        "unips canonical 48 uniform contexts": (48, True),
    }
    keys = {json.dumps(variant.key, sort_keys=True) for variant in variants}
    assert len(keys) == 5


def test_weights_are_known_by_their_contents(tmp_path):
    first = small_weights(tmp_path / "a.safetensors")
    copy = small_weights(tmp_path / "b.safetensors")
    other = small_weights(tmp_path / "c.safetensors", seed=1)
    options = UnipsOptions([str(first), str(copy), str(other)])
    a, b, c, _ = load_variants(["unips"], options)
    assert a.key == b.key != c.key
    assert [a.label, c.label] == ["unips a", "unips c"]
    with pytest.raises(InputError, match="two methods"):
        load_variants(["unips"], UnipsOptions([str(first), str(first)]))
    with pytest.raises(InputError, match="multiple of 4"):
        load_variants(["unips"], UnipsOptions([str(first)], (33,)))


# The runner


class Recorder:
    """A method that counts its calls."""

    def __init__(self, label, tilt=0.0, *, needs_lights=False, fails_at=None):
        self.calls = 0
        self.fails_at = fails_at
        self.needs_lights = needs_lights
        self.normal = tilted(tilt)[0, 0]
        self.variant = Variant(label, {"method": label}, self.run)

    def run(self, images, mask, *, lights=None, focal=None):
        self.calls += 1
        if self.needs_lights and lights is None:
            raise Unsupported("needs lights")
        if self.calls == self.fails_at:
            raise RuntimeError("a bug")
        return np.where(mask[..., None], self.normal, 0)


def plan_of(root, *recorders, counts=(None,), protocol=None):
    benchmark = open_benchmark("ps-wild", root)
    return runner.Plan(
        benchmark,
        [recorder.variant for recorder in recorders],
        protocol or Protocol("native"),
        counts,
        0,
        list(runner.check_data(benchmark)),
    )


def results_of(plan, store):
    tasks = runner.tasks_of(plan)
    assert len(list(runner.execute(plan, tasks, store))) == len(tasks)
    return summary.Results(
        plan.benchmark.name,
        plan.protocol.label,
        {variant.label: variant.about for variant in plan.variants},
        plan.counts,
        runner.collect(tasks, store),
    )


@pytest.fixture(scope="module")
def ps_wild(tmp_path_factory):
    return data.make_ps_wild(tmp_path_factory.mktemp("ps_wild"))


def test_nothing_finished_is_computed_again(ps_wild, tmp_path):
    store = Store(tmp_path)
    flat, tilt = Recorder("flat"), Recorder("tilt", 20)
    results_of(plan_of(ps_wild, flat, tilt), store)
    assert (flat.calls, tilt.calls) == (6, 6)
    files = data.snapshot(tmp_path)
    results_of(plan_of(ps_wild, flat, tilt), store)
    assert (flat.calls, tilt.calls) == (6, 6)
    assert data.snapshot(tmp_path) == files
    results_of(plan_of(ps_wild, flat, counts=(2, None)), store)
    assert flat.calls == 12
    results_of(plan_of(ps_wild, flat, protocol=Protocol("crop", 16)), store)
    assert flat.calls == 18


def test_changed_data_are_computed_again(tmp_path):
    root = data.make_ps_wild(tmp_path / "data", lightings=("mixed",))
    store, flat = Store(tmp_path / "work"), Recorder("flat")
    results_of(plan_of(root, flat), store)
    data.write_image(
        root / "mixed/obj001.data/L_00.png", np.ones((24, 24, 3), np.uint16)
    )
    results_of(plan_of(root, flat), store)
    assert flat.calls == 3


def test_a_method_that_cannot_run_gets_a_row_that_says_so(ps_wild, tmp_path):
    lit = Recorder("lit", needs_lights=True)
    results = results_of(plan_of(ps_wild, lit, Recorder("flat")), Store(tmp_path))
    tables = {table.name: table for table in summary.tables(results)}
    objects = tables["objects"]
    assert [row[3] for row in objects.rows[:-1]].count("unsupported") == 4
    assert tables["summary"].rows[0][-1] == "2 of 6"
    remarks = [row for row in tables["remarks"].rows if row[1] == "lit"]
    assert remarks == [["4 objects", "lit", "needs lights"]]


def test_a_crash_leaves_finished_results_and_nothing_else(ps_wild, tmp_path):
    store, flat = Store(tmp_path), Recorder("flat", fails_at=4)
    with pytest.raises(RuntimeError, match="a bug"):
        results_of(plan_of(ps_wild, flat), store)
    names = [path.suffix for path in tmp_path.glob("results/*/*/*")]
    assert sorted(names) == [".json"] * 3 + [".png"] * 3
    results_of(plan_of(ps_wild, flat), store)
    assert flat.calls == 7


def test_an_oracle_chooses_signs_by_the_truth(ps_wild, tmp_path):
    def mirrored(images, mask, *, lights=None, focal=None):
        normals = data.sphere(24, 24, radius=24 * 0.3)[1]
        return Estimated(normals * np.array([-1, 1, 1]), {"mirrors": 1.0})

    plain = Variant("plain", {"method": "mirrored"}, mirrored)
    oracle = Variant(
        "oracle", {"method": "mirrored", "oracle": True}, mirrored, "", True
    )
    plan = plan_of(ps_wild, Recorder("flat"))._replace(variants=[plain, oracle])
    results = results_of(plan, Store(tmp_path))
    # The second object of each lighting is another one.
    assert all(r.score.mae > 20 for r in results.of("plain", None)[::2])
    assert all(r.score.mae < 1 for r in results.of("oracle", None)[::2])
    tables = {table.name: table for table in summary.tables(results)}
    assert list(tables["measures"].rows[0])[:2] == ["plain", "mirrors"]
    assert tables["measures"].rows[0][-1] == 1


def test_an_oracle_needs_the_truth():
    mask, normals = data.sphere(24, 24)
    case = protocols.Case(np.ones((1, 24, 24, 3)), mask, None, None, None)
    oracle = Variant("oracle", {}, lambda *_, **__: normals, "", True)
    with pytest.raises(Unsupported, match="needs the true normals"):
        runner.estimate(oracle, case)


def test_a_map_of_another_shape_is_a_bug(ps_wild, tmp_path):
    wrong = Variant("wrong", {}, lambda images, mask, *, lights, focal: mask)
    plan = plan_of(ps_wild, Recorder("flat"))._replace(variants=[wrong])
    with pytest.raises(ValueError, match="'wrong': expected normals of shape"):
        results_of(plan, Store(tmp_path))


def test_stored_normals_are_the_estimate(ps_wild, tmp_path):
    store, tilt = Store(tmp_path), Recorder("tilt", 33)
    results = results_of(plan_of(ps_wild, tilt), store)
    mask, _ = data.sphere(24, 24, radius=24 * 0.3)
    stored = store.normals(results.results[0].name)
    np.testing.assert_allclose(
        stored[mask], np.tile(tilt.normal, (mask.sum(), 1)), atol=2e-5
    )
    assert np.abs(stored[~mask]).max() < 2e-5


def test_a_claim_is_exclusive_and_ends(tmp_path):
    store = Store(tmp_path)
    with store.claim("a/b") as ours:
        assert ours
        with Store(tmp_path).claim("a/b") as theirs:
            assert not theirs
        with store.claim("other") as other:
            assert other
    with store.claim("a/b") as ours:
        assert ours


# Tables


def test_tables_average_as_they_say(ps_wild, tmp_path):
    flat, tilt = Recorder("flat"), Recorder("tilt", 20)
    plan = plan_of(ps_wild, flat, tilt, counts=(2, 4))
    results = results_of(plan, Store(tmp_path))
    maes = {r.entry: r.score.mae for r in results.of("flat", 4)}
    tables = {table.name: table for table in summary.tables(results)}
    row = dict(zip(tables["summary"].columns, tables["summary"].rows[0], strict=True))
    for lighting in data.PS_WILD_LIGHTINGS:
        pair = [maes[f"{lighting}/obj00{i}"] for i in (0, 1)]
        assert row[lighting] == pytest.approx(np.mean(pair))
    assert row["Mean"] == pytest.approx(np.mean(list(maes.values())))
    assert row["Source"] == "this run" and row["Images"] == 4
    published = [r for r in tables["summary"].rows if r[2] == "published"]
    assert ["UniPS", "all", "published", 17.0, 14.5, 13.8] in [r[:6] for r in published]
    sweep = tables["images"].rows
    assert [r[:3] for r in sweep[:4]] == [
        [label, n, "this run"] for label in ("flat", "tilt") for n in (2, 4)
    ]
    assert [r[1] for r in sweep[4:]] == [1, 4, 8, 16, 32]
    category = tables["categories"]
    assert category.columns[:3] == ["Material category", "Lighting", "Objects"]
    assert category.rows[0][:3] == ["metal", "directional", 1]
    assert category.rows[0][3] == maes["directional/obj001"]
    pixels = sum(r.score.pixels for r in results.of("flat", 4))
    assert sum(r[1] for r in tables["angles"].rows) == pixels


def test_tables_in_every_format_say_the_same(ps_wild, tmp_path):
    results = results_of(plan_of(ps_wild, Recorder("50%_|x")), Store(tmp_path))
    tables = summary.tables(results)
    files = files_of(tables)
    stored = json.loads(files["tables.json"])
    assert list(stored) == [table.name for table in tables]
    first = stored["summary"]["rows"][0]
    rows = list(csv.reader(files["summary.csv"].decode().splitlines()))
    assert rows[0] == stored["summary"]["columns"]
    assert float(rows[1][3]) == pytest.approx(first[3], abs=1e-4)
    markdown = files["tables.md"].decode().splitlines()
    header = markdown.index("## " + tables[0].title) + 2
    assert markdown[header].count("|") == len(rows[0]) + 1
    assert set(markdown[header + 1]) <= set("|-: ")
    assert markdown[header + 2].startswith(r"| 50%_\|x | all | this run |")
    assert f"{first[3]:.2f}" in markdown[header + 2]
    latex = files["tables.tex"].decode()
    assert rf"50\%\_|x & all & this run & {first[3]:.2f} &" in latex
    assert latex.count(r"\begin{tabular}") == len(tables)


def test_published_numbers_of_diligent_stand_beside_ours(tmp_path):
    data.make_diligent(tmp_path / "data", images=3)
    work = tmp_path / "work"
    assert run("diligent", tmp_path / "data", work, "--method", "constant") == 0
    stored = json.loads((work / "tables" / "tables.json").read_text())
    objects = stored["objects"]
    rows = [dict(zip(objects["columns"], row, strict=True)) for row in objects["rows"]]
    assert rows[8]["Object"] == "pot2"
    assert rows[8]["least squares (published)"] == 14.65
    assert rows[-1]["least squares (published)"] == 15.39
    mask, normals = data.sphere(12, 14)
    angles = np.rad2deg(np.arccos(normals[mask][:, 2]))
    angles[:7] = 90
    assert rows[8]["constant"] == pytest.approx(angles.mean(), abs=1e-3)
    remarks = stored["remarks"]["rows"]
    assert [
        "pot2",
        None,
        "7 true normals of zero length count as 90 degrees",
    ] in remarks
    assert ["bear", None, "the first 20 images are corrupt: dropped"] in remarks


def test_published_means_are_over_the_objects_evaluated(tmp_path):
    data.make_diligent(tmp_path / "data", images=3, objects=("ball", "cat"))
    work = tmp_path / "work"
    chosen = ("--method", "constant", "--objects", "ball", "cat")
    assert run("diligent", tmp_path / "data", work, *chosen) == 0
    rows = json.loads((work / "tables" / "tables.json").read_text())["summary"]["rows"]
    means = {row[0]: row[3] for row in rows}
    assert means["least squares"] == pytest.approx((4.10 + 8.41) / 2)
    assert "PS-FCN" not in means


# The command


def run(benchmark, root, work, *rest):
    return evaluation.main(
        [
            *("--benchmark", benchmark, "--root", str(root), "--workdir", str(work)),
            *("--no-pictures", *rest),
        ]
    )


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        (["--weights", "no-such"], "no-such"),
        (["--method", "phong"], "no method"),
        (["--method", "constant", "--num-images", "9"], "has 4 images"),
        (["--method", "constant", "--num-images", "0"], "expected 1 or more"),
        (["--method", "constant", "--objects", "x"], "no object 'x'"),
        (["--method", "constant", "--crop-size", "3"], "at least 8"),
    ],
)
def test_bad_commands_stop_before_any_work(ps_wild, tmp_path, capsys, rest, message):
    assert run("ps-wild", ps_wild, tmp_path / "work", *rest) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "work").exists()


def test_work_folder_must_not_be_in_the_data_nor_a_file(ps_wild, tmp_path, capsys):
    inside = ps_wild / "results"
    assert run("ps-wild", ps_wild, inside, "--method", "constant") == 2
    assert "inside the data" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert run("ps-wild", ps_wild, tmp_path / "file", "--method", "constant") == 2
    assert "not a folder" in capsys.readouterr().err


def test_diligent102_writes_a_submission(tmp_path, capsys):
    data.make_diligent102(tmp_path / "data", objects=("NUT_AL",))
    work = tmp_path / "work"
    chosen = ["--objects", "NUT_AL", "--method", "constant"]
    assert run("diligent102", tmp_path / "data", work, *chosen) == 0
    stored = loadmat(work / "submission/constant/NUT_AL.mat")["Normal_est"]
    assert stored.shape == (1001, 1001, 3)
    mask, _ = data.sphere(1001, 1001)
    np.testing.assert_allclose(
        stored[mask], np.tile([0, 0, 1], (mask.sum(), 1)), atol=1e-4
    )
    assert "truth withheld" in (work / "tables/objects.csv").read_text()
    capsys.readouterr()
    assert (
        run("diligent102", tmp_path / "data", work, *chosen, "--protocol", "crop") == 2
    )
    assert "native" in capsys.readouterr().err


def test_unips_runs_from_the_command_line(ps_wild, tmp_path):
    weights = small_weights(tmp_path / "w.safetensors")
    work = tmp_path / "work"
    chosen = ["--objects", "mixed/obj000", "--weights", str(weights)]
    assert run("ps-wild", ps_wild, work, *chosen, "--crop-size", "32") == 0
    rows = json.loads((work / "tables/tables.json").read_text())["summary"]["rows"]
    assert [row[0] for row in rows[:2]] == ["unips", "constant"]
    assert rows[0][-1] == "1 of 1" and 0 < rows[0][3] < 180


def test_help_names_every_method(capsys):
    with pytest.raises(SystemExit):
        evaluation.main(["--help"])
    text = "".join(capsys.readouterr().out.split())
    assert all(name in text for name in methods.NAMES)
