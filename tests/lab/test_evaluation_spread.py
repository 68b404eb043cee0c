"""Seeds, intervals, pairs, and every figure as arrays."""

import csv

import evaluation_data as data
import numpy as np
import pytest

import unips_jax
from unips_jax.cli import evaluate as evaluation
from unips_jax.errors import InputError
from unips_jax.evaluation import charts, figures, statistics, summary
from unips_jax.evaluation.protocols import choose_images
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.runner import Result
from unips_jax.evaluation.scores import mean_score, score


def scored(mae):
    """A score of one pixel with this error in degrees."""
    up = np.float32([[[0, 0, 1]]])
    return score(data.tilted(mae), up, np.ones((1, 1), bool))


def results_of(errors, *, seeds=(0,), counts=(None,)):
    """Results of `{(method, object, lighting, count, seed): degrees}`."""
    made = [
        Result(
            f"{lighting}/{name}",
            {"object": name, "lighting": lighting},
            [],
            label,
            count,
            count or 9,
            None if mae is None else scored(mae),
            {},
            "" if mae is not None else "too dark",
            f"{label}{name}{seed}",
            seed,
        )
        for (label, name, lighting, count, seed), mae in errors.items()
    ]
    labels = dict.fromkeys(result.label for result in made)
    methods = dict.fromkeys(labels, "a method")
    return Results("mine", "native", methods, counts, made, seeds)


def test_an_interval_is_over_objects_not_entries():
    """Two entries that are one object's say no more than one of them."""
    twice = {name: [x, x] for name, x in zip("abcd", (1.0, 2, 3, 4), strict=True)}
    once = {name: own[:1] for name, own in twice.items()}
    assert statistics.interval(twice) == pytest.approx(statistics.interval(once))
    alone = {
        f"{name}{i}": [x] for name, own in twice.items() for i, x in enumerate(own)
    }
    assert statistics.interval(alone)[0] > statistics.interval(once)[0]
    assert statistics.interval({"a": [1.0], "b": [2.0]}) is None
    uneven = {"a": [7.0] * 5, "b": [7.0], "c": [7.0]}
    assert statistics.interval(uneven) == pytest.approx((7, 7))


def test_an_interval_holds_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(100):
        values = rng.normal(10, 3, size=30)
        low, high = statistics.interval({str(i): [x] for i, x in enumerate(values)})
        held += low < 10 < high
    assert 88 <= held <= 100


def test_pairs_by_hand():
    """On three of four objects the first is lower; one of them the other lacks."""
    first = {"a": {"a1": 1.0, "a2": 3.0}, "b": {"b": 5.0}, "c": {"c": 9.0}}
    second = {
        "a": {"a1": 2.0, "a2": 6.0},
        "b": {"b": 8.0},
        "c": {"c": 8.0},
        "d": {"d": 1},
    }
    pair = statistics.compare(first, second)
    assert (pair.objects, pair.lower, pair.higher) == (3, 2, 1)
    assert (pair.mean, pair.other) == (18 / 4, 24 / 4)
    assert pair.p == 1.0  # two against one
    low, high = pair.interval
    assert low < pair.mean - pair.other < high
    six = {name: {name: 1.0} for name in "abcdef"}
    worse = {name: {name: 2.0} for name in "abcdef"}
    assert statistics.compare(six, worse).p == pytest.approx(2 / 2**6)
    pair = statistics.compare(six, worse | {"f": {"f": 1.0}})  # of a tie, nothing
    assert (pair.objects, pair.lower, pair.higher) == (6, 5, 0)
    assert pair.p == pytest.approx(2 / 2**5)
    assert statistics.compare(first, {}) is None


def test_figures_are_means_over_seeds_and_their_deviation_is_said():
    errors = {
        ("a", name, "sun", 4, seed): 10 + 10 * seed + place
        for seed in (0, 1)
        for place, name in enumerate(("x", "y", "z"))
    }
    results = results_of(errors, seeds=(0, 1), counts=(4,))
    tables = {table.name: table for table in summary.tables(results)}
    row = dict(zip(tables["summary"].names, tables["summary"].values[0], strict=True))
    assert row["Mean"] == pytest.approx(16, abs=1e-4) and row["Objects"] == "3 of 3"
    spread = dict(zip(tables["spread"].names, tables["spread"].values[0], strict=True))
    assert spread["Over subsets"] == pytest.approx(np.std([11, 21], ddof=1), abs=1e-4)
    assert spread["From"] < 16 < spread["To"] and spread["Objects"] == 3
    assert [row[:2] for row in tables["objects"].values[:-1]] == [
        ["sun/x", "sun"],
        ["sun/y", "sun"],
        ["sun/z", "sun"],
    ]


def test_pairs_are_of_each_method_and_the_first():
    errors = {
        (label, name, "sun", None, None): mae
        for label, own in (("ours", (5.0, 6, 7)), ("theirs", (8.0, 9, 4)))
        for name, mae in zip("xyz", own, strict=True)
    }
    tables = {table.name: table for table in summary.tables(results_of(errors))}
    (row,) = tables["pairs"].values
    found = dict(zip(tables["pairs"].names, row, strict=True))
    assert (found["Method"], found["Lower on"]) == ("theirs", "1 of 3")
    expected = {"Mean": 7, "ours": 6, "Difference": 1, "From": -3, "To": 3}
    assert {k: found[k] for k in expected} == pytest.approx(expected, abs=1e-4)


def test_one_failed_subset_leaves_no_mean_over_the_others():
    errors = {("a", "x", "sun", 4, 0): 10.0, ("a", "x", "sun", 4, 1): None}
    results = results_of(errors, seeds=(0, 1), counts=(4,))
    (result,) = results.of("a", 4)
    assert result.score is None and result.unsupported == "too dark"


def test_a_mean_score_is_the_mean_of_every_number():
    both = mean_score([scored(10.0), scored(30.0)])
    assert both.mae == pytest.approx(20, abs=1e-4) and both.pixels == 1
    assert both.within[1] == 50  # one of the two is below 11.25
    assert both.histogram[30] + both.histogram[29] == 0.5


def test_ticks_stand_where_the_counts_are():
    errors = {
        ("a", "x", "sun", count, seed): 20 - count + seed
        for count in (3, 7, 11)
        for seed in (0, 1)
    }
    results = results_of(errors, seeds=(0, 1), counts=(3, 7, 11))
    (chart,) = (c for c in charts.charts(results) if "number of images" in c.title)
    ticks = chart.svg.decode().split('id="matplotlib.axis_2"')[0].count('id="xtick_')
    assert ticks == 3


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    root = data.make_ps_wild(tmp_path_factory.mktemp("data"), objects=3)
    work = tmp_path_factory.mktemp("work")
    named = ["--benchmark", "ps-wild", "--root", str(root), "--workdir", str(work)]
    chosen = ["-m", "woodham", "constant", "--num-images", "3", "all", "--seeds"]
    assert evaluation.main([*named, "--no-pictures", *chosen, "0", "1", "2"]) == 0
    return work


def test_every_figure_is_a_row_of_one_table(work):
    with (work / "tables" / "figures.csv").open() as file:
        names, *rows = csv.reader(file)
    assert tuple(names) == figures.COLUMNS
    found = unips_jax.load_results(work)
    assert len(found) == len(rows)
    errors = found.pick(measure="mae_deg", method="constant")
    # Nine entries, with three subsets of 3 and all 4 images.
    assert len(errors) == 9 * (3 + 1)
    assert set(errors.seed[errors.images == 3]) == {0, 1, 2}
    assert set(errors.seed[errors.images == 4]) == {-1}
    assert found.value.dtype == float and found.images.dtype == int
    pair = found.compare("woodham", "constant", images=4)
    assert pair.objects == 3 and pair.mean < pair.other and pair.lower == 3
    with pytest.raises(ValueError, match="expected one of benchmark, .*, got 'light'"):
        found.pick(light="sun")
    with pytest.raises(ValueError, match="share no mae_deg; there are woodham, const"):
        found.compare("woodham", "phong")


def test_figures_are_compared_view_by_view():
    """Of a view that one method lacks nothing counts."""
    rows = [("a", "1", 1.0), ("a", "2", 9.0), ("b", "1", 2.0)]
    made = [("mine", "x", "sun", v, m, 4, -1, "mae_deg", e) for m, v, e in rows]
    found = figures.Figures(*map(np.array, zip(*made, strict=True)))
    pair = found.compare("a", "b")
    assert (pair.mean, pair.other, pair.lower) == (1, 2, 1)


def test_figures_are_compared_on_the_seeds_that_both_have():
    rows = [("a", 0, 10.0), ("a", 1, 30.0), ("b", 0, 11.0)]
    made = [("mine", "x", "sun", "", m, 4, s, "mae_deg", e) for m, s, e in rows]
    found = figures.Figures(*map(np.array, zip(*made, strict=True)))
    pair = found.compare("a", "b")
    assert (pair.mean, pair.other, pair.lower) == (10, 11, 1)


def test_an_objects_seeds_weigh_as_one():
    """Objects whose images are no more than were asked for have no seeds."""
    rows = [("a", "x", 0, 1.0), ("a", "x", 1, 3.0), ("a", "y", -1, 8.0)]
    rows += [("b", "x", 0, 2.0), ("b", "x", 1, 2.0), ("b", "y", -1, 6.0)]
    made = [("mine", o, "sun", "", m, 4, s, "mae_deg", e) for m, o, s, e in rows]
    found = figures.Figures(*map(np.array, zip(*made, strict=True)))
    pair = found.compare("a", "b")
    assert (pair.objects, pair.mean, pair.other) == (2, 5, 4)


def test_a_number_that_is_all_images_has_one_row(tmp_path):
    root = data.make_folder(tmp_path / "sets")
    named = ["--benchmark", "folder", "--root", str(root), "--workdir", str(tmp_path)]
    chosen = ["-m", "constant", "--num-images", "5", "all", "--no-pictures"]
    assert evaluation.main([*named, *chosen]) == 0
    errors = unips_jax.load_results(tmp_path).pick(measure="mae_deg")
    assert sorted(errors.object) == ["cup", "shoe"]


def test_seeds_that_draw_the_same_are_computed_once(work):
    drawn = {tuple(choose_images(3, 4, seed=seed)) for seed in (0, 1, 2)}
    assert len(drawn) == 2  # of three of four images, two seeds drew the same
    stored = list((work / "results").rglob("*.json"))
    assert len(stored) == 9 * 2 * (len(drawn) + 1)


def test_what_is_no_work_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected what `unips eval --workdir"):
        unips_jax.load_results(tmp_path)
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "figures.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="expected the columns benchmark, object"):
        unips_jax.load_results(tmp_path)


@pytest.mark.parametrize("damaged", ["a,b,,,unips,4,-1,mae_deg,1", "a,b,,,unips,4"])
@pytest.mark.parametrize("cut", [",", ",x", ",1,1"])
def test_damaged_figures_are_refused(tmp_path, damaged, cut):
    (tmp_path / "tables").mkdir()
    rows = [",".join(figures.COLUMNS), "a,b,,,unips,4,-1,mae_deg,1.5", damaged + cut]
    (tmp_path / "tables" / "figures.csv").write_text("\n".join(rows))
    with pytest.raises(InputError, match=r"figures\.csv: expected a value in each"):
        unips_jax.load_results(tmp_path)


def test_figures_as_a_data_frame(work):
    pytest.importorskip("pandas", reason="pandas is not installed")
    frame = unips_jax.load_results(work).frame()
    assert list(frame.columns) == list(figures.COLUMNS)


def test_every_object_and_interval_is_drawn_where_there_are_enough():
    errors = {("a", name, "sun", None, None): 10.0 + i for i, name in enumerate("xyz")}
    titles = [chart.title for chart in charts.charts(results_of(errors))]
    assert any("95 % interval" in title for title in titles)
    del errors["a", "z", "sun", None, None]
    titles = [chart.title for chart in charts.charts(results_of(errors))]
    assert not any("95 % interval" in title for title in titles)
