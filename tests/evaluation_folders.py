"""Folders of photographs, evaluated: the command, and what it writes."""

import json

import evaluation_data as data
import numpy as np

from unips_jax.cli import evaluate as evaluation


def truth(index):
    return data.sphere(20, 20 + index)[1].astype(np.float32)


def run(root, work, *rest):
    named = ["--benchmark", "folder", "--root", str(root), "--workdir", str(work)]
    return evaluation.main([*named, "--no-pictures", *rest])


def tables_of(work):
    return json.loads((work / "tables" / "tables.json").read_text())


def errors_of(work):
    rows = tables_of(work)["summary"]["rows"]
    return {row[0]: row[3] for row in rows if row[2] == "this run"}
