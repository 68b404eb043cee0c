"""What `tools/results.py` can measure: each figure's command, and how it is read."""

import dataclasses
import functools
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
    """

    weights: str
    places: Mapping[str, Path]

    def run(self, line: str) -> str:
        """Runs a command, with our places for its names; returns what it prints.

        Raises:
            InputError: if it fails, or data that it needs are not there.
        """
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


def _validate(setting: Setting, line: str) -> Table:
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


def _demo(setting: Setting, line: str) -> Table:
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
    name = label.partition(":")[0].partition(" ")[0]
    if "†" in label or "sign=oracle" in label:
        return f"{name} †"
    names = {"unips": "UniPS", "constant": "constant normal", "gcnet-small": "gcnet"}
    return names.get(name, name)


def _rounded(cells: Sequence[Any]) -> list[Any]:
    return [round(x, 2) if isinstance(x, float) else x for x in cells]


def _own(table: Table) -> list[list[Any]]:
    """The rows of an evaluation's summary that are no published ones."""
    place = table["columns"].index("Source")
    return [row for row in table["rows"] if row[place] == "this run"]


def _by_lighting(table: Table) -> Table:
    """Methods by lighting, from an evaluation's summary, with their mean."""
    columns = table["columns"]
    shown = [c for c in columns if c in ("directional", "environment", "mixed", "Mean")]
    rows = [
        [_name(row[0]), *_rounded([row[columns.index(c)] for c in shown])]
        for row in _own(table)
    ]
    return {"columns": ["", *(c.lower() for c in shown)], "rows": rows}


def _ps_wild(setting: Setting, line: str, *, name: str) -> Table:
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


def _table8(setting: Setting, line: str) -> Table:
    """Methods by lighting, on how many sets, and the paper's means beside them."""
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


def _diligent(setting: Setting, line: str) -> Table:
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


def _real(setting: Setting, line: str) -> Table:
    """The means of the yardstick's sets, the network's beside the constant normal's."""
    found = json.loads(setting.run(line))
    rows = []
    for name, objects in found.items():
        errors = np.array([list(methods.values()) for methods in objects.values()])
        rows.append([name, len(objects), *_rounded(errors.mean(axis=0).tolist())])
    return {"columns": ["", "objects", "UniPS", "constant normal"], "rows": rows}


class Measurement(NamedTuple):
    """A measurement.

    Attributes:
        title: one line.
        about: what the data are.
        line: the command.
        read: runs it and reads what came out.
    """

    title: str
    about: str
    line: str
    read: Callable[[Setting, str], Table]


MEASUREMENTS = {
    "held-out": Measurement(
        "Held-out scenes, by number of images",
        "256 scenes of the generator that trains, from keys that training never uses, "
        "128 x 128 pixels; a column per number of images.",
        "unips validate --weights tiny --scenes 256 --images 1 2 4 8 --json",
        _validate,
    ),
    "more-images": Measurement(
        "More images",
        "The first 24 of these scenes.",
        "unips validate --weights tiny --scenes 24 --images 8 16 32 --json",
        _validate,
    ),
    "uniform": Measurement(
        "Uniform material under directional light",
        "64 such scenes, 8 images.",
        "unips validate --weights tiny --scenes 64 --images 8 --light directional "
        "--material uniform --json",
        _validate,
    ),
    "demo": Measurement(
        "The bundled object",
        "Rendered with Blender Cycles, 8 images of 192 x 192.",
        "unips demo --weights tiny -o out/demo",
        _demo,
    ),
    "ps-wild-mini": Measurement(
        "ps-wild-mini",
        "Twelve objects under three lightings, rendered with Blender Cycles, 10 images "
        "each (`unips render --engine cycles --preset ps-wild-mini -o ps-wild-mini`): "
        "shapes, materials and environments are made by other code than the training "
        "scenes'. `sbl`, sparse Bayesian, is told the lights.",
        "unips eval --benchmark ps-wild --root ps-wild-mini --workdir out/ps-wild-mini "
        "--weights tiny -m unips sbl",
        functools.partial(_ps_wild, name="ps-wild-mini"),
    ),
    "ps-wild-real": Measurement(
        "ps-wild-real",
        "Ten meshes by others in Blender's photographed environments, under three "
        "lightings, rendered with Blender Cycles, 10 images each (`unips render "
        "--engine cycles --preset ps-wild-real --meshes assets/meshes -o "
        "ps-wild-real`): training sees neither. `sbl` is told the lights.",
        "unips eval --benchmark ps-wild --root ps-wild-real --workdir out/ps-wild-real "
        "--weights tiny -m unips sbl",
        functools.partial(_ps_wild, name="ps-wild-real"),
    ),
    "table8": Measurement(
        "The paper's Table 8, on our scenes",
        "6 objects under three lightings, 10 images of 256 x 256. The paper's means "
        "are of other data and, for UniPS, other weights. `least-squares` and `sbl` "
        "are told the lights; `gcnet` has half the width and our weights, `mpm` is our "
        "reconstruction; †: the truth chose the signs.",
        "python tools/table8.py out/table8 --weights tiny",
        _table8,
    ),
    "diligent": Measurement(
        "Real photographs: four objects of DiLiGenT",
        "10 images, drawn from every third of the benchmark's 96; published scores are "
        "of all 96. `woodham`, least squares, is told the lights.",
        "unips eval --benchmark diligent --root shared/diligent_dev --objects ball cow "
        "pot1 reading --num-images 10 --workdir out/diligent --weights tiny -m unips "
        "woodham",
        _diligent,
    ),
    "real": Measurement(
        "Photographs, and masks that miss the object",
        "DiLiGenT's objects with 10 images and with all that are there; PSBox's cat "
        "under known lamps, against least squares with these lamps, since there is no "
        "scanned truth; spheres and DiLiGenT's objects under masks that are some "
        "pixels too small or too large, scored well inside.",
        "unips validate --real --photographs shared --weights tiny --json",
        _real,
    ),
}
