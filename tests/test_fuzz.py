"""Malformed input to every command: one line of error, no traceback, nothing left."""

import contextlib
import io
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from unips_jax import weights
from unips_jax.cli import evaluate as evaluation
from unips_jax.cli import main as cli
from unips_jax.cli import surface
from unips_jax.estimation import streaming, writing
from unips_jax.scenes import folders as scene_folders
from unips_jax.training import loop, validation


def _make(root, files):
    folder = root / "in" / "object.data"
    folder.mkdir(parents=True)
    (root / "loop").symlink_to("loop")
    for name, (kind, data) in files.items():
        path = folder / name
        if kind == "loop":
            path.symlink_to(name)
        elif kind == "broken":
            path.symlink_to("nowhere")
        elif kind == "folder":
            path.mkdir()
        elif kind == "pipe":
            os.mkfifo(path)
        else:
            path.write_bytes(data)


def _stand_in(network, images, mask, **options):
    normals = np.float32([0, 0, 1]) * np.asarray(mask)[..., None]
    return streaming.NormalsAndLights(normals, None)


class _Reached(Exception):
    """The arguments were good, and the work would begin."""


def _reached(*arguments, **options):
    raise _Reached


@pytest.fixture(scope="module", autouse=True)
def no_work():
    """Leaves out what takes long and is not reached by what is malformed."""
    load = weights.load_weights
    tiny = load("tiny")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(
            weights, "load_weights", lambda x: tiny if x == "tiny" else load(x)
        )
        patched.setattr(evaluation, "_evaluate", _reached)
        patched.setattr(surface, "write_surface", _reached)
        patched.setattr(streaming, "estimate_with_lights", _stand_in)
        patched.setattr(writing, "write_sheet", lambda file, *_, **__: None)
        patched.setattr(scene_folders, "render_folders", _reached)
        patched.setattr(scene_folders, "render_sheet", _reached)
        patched.setattr(loop, "train", _reached)
        patched.setattr(validation, "validate", _reached)
        yield


def check(case):
    files, arguments = case
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        _make(root, files)
        os.chdir(root)
        said, errors = io.StringIO(), io.StringIO()
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(errors):
                status = cli.main(arguments)
        except SystemExit as end:  # options that tyro refuses, or help
            status = end.code
        except _Reached:
            status = 0
        finally:
            os.chdir(here)
        assert status in (0, 2)
        if status == 2:
            assert "Traceback" not in errors.getvalue()
            assert errors.getvalue().strip(), "no reason given"
            left = [p.name for p in root.iterdir() if p.name not in ("in", "loop")]
            assert left in ([], ["out"]) and not any(_files(root / "out"))
            folder = root / "in" / "object.data"
            assert {p.name for p in folder.iterdir()} == set(files)


def _files(folder):
    return [p for p in folder.rglob("*") if p.is_file() and p.parent.name != ".locks"]


def test_malformed_input_is_an_error_of_one_line():
    from malformed_cases import run_cases

    run_cases(check, max_examples=60, derandomize=True)


@pytest.mark.slow
def test_a_thousand_malformed_inputs():
    from malformed_cases import run_cases

    run_cases(check, max_examples=1000)
