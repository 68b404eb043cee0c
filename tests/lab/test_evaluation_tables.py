"""The tables' figures, worked out by hand."""

import csv

from unips_jax.evaluation import runner, summary
from unips_jax.evaluation.results import Results
from unips_jax.evaluation.scores import Score
from unips_jax.evaluation.tables import figures_csv


def score_of(mae, median, *view):
    """A score whose pixels lie in the first two bins: counts, then sums of errors."""
    counts, sums = (*view[:2], 0, 0, 0, 0), (*view[2:], 0.0, 0.0, 0.0, 0.0)
    shares = (mae, 2 * mae, 3 * mae, 4 * mae)
    return Score(sum(counts), mae, median, shares, (), counts, sums, 0, int(mae == 9))


def result(entry, lighting, label, count, score, **rest):
    tags = {"object": entry, "lighting": lighting, "category": entry[:1]}
    given = {"measures": {}, "unsupported": "", **rest}
    return runner.Result(
        entry,
        tags,
        (),
        label,
        count,
        2,
        score,
        **given,
        name=f"{entry}-{label}-{count}",
    )


def test_tables_by_hand():
    """Three objects, the last under another light and without a truth."""
    results = Results(
        "mine",
        "native",
        {"a": "first", "b": "second"},
        (2, None),
        [
            result("x1", "sun", "a", 2, score_of(50, 5, 1, 0, 50, 0)),
            result("x2", "sun", "a", 2, score_of(70, 5, 1, 0, 70, 0)),
            result("y", "sky", "a", 2, None),
            result(
                "x1",
                "sun",
                "a",
                None,
                score_of(10, 6, 10, 30, 60, 340),
                measures={"light": 3.0},
            ),
            result("x2", "sun", "a", None, score_of(20, 8, 40, 0, 800, 0)),
            result("y", "sky", "a", None, score_of(9, 1, 0, 1, 0, 9)),
            result("x1", "sun", "b", None, score_of(4, 3, 10, 30, 40, 120)),
            result("x2", "sun", "b", None, None, unsupported="too dark"),
            result("y", "sky", "b", None, None),
        ],
    )
    tables = {table.name: table for table in summary.tables(results)}
    assert tables["summary"].names == [
        "Method",
        "Images",
        "Source",
        "sun",
        "sky",
        "Mean",
        "Median",
        "% < 5",
        "% < 11.25",
        "% < 22.5",
        "% < 30",
        "Objects",
    ]
    assert tables["summary"].values == [
        ["a", "all", "this run", 15, 9, 13, 5, 13, 26, 39, 52, "3 of 3"],
        ["b", "all", "this run", 4, None, 4, 3, 4, 8, 12, 16, "1 of 3"],
    ]
    assert tables["images"].values[:2] == [
        ["a", 2, "this run", 60, None, 60],
        ["a", "all", "this run", 15, 9, 13],
    ]
    assert tables["objects"].values == [
        ["x1", "sun", "x", 10, 4],
        ["x2", "sun", "x", 20, "unsupported"],
        ["y", "sky", "y", 9, "truth withheld"],
        ["mean", None, None, 13, 4],
    ]
    assert tables["categories"].values == [
        ["x", "sun", 2, 15, 4],
        ["y", "sky", 1, 9, None],
    ]
    # Over pixels, not objects, and only of x1, which both have: 10 and 30 pixels.
    assert tables["angles"].names == ["Angle", "Pixels", "a", "b"]
    assert tables["angles"].values == [
        ["0-15", 10, 60 / 10, 40 / 10],
        ["15-30", 30, 340 / 30, 120 / 30],
    ]
    assert "over the pixels of 1 object," in tables["angles"].title
    assert tables["measures"].values == [["a", "light", 3, None, 3]]
    assert tables["methods"].values == [["a", "first"], ["b", "second"]]
    assert tables["remarks"].values == [
        ["y", "a", "1 pixels without an estimate count as 90 degrees"],
        ["x2", "b", "too dark"],
    ]


def test_the_last_angles_are_all_above():
    counts, sums = (0, 0, 0, 0, 2, 5), (0, 0, 0, 0, 8.0, 50.0)
    score = Score(7, 50.0, 5.0, (1.0, 2.0, 3.0, 4.0), (), counts, sums, 0, 0)
    entries = [result("x", "sun", "a", None, score)]
    results = Results("mine", "native", {"a": ""}, (None,), entries)
    (angles,) = (t for t in summary.tables(results) if t.name == "angles")
    assert angles.values == [["60-75", 2, 4], ["75 and more", 5, 10]]


def test_the_best_are_the_lowest_error_and_the_largest_share():
    """Among the methods that have all objects."""
    made = [
        result(name, "sun", label, None, mae and score_of(mae, mae, 1, 0, mae, 0))
        for label, errors in (("a", (10, 12)), ("b", (4, 5)), ("c", (1, None)))
        for name, mae in zip("xy", errors, strict=True)
    ]
    methods = dict.fromkeys("abc", "a method")
    results = Results("mine", "native", methods, (None,), made)
    table = next(t for t in summary.tables(results) if t.name == "summary")
    best = {
        row.cells[0].value: [
            name for name, cell in zip(table.names, row.cells, strict=True) if cell.best
        ]
        for row in table.rows
    }
    shares = [name for name in table.names if name.startswith("%")]
    assert best == {"a": shares, "b": ["sun", "Mean", "Median"], "c": []}


def test_every_figure_has_its_name():
    counts, sums = (2, 0, 5, 0, 0, 0), (8.0, 0, 50.0, 0, 0, 0)
    score = Score(7, 50.0, 5.0, (1.0, 2.0, 3.0, 4.0), (), counts, sums, 6, 9)
    entries = [result("x", "sun", "a", None, score)]
    results = Results("mine", "native", {"a": ""}, (None,), entries)
    _, *rows = csv.reader(figures_csv(results).decode().splitlines())
    assert {row[-2]: float(row[-1]) for row in rows} == {
        "mae_deg": 50,
        "median_deg": 5,
        "below_5_deg_percent": 1,
        "below_11.25_deg_percent": 2,
        "below_22.5_deg_percent": 3,
        "below_30_deg_percent": 4,
        "mae_seen_from_0_deg": 4,
        "mae_seen_from_30_deg": 10,
        "pixels": 7,
        "pixels_without_truth": 6,
        "pixels_without_estimate": 9,
    }
