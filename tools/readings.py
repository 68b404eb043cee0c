"""Runs commands that measure, and reads tables from what they print and write."""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.errors import InputError
from unips_jax.evaluation.published import PUBLISHED, mean

ROOT = Path(__file__).resolve().parents[1]
Table = dict[str, Any]  # columns and rows

# The paper's methods, by the names that ours have in tables.
_PAPERS = {
    "UniPS": "UniPS",
    "gcnet": "GCNet",
    "mpm †": "MPM",
    "variational": "Variational",
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """Where to measure.

    Attributes:
        weights: shipped name or file.
        places: files and folders by the names that commands call them; what is made is
            in "out".
        printed: by commands that were run.
    """

    weights: str
    places: Mapping[str, Path]
    printed: dict[str, str] = dataclasses.field(default_factory=dict)

    def run(self, line: str) -> str:
        """Runs a command, with our places for its names; returns what it prints.

        A command is run once.

        Raises:
            InputError: if it fails, or data that it needs are not there.
        """
        if line in self.printed:
            return self.printed[line]
        program, *words = line.split()
        module = ["-m", "unips_jax"] if program == "unips" else []
        run = subprocess.run(
            [sys.executable, *module, *map(self._placed, words)],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            text=True,
        )
        if run.returncode:
            raise InputError(f"{line}: failed with status {run.returncode}")
        self.printed[line] = run.stdout
        return run.stdout

    def at(self, word: str) -> Path:
        """The file or folder behind a command's word, such as `out/demo`."""
        name, _, rest = word.partition("/")
        return self.places[name] / rest

    def _placed(self, word: str) -> str:
        if word == "tiny":
            return self.weights
        name = word.partition("/")[0]
        if name not in self.places:
            return word
        if name != "out" and not self.at(word).exists():
            raise InputError(f"{word}: expected data, found nothing at {self.at(word)}")
        return str(self.at(word))

    def tables(self, word: str) -> dict[str, Table]:
        """The tables that an evaluation wrote into its work folder."""
        return json.loads((self.at(word) / "tables" / "tables.json").read_text())


def validate(setting: Setting, line: str) -> Table:
    """Scores of all scenes and by group, a column per number of images."""
    scores = [json.loads(text) for text in setting.run(line).splitlines()]
    groups = [name for name in scores[0] if "/" in name]
    names = {"mae": "UniPS", "constant": "constant normal"}
    names |= {group: group.replace("/", ": ") for group in groups}
    return {
        "columns": ["", *(str(found["images"]) for found in scores)],
        "rows": [
            [shown, *(found[name] for found in scores)] for name, shown in names.items()
        ],
    }


def demo(setting: Setting, line: str) -> Table:
    """The bundled object's error and the constant normal's."""
    setting.run(line)
    record = json.loads((setting.at("out/demo") / "normals.json").read_text())
    return {
        "columns": ["", "8"],
        "rows": [
            ["UniPS", round(record["mae_deg"], 2)],
            ["constant normal", round(record["constant_mae_deg"], 2)],
        ],
    }


def _name(label: str) -> str:
    """A method's name in our tables."""
    if label == "unips fast":
        return "UniPS with `--fast`"
    name = label.partition(":")[0].partition(" ")[0]
    if "†" in label or "sign=oracle" in label:
        return f"{name} †"
    return {"unips": "UniPS", "constant": "constant normal"}.get(name, name)


def _rounded(cells: Sequence[Any]) -> list[Any]:
    return [round(x, 2) if isinstance(x, float) else x for x in cells]


def _own(table: Table) -> list[list[Any]]:
    """The rows of an evaluation's summary that are no published ones."""
    place = table["columns"].index("Source")
    return [row for row in table["rows"] if row[place] == "this run"]


def _by_lighting(table: Table) -> Table:
    """Methods by lighting, from an evaluation's summary, with the mean of what has all.

    A mean over other sets would say nothing beside those of the other methods.
    """
    columns = table["columns"]
    shown = [c for c in columns if c in ("directional", "environment", "mixed", "Mean")]
    rows = []
    for row in _own(table):
        found = {c: row[columns.index(c)] for c in shown}
        if "Mean" in found and None in found.values():
            found["Mean"] = None
        rows.append([_name(row[0]), *_rounded(list(found.values()))])
    return {"columns": ["", *(c.lower() for c in shown)], "rows": rows}


def ps_wild(setting: Setting, line: str, *, name: str) -> Table:
    """Methods by lighting, and UniPS by category."""
    setting.run(line)
    tables = setting.tables(f"out/{name}")
    found, categories = _by_lighting(tables["summary"]), tables["categories"]
    place = [_name(label) for label in categories["columns"]].index("UniPS")
    scores = {tuple(row[:2]): row[place] for row in categories["rows"]}
    lightings = [c for c in found["columns"][1:] if c != "mean"]
    for category in dict.fromkeys(row[0] for row in categories["rows"]):
        cells = [scores[category, lighting] for lighting in lightings]
        row = _rounded([*cells, sum(cells) / len(cells)])
        found["rows"].append([f"material: {category}", *row])
    return found


def fast(setting: Setting, line: str) -> Table:
    """Methods by lighting, on how many sets."""
    setting.run(line)
    summary = setting.tables("out/fast")["summary"]
    found = _by_lighting(summary)
    rows = [
        [*row, own[-1]] for row, own in zip(found["rows"], _own(summary), strict=True)
    ]
    return {"columns": [*found["columns"], "sets"], "rows": rows}


def known_lights(setting: Setting, line: str) -> Table:
    """Means by data, without lights, with rough ones and with exact ones, and sets."""
    names = {
        "unips": "none",
        "unips lights 20": "20 degrees off",
        "unips lights": "exact",
        "constant": "constant normal",
    }
    rows = []
    for part in line.split(" && "):
        setting.run(part)
        word = part.partition("--workdir ")[2].partition(" ")[0]
        table = setting.tables(word)["summary"]
        column = table["columns"].index("Mean")
        found = {names[row[0]]: row for row in _own(table)}
        cells = _rounded([found[name][column] for name in names.values()])
        rows.append([word.rpartition("/")[2], *cells, found["exact"][-1]])
    return {"columns": ["", *names.values(), "sets"], "rows": rows}


def table8(setting: Setting, line: str) -> Table:
    """Methods by lighting, on how many sets, and the paper's means."""
    setting.run(line)
    summary = setting.tables("out/table8/evaluation")["summary"]
    found = _by_lighting(summary)
    papers = {row.method: mean(row) for row in PUBLISHED["ps-wild"][:4]}
    scored = {_name(row[0]): row[-1] for row in _own(summary)}
    rows = [
        [*row, scored[row[0]], _rounded([papers.get(_PAPERS.get(row[0], ""))])[0]]
        for row in found["rows"]
    ]
    return {"columns": [*found["columns"], "sets", "paper's mean"], "rows": rows}


def diligent(setting: Setting, line: str) -> Table:
    """Methods by object, with their mean."""
    setting.run(line)
    table = setting.tables("out/diligent")["objects"]
    rows = []
    for i, label in enumerate(table["columns"]):
        published = label == "UniPS (published)"
        if i and (published or "(published)" not in label):
            name = "the paper's UniPS" if published else _name(label)
            rows.append([name, *_rounded([row[i] for row in table["rows"]])])
    return {"columns": ["", *(row[0] for row in table["rows"])], "rows": rows}


def real(setting: Setting, line: str) -> Table:
    """The means of the yardstick's sets, the network's and the constant normal's."""
    found = json.loads(setting.run(line))
    rows = []
    for name, objects in found.items():
        errors = np.array([list(methods.values()) for methods in objects.values()])
        rows.append([name, len(objects), *_rounded(errors.mean(axis=0).tolist())])
    return {"columns": ["", "objects", "UniPS", "constant normal"], "rows": rows}


def maps(setting: Setting, line: str, **names: str) -> Table:
    """Sources and kinds of objects by what is measured, where it is.

    "objects" are those of the figures: one number, or several in the order of figures.

    Args:
        setting: where to measure.
        line: the command.
        **names: of figures in what it prints, by those in the table.
    """
    rows = []
    for source, kinds in json.loads(setting.run(line)).items():
        for kind, figures in kinds.items():
            cells = [figures.get(name) for name in names.values()]
            if any(cell is not None for cell in cells):
                counts = [figures["objects"].get(name, 0) for name in names.values()]
                objects = " / ".join(map(str, dict.fromkeys(counts)))
                rows.append([f"{source}: {kind}", objects, *cells])
    columns = (name.replace("_", " ") for name in names)
    return {"columns": ["", "objects", *columns], "rows": rows}


def kept(setting: Setting, line: str) -> Table:
    """The error that is left, by the share of pixels kept."""
    rows, columns = [], [""]
    for source, kinds in json.loads(setting.run(line)).items():
        figures = kinds["all"]
        rows.append([source, *figures["error left"]])
        rows.append([f"{source}: least possible", *figures["least possible"]])
        columns = ["", *(f"{share:.0%}" for share in figures["kept"])]
    return {"columns": columns, "rows": rows}


def by_spread(setting: Setting, line: str) -> Table:
    """The mean error, and the share of the pixels, by spread."""
    rows, columns = [], [""]
    for source, kinds in json.loads(setting.run(line)).items():
        spreads, errors, shares = zip(
            *kinds["all"]["spread, error, share"], strict=True
        )
        rows.append([f"{source}: mean error", *errors])
        rows.append([f"{source}: of the pixels", *(f"{x:.0%}" for x in shares)])
        columns = ["", *spreads]
    return {"columns": columns, "rows": rows}
