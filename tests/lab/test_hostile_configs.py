"""A hundred configuration files with a mistake: one line with file and field."""

import os
import re

import pytest

from unips_jax.train import main
from unips_jax.training import loop

HEAD = (
    "import dataclasses\n"
    "from unips_jax.models.config import *\n"
    "from unips_jax.scenes.config import SceneConfig\n"
    "from unips_jax.training.config import *\n"
)
BIG, NAN, INF = "10**9", "float('nan')", "float('inf')"

# Part: field and value, as the file states them. The message names the field.
VALUES = {
    "DataConfig": [
        *[("batch_size", v) for v in ("0", "-3", "2.5", "'8'", "None", "True", BIG)],
        *[("image_size", v) for v in ("0", "-4", "6", "10**9", "'512'", NAN)],
        *[
            ("num_images", v)
            for v in ("()", "(0,)", "(3, -1)", "3", "(2.5,)", "(BIG,)")
        ],
        *[("num_images", v) for v in ("range(2, 11)", "'23'", "((3,),)")],
        *[("num_pixels", v) for v in ("0", BIG, INF, "[]")],
        *[("scene_share", v) for v in ("-0.1", "1.5", NAN, "'half'", "True")],
        *[("source", v) for v in ("'photographs'", "7", "None")],
        *[("frame", v) for v in ("'object'", "()")],
        *[("workers", v) for v in ("-1", BIG, "0.5")],
        *[("max_tokens", v) for v in ("-1", NAN)],
        *[("root", v) for v in ("7", "'/dev/null'", "'nowhere'", "'a\\0b'")],
    ],
    "OptimConfig": [
        *[("learning_rate", v) for v in ("0", "-1e-3", NAN, INF, "'1e-4'", "1e400")],
        *[("name", v) for v in ("'sgd'", "None")],
        *[("schedule", v) for v in ("'linear'", "Config")],
        *[("warmup_steps", v) for v in ("-1", "10**12", "1.5")],
        *[("b2", v) for v in ("1.0", "-0.1", NAN)],
        *[("ema_decay", v) for v in ("1", NAN)],
        *[("decay_every", v) for v in ("0", "10**30")],
        *[("decay_rate", v) for v in ("0.0", INF)],
        *[("weight_decay", v) for v in ("-1", INF)],
        *[("clip_norm", v) for v in ("-1", INF)],
    ],
    "TrainConfig": [
        *[("steps", v) for v in ("0", "-5", "2**31", "10**30", "1e5", "'all'", "True")],
        *[("seed", v) for v in ("-1", "2**32", "10**30", "0.5", "None")],
        *[("log_every", v) for v in ("0", "2**40")],
        *[("checkpoint_every", v) for v in ("0", "-1")],
        *[("keep", v) for v in ("0", "'2'")],
        *[("validation_scenes", v) for v in ("-1", BIG)],
        *[("steepness_weight", v) for v in (NAN, INF)],
    ],
    "MeshConfig": [("fsdp", "0"), ("fsdp", "64"), ("data", "-1"), ("data", BIG)],
    "SceneConfig": [
        *[
            ("light_weights", v)
            for v in ("()", "(1,) * 5 + (1,)", "(0,) * 5", "(-1,) * 5")
        ],
        *[("light_weights", v) for v in (f"({NAN},) * 5", "(1e308,) * 5", "1")],
        *[("perspective_rate", v) for v in ("2.0", NAN, "'often'")],
        *[
            ("focal_range_mm", v)
            for v in ("(50.0, 20.0)", "(0.0, 1.0)", f"(1.0, {INF})")
        ],
        *[("rotation_candidates", v) for v in ("0", BIG)],
        *[("num_directions", v) for v in ("7", BIG)],
        *[("mesh_rate", v) for v in ("0.5",)],
        *[("sensor", v) for v in ("1", "'no'")],
    ],
    "UniPSConfig": [
        *[("canonical_size", v) for v in ("0", "30", "10**6", "256.0")],
        *[("num_heads", v) for v in ("(3, 6, 12)", "(5, 6, 12, 24)", "(0,) * 4")],
        *[("depths", v) for v in ("()", f"({BIG},) * 4", "2")],
        *[("embed_dim", v) for v in ("-96", BIG)],
        ("embed_dim", "16384, num_heads=(1,) * 4"),
        *[("dtype", v) for v in ("'float16'", "'float64'")],
        *[("dropout_rate", v) for v in ("1.0", NAN)],
    ],
}
SCENES = "data=DataConfig(source='scenes'), "
PARTS = {
    "DataConfig": "data=",
    "OptimConfig": f"{SCENES}optim=",
    "TrainConfig": f"{SCENES}train=",
    "MeshConfig": f"{SCENES}mesh=",
    "SceneConfig": f"{SCENES}scenes=",
    "UniPSConfig": f"{SCENES}model=",
}
# Whole files, and what the line says.
FILES = {
    "empty": ("", "get_config"),
    "not text": ("\x00\x01", "null bytes|SyntaxError"),
    "not UTF-8": ("x = '\udcff'\n", "utf-8|codec"),
    "broken line": ("def get_config(:\n", "line 5: SyntaxError"),
    "broken indent": ("def get_config():\nreturn 3\n", "line 6: IndentationError"),
    "open bracket": ("x = (\n", "line 5: SyntaxError"),
    "no function": ("config = 3\n", "get_config"),
    "not a function": ("get_config = 7\n", "get_config"),
    "wants arguments": ("def get_config(x): return x\n", "TypeError"),
    "returns nothing": ("def get_config(): pass\n", "to return a Config .* NoneType"),
    "returns a part": ("def get_config(): return DataConfig()\n", "got DataConfig"),
    "returns a class": ("def get_config(): return Config\n", "got type"),
    "returns JSON": ("def get_config(): return {'train': {}}\n", "got dict"),
    "yields": ("def get_config(): yield Config()\n", "got generator"),
    "raises": ("def get_config():\n    raise RuntimeError('no')\n", "line 6: Runtime"),
    "raises lines": ("raise OSError('a\\nb' * 9999)\n", "line 5: OSError: a b"),
    "asserts": ("assert False\n", "line 5: AssertionError"),
    "exits": ("import sys\nsys.exit()\n", "line 6: SystemExit"),
    "exits well": ("def get_config(): raise SystemExit(0)\n", "line 5: SystemExit"),
    "imports nothing": ("import not_there_at_all\n", "line 5: ModuleNotFoundError"),
    "imports itself": ("import runpy\nrunpy.run_path(__file__)\n", "RecursionError"),
    "calls itself": ("def get_config(): return get_config()\n", "RecursionError"),
    "unknown part": ("def get_config(): return Config(optimizer=3)\n", "'optimizer'"),
    "unknown field": ("def get_config(): return DataConfig(size=3)\n", "'size'"),
    "unknown attribute": ("def get_config(): return Config().rate\n", "'rate'"),
    "part is a number": ("def get_config(): return Config(data=3)\n", "data: expected"),
    "part is nothing": ("def get_config(): return Config(model=None)\n", "model: exp"),
    "part is another": (
        "def get_config(): return Config(optim=MeshConfig())\n",
        "optim: expected",
    ),
    "part is a class": (
        "def get_config(): return Config(train=TrainConfig)\n",
        "train:",
    ),
    "shared base": ("def get_config(): return Config(model=ModelConfig())\n", "paper"),
    "replaces nothing": (
        "def get_config(): return dataclasses.replace(Config(), epochs=3)\n",
        "'epochs'",
    ),
    "frozen": ("def get_config():\n    Config().train.steps = 3\n", "line 6: Frozen"),
    "two losses": (
        "def get_config():\n    return Config(data=DataConfig(pixel_blocks=True))\n",
        "pixel_blocks: expected",
    ),
    "weights without blocks": (
        "def get_config():\n"
        "    return Config(train=TrainConfig(differences_weight=1.0))\n",
        "differences_weight: expected",
    ),
    "no data": ("def get_config(): return Config()\n", "data.root: expected"),
}
CASES = {
    f"{part}.{field}={value}": (
        f"def get_config(): return Config({PARTS[part]}"
        f"{part}({field}={value.replace('BIG', BIG)}))\n",
        field.replace("_", "[-_]"),
    )
    for part, pairs in VALUES.items()
    for field, value in pairs
}
ALL = FILES | CASES


class Accepted(Exception):
    """The run would begin."""


@pytest.fixture
def begins(monkeypatch):
    """Ends a run where its parameters would be made."""

    def begin(*_):
        raise Accepted

    monkeypatch.setattr(loop, "_new_state", begin)


def test_there_are_a_hundred():
    assert len(ALL) >= 100


@pytest.mark.usefixtures("begins")
@pytest.mark.parametrize("name", ALL)
def test_one_line_names_the_file_and_the_field(name, tmp_path, capsys):
    text, expected = ALL[name]
    file = tmp_path / "mine.py"
    file.write_bytes((HEAD + text if text else text).encode(errors="surrogateescape"))
    workdir = tmp_path / "run"
    try:
        status = main(["--config", str(file), "--workdir", str(workdir)])
    except SystemExit as end:  # tyro's own
        status = end.code
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("error: ")]
    assert status == 2 and len(lines) == 1, error
    assert "Traceback" not in error and len(lines[0]) < 1000
    assert re.search(expected, lines[0]), lines[0]
    assert "mine.py" in lines[0] or re.search("--(data|mesh|train|model)", lines[0])
    assert not workdir.exists() or not [p for p in os.listdir(workdir) if p[0] != "."]
