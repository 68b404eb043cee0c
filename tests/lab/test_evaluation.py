"""The runner and its tables."""

import csv
import json

import evaluation_data as data
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.baselines.method import Estimated, Observed, Unsupported
from unips_jax.evaluation import protocols, publish, runner, summary
from unips_jax.evaluation.benchmarks import open_benchmark
from unips_jax.evaluation.plan import Plan, check_data, tasks_of
from unips_jax.evaluation.protocols import Protocol
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.store import Store
from unips_jax.evaluation.tables import files_of
from unips_jax.evaluation.variants import Variant

# The runner


class Recorder:
    """A method that counts its calls."""

    def __init__(self, label, tilt=0.0, *, needs_lights=False, fails_at=None):
        self.calls = 0
        self.fails_at = fails_at
        self.needs_lights = needs_lights
        self.normal = data.tilted(tilt)[0, 0]
        self.variant = Variant(label, {"method": label}, self.run)

    def run(self, observed):
        self.calls += 1
        if self.needs_lights and observed.lights is None:
            raise Unsupported("needs lights")
        if self.calls == self.fails_at:
            raise RuntimeError("a bug")
        return np.where(observed.mask[..., None], self.normal, 0)


def plan_of(root, *recorders, counts=(None,), protocol=None):
    benchmark = open_benchmark("ps-wild", root)
    return Plan(
        benchmark,
        [recorder.variant for recorder in recorders],
        protocol or Protocol("native"),
        counts,
        (0,),
        list(check_data(benchmark)),
    )


def results_of(plan, store):
    tasks = tasks_of(plan)
    failed = {}
    assert len(list(runner.execute(plan, tasks, store, failed))) == len(tasks)
    return Results(
        plan.benchmark.name,
        plan.protocol.label,
        {variant.label: variant.about for variant in plan.variants},
        plan.counts,
        runner.collect(plan, tasks, store, failed),
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
    assert [row[3] for row in objects.values[:-1]].count("unsupported") == 4
    assert tables["summary"].values[0][-1] == "2 of 6"
    remarks = [row for row in tables["remarks"].values if row[1] == "lit"]
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
    def mirrored(observed):
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
    assert list(tables["measures"].values[0])[:2] == ["plain", "mirrors"]
    assert tables["measures"].values[0][-1] == 1


@pytest.mark.parametrize("number", [np.float32(2), jnp.float32(2), np.int64(2), 2])
def test_figures_of_ones_own_are_any_numbers(ps_wild, tmp_path, number):
    def method(observed):
        return Estimated(
            observed.mask[..., None] * [0.0, 0, 1], {"a": number, "b": nan}
        )

    nan = float("nan")
    mine = Variant("mine", {"method": "mine"}, method)
    plan = plan_of(ps_wild, Recorder("flat"))._replace(variants=[mine])
    results = results_of(plan, Store(tmp_path))
    assert [r.measures for r in results.of("mine", None)][0] == {"a": 2.0}
    wrong = mine._replace(run=lambda o: Estimated(method(o).normals, {"a": "x"}))
    plan = plan._replace(variants=[wrong._replace(key={"method": "w"}, foreign=True)])
    (reason, *_) = [r.unsupported for r in results_of(plan, Store(tmp_path)).results]
    assert reason.startswith("failed: method 'mine': expected figures that are numbers")


def test_an_oracle_needs_the_truth():
    mask, normals = data.sphere(24, 24)
    case = protocols.Case(Observed(np.ones((1, 24, 24, 3)), mask), None)
    oracle = Variant("oracle", {}, lambda observed: normals, "", True)
    with pytest.raises(Unsupported, match="needs the true normals"):
        runner.estimate(oracle, case)


def test_a_map_of_another_shape_is_a_bug(ps_wild, tmp_path):
    wrong = Variant("wrong", {}, lambda observed: observed.mask)
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
    assert not stored[~mask].any()


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
    row = dict(zip(tables["summary"].names, tables["summary"].values[0], strict=True))
    for lighting in data.PS_WILD_LIGHTINGS:
        pair = [maes[f"{lighting}/obj00{i}"] for i in (0, 1)]
        assert row[lighting] == pytest.approx(np.mean(pair))
    assert row["Mean"] == pytest.approx(np.mean(list(maes.values())))
    assert row["Source"] == "this run" and row["Images"] == 4
    published = [r for r in tables["summary"].values if r[2] == "published"]
    assert ["UniPS", "all", "published", 17.0, 14.5, 13.8] in [r[:6] for r in published]
    sweep = tables["images"].values
    assert [r[:3] for r in sweep[:4]] == [
        [label, n, "this run"] for label in ("flat", "tilt") for n in (2, 4)
    ]
    assert [r[1] for r in sweep[4:]] == [1, 4, 8, 16, 32]
    category = tables["categories"]
    assert category.names[:3] == ["Material category", "Lighting", "Objects"]
    assert category.values[0][:3] == ["metal", "directional", 1]
    assert category.values[0][3] == maes["directional/obj001"]
    pixels = sum(r.score.pixels for r in results.of("flat", 4))
    assert sum(r[1] for r in tables["angles"].values) == pixels


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


def test_tables_of_an_earlier_command_do_not_stay(ps_wild, tmp_path):
    store, flat = Store(tmp_path), Recorder("flat")
    for counts in ((2, 4), (4,)):
        tables = summary.tables(
            results_of(plan_of(ps_wild, flat, counts=counts), store)
        )
        assert {table.name for table in tables} <= set(summary.TABLES)
        folder = publish.write_tables(store, tables)
        (folder / "mine.csv").touch()
        names = {path.stem for path in folder.glob("*.csv")}
        assert names == {"mine", *(table.name for table in tables)}
        assert ("images" in names) == (len(counts) == 2)
