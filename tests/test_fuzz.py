"""Malformed input to every command: one line of error, no traceback, nothing left."""

import contextlib
import io
import os
import tempfile
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from unips_jax import weights
from unips_jax.cli import evaluate as evaluation
from unips_jax.cli import main as cli
from unips_jax.cli import surface
from unips_jax.estimation import streaming, writing
from unips_jax.scenes import folders as scene_folders
from unips_jax.training import loop, validation

CONFIG = "from unips_jax.training.config import *\ndef get_config(): return Config()\n"


def _examples():
    """Contents of small files of every kind, by suffix."""
    picture = np.arange(12 * 10 * 3, dtype=np.uint8).reshape(12, 10, 3)
    found = {}
    for suffix in (".png", ".jpg", ".tif", ".bmp", ".webp", ".pgm", ".hdr"):
        pixels = picture[..., 0] if suffix == ".pgm" else picture
        pixels = pixels.astype(np.float32) if suffix == ".hdr" else pixels
        found[suffix] = cv2.imencode(suffix, pixels)[1].tobytes()
    found["16.png"] = cv2.imencode(".png", picture.astype(np.uint16) * 99)[1].tobytes()
    with tempfile.TemporaryDirectory() as place:
        file = f"{place}/a.exr"
        OpenEXR.File({}, {"RGB": picture.astype(np.float32)}).write(file)
        found[".exr"] = Path(file).read_bytes()
    shipped = weights.weights_path("tiny").read_bytes()
    return [*found.values(), shipped[:5000], CONFIG.encode(), b'{"files": {}}']


EXAMPLES = _examples()


@st.composite
def contents(draw):
    """A file's bytes: none, any, or those of an example cut off or altered."""
    kind = draw(st.sampled_from(["whole", "cut", "altered", "any", "text"]))
    if kind == "any":
        return draw(st.binary(max_size=200))
    if kind == "text":
        return draw(st.text(max_size=100)).encode(errors="surrogatepass")
    data = draw(st.sampled_from(EXAMPLES))
    if kind == "cut":
        return data[: draw(st.integers(0, len(data)))]
    if kind == "altered":
        altered = bytearray(data)
        for _ in range(draw(st.integers(1, 8))):
            place = draw(st.integers(0, min(len(data) - 1, 400)))
            altered[place] = draw(st.integers(0, 255))
        return bytes(altered)
    return data


NAMES = st.sampled_from(
    ["L_0.png", "L_1.jpg", "02.tif", "a.exr", "b.webp", "c.pgm", "d.hdr", "x.gif"]
    + ["e.dng", "f.avif", "g.tga", "h.lp", "i.mp4"]
    + [
        "mask.png",
        "mask.jpg",
        "normal.tif",
        "e.heic",
        "-o.png",
        "\u7d75 \U0001f600.png",
    ]
    + ["n" * 240 + ".png", "meta.json", "normals.json", "w.safetensors", "config.py"]
)
KINDS = st.sampled_from(["file"] * 12 + ["loop", "broken", "folder", "pipe"])
FILES = st.dictionaries(NAMES, st.tuples(KINDS, contents()), max_size=6)
# Paths below a folder that holds "in/object.data", filled with the files.
PATHS = st.sampled_from(
    ["in/object.data", "in", "in/none", "in/object.data/L_0.png", ".", "out", "loop"]
    + ["in/object.data/mask.png", "in/object.data/w.safetensors", "tiny", "n" * 300]
    + ["in/object.data/02.tif", "in/object.data/i.mp4"]
    + ["in/object.data/config.py", "", "/dev/null", "/proc/x", "f.png"]
)
WORDS = st.one_of(
    PATHS,
    st.sampled_from(["-1", "0", "1", "3", "8", "1e3", "nan", "x", "all", "linear"]),
    st.text(max_size=8).filter(lambda word: "\0" not in word),  # nor can the system
)
OPTIONS = {
    "estimate": "--mask --max-images --seed --transfer --reader --size --weights "
    "--normal-map --exr --overwrite --dark --register",
    "check": "--mask --include --exclude --transfer --max-pixels --json",
    "demo": "--weights",
    "eval": "--benchmark --root --method --objects --num-images --crop-size --seed "
    "--protocol --weights --no-pictures",
    "render": "--objects --images --size --seed --sheet --engine --preset --meshes",
    "validate": "--scenes --images --size --light --weights --json",
    "surface": "--mask --photograph --focal --prior --scale --max-faces --mesh --cut "
    "--normal-map",
    "train": "--optim.learning-rate --data.root --train.steps --mesh.fsdp "
    "--init-weights",
}
# What makes a command whole, so that not all cases end at what is missing.
WHOLE = {
    "estimate": ["in/object.data", "-o", "out"],
    "check": ["in/object.data"],
    "demo": ["-o", "out"],
    "eval": ["--benchmark", "folder", "--root", "in", "--workdir", "out", "-m", "sh1"],
    "render": ["-o", "out"],
    "surface": ["in/object.data/L_0.png", "-o", "out"],
    "validate": [],
    "train": ["--config", "in/object.data/config.py", "--workdir", "out"],
}


@st.composite
def cases(draw):
    """The files of a folder, and a command's arguments."""
    name = draw(st.sampled_from(sorted(OPTIONS)))
    arguments = list(WHOLE[name])
    if arguments and draw(st.integers(0, 3)) == 0:
        place = draw(st.integers(0, len(arguments) - 1))
        arguments[place] = draw(WORDS)
    chosen = st.sampled_from([*OPTIONS[name].split(), "--none"])
    for option in draw(st.lists(chosen, max_size=3)):
        arguments += [option, *draw(st.lists(WORDS, max_size=2))]
    return draw(FILES), [name, *arguments]


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


CHECKS = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]


@given(cases())
@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=CHECKS,
)
def test_malformed_input_is_an_error_of_one_line(case):
    check(case)


@pytest.mark.slow
@given(cases())
@settings(max_examples=1000, deadline=None, database=None, suppress_health_check=CHECKS)
def test_a_thousand_malformed_inputs(case):
    check(case)
