"""The results page: written from its files, and what measuring puts into them."""

import json
import runpy
from pathlib import Path

import pytest

from unips_jax.errors import InputError
from unips_jax.weights import weights_record

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    return runpy.run_path(str(ROOT / "tools" / "results.py"))


@pytest.fixture
def readings(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    return runpy.run_path(str(ROOT / "tools" / "readings.py"))


def test_page_and_readme_regenerate_byte_for_byte(tool):
    shipped = weights_record("tiny")["hash"][:8]
    page, readme = ROOT / "docs" / "results.md", ROOT / "README.md"
    assert tool["page"](shipped) == page.read_bytes().decode()
    assert tool["readme"](shipped, readme.read_text()) == readme.read_bytes().decode()
    assert len(readme.read_text().splitlines()) <= 120


def test_measuring_replaces_what_is_named_and_says_what_is_left_out(
    tool, tmp_path, monkeypatch, capsys
):
    measure = tool["measure"]
    names = measure.__globals__
    kind = names["MEASUREMENTS"]["demo"]

    def fails(setting, line):
        raise InputError("no photographs")

    table = {"columns": ["", "8"], "rows": [["UniPS", 3.25]]}
    kinds = {
        "demo": kind._replace(read=lambda setting, line: table),
        "real": kind._replace(read=fails),
    }
    monkeypatch.setitem(names, "MEASUREMENTS", kinds)
    monkeypatch.setitem(names, "FOLDER", tmp_path)
    record = {"hash": "0123456789", "steps": {"easy": 2, "all": 40}}
    monkeypatch.setitem(names, "weights_record", lambda source: record)
    setting = names["Setting"]("tiny", {})
    path = tmp_path / "01234567.json"

    measure(["demo", "real"], setting)
    assert "left out real: no photographs" in capsys.readouterr().out
    figures = json.loads(path.read_text())
    assert (figures["hash"], figures["steps"]) == ("0123456789", 42)
    assert list(figures["measurements"]) == ["demo"]

    table["rows"][0][1] = 3.5
    figures["measurements"]["held-out"] = {"kept": True}
    path.write_text(json.dumps(figures))
    measure(["demo"], setting)
    after = json.loads(path.read_text())["measurements"]
    assert after["held-out"] == {"kept": True}
    assert after["demo"]["rows"] == [["UniPS", 3.5]]
    assert tool["figure"]({"measurements": after}, "demo", "UniPS", "8") == 3.5
    assert tool["figure"]({"measurements": after}, "demo", "UniPS", "4") is None


def test_weights_without_figures_are_named(tool):
    with pytest.raises(InputError, match=r"ffffffff\.json: expected the figures"):
        tool["page"]("ffffffff")


def test_unknown_measurements_are_refused(tool, capsys):
    assert tool["main"](["--measure", "demo", "dmeo"]) == 2
    assert "--measure dmeo: expected some of held-out" in capsys.readouterr().err


def test_commands_get_our_places(readings, tmp_path, monkeypatch):
    setting = readings["Setting"](
        "w.safetensors", {"out": tmp_path, "data": tmp_path / "none"}
    )
    placed = setting._placed
    assert placed("tiny") == "w.safetensors"
    assert placed("out/demo") == str(tmp_path / "demo")
    assert placed("--images") == "--images"
    with pytest.raises(InputError, match="data/x: expected data, found nothing"):
        placed("data/x")


def test_tables_of_evaluations_are_read_by_name(readings, tmp_path, monkeypatch):
    setting = readings["Setting"]("tiny", {"out": tmp_path})
    monkeypatch.setattr(type(setting), "run", lambda *_: "")
    lit = ["directional", "environment", "mixed", "Mean", "Median", "Objects"]
    summary = [
        ["unips tiny", 10, "this run", 1.234, 2.0, 3.0, 2.078, 9.0, "6 of 6"],
        ["unips fast", 10, "this run", 1.3, 2.1, 3.1, 2.17, 9.0, "6 of 6"],
        ["mpm:sign=oracle", 10, "this run", 4.0, 5.0, 6.0, 5.0, 9.0, "5 of 6"],
        ["sbl", 10, "this run", 2.0, None, None, 2.0, 9.0, "2 of 6"],
        ["constant", 10, "this run", 7.0, 7.0, 7.0, 7.0, 7.0, "6 of 6"],
        ["UniPS", 32, "published", 17.0, 14.5, 13.8, 15.1, None, None],
    ]
    categories = [
        ["metal", light, 2, 30.0, score, 40.0]
        for light, score in zip(lit[:3], (2.0, 4.0, 6.0), strict=True)
    ]
    objects = [["ball", 1.0, 2.0, 4.9, 4.1], ["mean", 1.5, 2.5, 5.0, 4.0]]
    tables = {
        "summary": (["Method", "Images", "Source", *lit], summary),
        "categories": (
            ["Category", "Lighting", "Objects", "sbl", "unips", "constant"],
            categories,
        ),
        "objects": (
            ["Object", "unips", "constant", "UniPS (published)", "PF14 (published)"],
            objects,
        ),
    }
    for folder in ("ps-wild-mini", "table8/evaluation", "diligent", "fast"):
        place = tmp_path / folder / "tables"
        place.mkdir(parents=True)
        named = {n: {"columns": c, "rows": r} for n, (c, r) in tables.items()}
        (place / "tables.json").write_text(json.dumps(named))

    mini = readings["ps_wild"](setting, "", name="ps-wild-mini")
    assert mini["columns"] == ["", "directional", "environment", "mixed", "mean"]
    assert mini["rows"][0] == ["UniPS", 1.23, 2.0, 3.0, 2.08]
    assert mini["rows"][-1] == ["material: metal", 2.0, 4.0, 6.0, 4.0]
    assert [row[0] for row in mini["rows"]].count("UniPS") == 1

    rows = {row[0]: row[1:] for row in readings["table8"](setting, "")["rows"]}
    assert rows["UniPS"] == [1.23, 2.0, 3.0, 2.08, "6 of 6", 15.1]
    assert rows["mpm †"] == [4.0, 5.0, 6.0, 5.0, "5 of 6", 31.37]
    assert rows["constant normal"][-1] is None
    # No mean where a lighting has no score: the others' are over all of them.
    assert rows["sbl"] == [2.0, None, None, None, "2 of 6", None]

    fast = readings["fast"](setting, "")
    assert fast["columns"] == ["", *lit[:3], "mean", "sets"]
    assert fast["rows"][1] == ["UniPS with `--fast`", 1.3, 2.1, 3.1, 2.17, "6 of 6"]

    assert readings["diligent"](setting, "") == {
        "columns": ["", "ball", "mean"],
        "rows": [
            ["UniPS", 1.0, 1.5],
            ["constant normal", 2.0, 2.5],
            ["the paper's UniPS", 4.9, 5.0],
        ],
    }


def test_scores_of_scenes_are_read_by_number_of_images(readings, monkeypatch):
    setting = readings["Setting"]("tiny", {})
    lines = [
        {"images": n, "camera/perspective": 3.0 / n, "constant": 40.0, "mae": 8.0 / n}
        for n in (1, 4)
    ]
    printed = "\n".join(map(json.dumps, lines))
    monkeypatch.setattr(type(setting), "run", lambda *_: printed)
    assert readings["validate"](setting, "") == {
        "columns": ["", "1", "4"],
        "rows": [
            ["UniPS", 8.0, 2.0],
            ["constant normal", 40.0, 40.0],
            ["camera: perspective", 3.0, 0.75],
        ],
    }


def test_the_yardstick_is_averaged_over_objects(readings, monkeypatch):
    setting = readings["Setting"]("tiny", {})
    found = {
        "diligent, 10 images": {
            "ball": {"w": 5.0, "c": 45.0},
            "cow": {"w": 8.0, "c": 35.0},
        }
    }
    monkeypatch.setattr(type(setting), "run", lambda *_: json.dumps(found))
    assert readings["real"](setting, "")["rows"] == [
        ["diligent, 10 images", 2, 6.5, 40.0]
    ]


def test_gains_by_known_lights_are_read_by_data(readings, tmp_path, monkeypatch):
    setting = readings["Setting"]("tiny", {"out": tmp_path})
    ran = []
    monkeypatch.setattr(type(setting), "run", lambda _, part: ran.append(part))
    columns = ["Method", "Images", "Source", "Mean", "Objects"]
    scores = {"unips lights": 5.7, "unips": 6.0, "unips lights 20": 5.9, "constant": 31}
    rows = [[name, 10, "this run", x, "24 of 24"] for name, x in scores.items()]
    rows.append(["PF14", 96, "published", 8.4, None])
    for name in ("reliefs", "DiLiGenT"):
        place = tmp_path / "known" / name / "tables"
        place.mkdir(parents=True)
        tables = {"summary": {"columns": columns, "rows": rows}}
        (place / "tables.json").write_text(json.dumps(tables))
    line = "unips eval --workdir out/known/reliefs -m a && unips eval --workdir "
    assert readings["known_lights"](setting, f"{line}out/known/DiLiGenT") == {
        "columns": ["", "none", "20 degrees off", "exact", "constant normal", "sets"],
        "rows": [
            [name, 6.0, 5.9, 5.7, 31, "24 of 24"] for name in ("reliefs", "DiLiGenT")
        ],
    }
    assert len(ran) == 2


def test_a_command_is_run_once(readings, tmp_path, monkeypatch):
    monkeypatch.setattr(readings["sys"], "executable", "echo")
    setting = readings["Setting"]("tiny", {"out": tmp_path})
    assert setting.run("python a.py") == "a.py\n"
    monkeypatch.setattr(readings["sys"], "executable", "false")
    assert setting.run("python a.py") == "a.py\n"
    with pytest.raises(InputError, match=r"python b\.py: failed with status 1"):
        setting.run("python b.py")


def test_maps_are_read_by_source_and_kind(readings, monkeypatch):
    setting = readings["Setting"]("tiny", {})
    found = {
        "scenes": {"all": {"objects": {"a": 9, "network": 2}, "network": 3.0}},
        "set": {"all": {"objects": {"depth": 1}, "depth": 5.0}},
        "dome": {"all": {"objects": {"constant": 4}, "constant": 40.0}},
    }
    monkeypatch.setattr(type(setting), "run", lambda *_: json.dumps(found))
    assert readings["maps"](setting, "", UniPS="network", a_floor="constant") == {
        "columns": ["", "objects", "UniPS", "a floor"],
        "rows": [
            ["scenes: all", "2 / 0", 3.0, None],
            ["dome: all", "0 / 4", None, 40.0],
        ],
    }


def test_objects_are_those_that_have_the_figure():
    means = runpy.run_path(str(ROOT / "tools" / "maps.py"))["_means"]
    assert means([{"network": 2.0, "psnr": 3.0}, {"psnr": 4.0}]) == {
        "objects": {"network": 1, "psnr": 2},
        "network": 2.0,
        "psnr": 3.5,
    }


def test_what_confidence_is_worth_is_read_by_source(readings, monkeypatch):
    setting = readings["Setting"]("tiny", {})
    all_objects = {
        "kept": [1.0, 0.5],
        "error left": [8.0, 4.0],
        "least possible": [8.0, 2.0],
        "spread, error, share": [["0-1", 3.0, 0.25], ["1-180", None, 0.0]],
    }
    found = {"set": {"ball": {}, "all": all_objects}}
    monkeypatch.setattr(type(setting), "run", lambda *_: json.dumps(found))
    assert readings["kept"](setting, "") == {
        "columns": ["", "100%", "50%"],
        "rows": [["set", 8.0, 4.0], ["set: least possible", 8.0, 2.0]],
    }
    assert readings["by_spread"](setting, "") == {
        "columns": ["", "0-1", "1-180"],
        "rows": [
            ["set: mean error", 3.0, None],
            ["set: of the pixels", "25%", "0%"],
        ],
    }


def test_seconds_are_tables_of_their_file(tool, tmp_path, monkeypatch):
    table = tool["seconds_table"]
    monkeypatch.setitem(table.__globals__, "FOLDER", tmp_path)
    assert table() == ""
    run = {"cpu": 20.04, "wall": 12.0, "gb": 1.26}
    found = {
        "hash": "0123456789abcdef",
        "date": "2026-11-28",
        "processor": "a processor, 2 cores",
        "jax": "0.10.2",
        "rows": [{"what": "`unips demo`", "cold": run, "warm": run | {"cpu": 9.0}}],
        "growth": {"images": [[2, 0.5], [4, 1.0]], "side": [[64, 0.25]]},
    }
    (tmp_path / "seconds.json").write_text(json.dumps(found))
    lines = table().splitlines()
    assert "| `unips demo` | 20.0 | 12.0 | 9.0 | 12.0 | 1.3 |" in lines
    assert "| images of 128 x 128 | 2 | 4 |" in lines
    made = "weights 01234567, a processor, 2 cores, jax 0.10.2, 2026-11-28."
    assert lines[-1].endswith(made)
