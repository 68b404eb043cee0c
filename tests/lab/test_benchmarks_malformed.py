"""Two hundred ways for a benchmark to be broken: one clear line each, nothing written.

Every case takes a whole miniature set, damages it in one way, and runs the evaluation
as a user would.
"""

import shutil

import evaluation_data as data
import pytest
from benchmark_damages import SETS, cases

from unips_jax.cli import evaluate as evaluation

CASES = list(cases())


@pytest.fixture(scope="module")
def whole_sets(tmp_path_factory):
    roots = {}
    for kind, (make, options, _) in SETS.items():
        roots[kind] = tmp_path_factory.mktemp(kind) / "data"
        make(roots[kind], **options)
    return roots


def run(kind, root, workdir):
    objects = SETS[kind][2]
    chosen = ["--objects", *objects] if objects else []
    return evaluation.main(
        [
            "--benchmark",
            kind,
            "--root",
            str(root),
            "--workdir",
            str(workdir),
            "--method",
            "constant",
            "--no-pictures",
            *chosen,
        ]
    )


@pytest.mark.parametrize("kind", SETS)
def test_whole_sets_pass(whole_sets, tmp_path, kind):
    assert run(kind, whole_sets[kind], tmp_path / "work") == 0


@pytest.mark.parametrize(
    ("kind", "name", "damage"),
    CASES,
    ids=[f"{kind}-{name.split('/')[-1]}-{d.__name__}" for kind, name, d in CASES],
)
def test_broken_sets_give_one_line(whole_sets, tmp_path, capfd, kind, name, damage):
    root = tmp_path / "data"
    shutil.copytree(whole_sets[kind], root)
    damage(root / name)
    before = data.snapshot(root)
    status = run(kind, root, tmp_path / "work")
    output = capfd.readouterr()
    assert status == 2, output
    assert output.err.startswith("error: ") and output.err.count("\n") == 1, output.err
    assert output.out == ""
    assert not (tmp_path / "work").exists()
    assert data.snapshot(root) == before
