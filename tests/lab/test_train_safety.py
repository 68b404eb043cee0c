"""What a training run refuses, and what it lets pass."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import training_runs
from flax.traverse_util import flatten_dict
from small_networks import SMALL_OURS, lively_weights

from unips_jax.errors import InputError
from unips_jax.models.config_json import to_json
from unips_jax.models.network import UniversalNetwork
from unips_jax.provenance import code_hash
from unips_jax.train import load_config, main
from unips_jax.training import loop
from unips_jax.training.checkpoints import changed_fields
from unips_jax.training.config import Config, DataConfig, MeshConfig
from unips_jax.training.loss import LossOptions
from unips_jax.training.safety import (
    alone_in,
    check_finite,
    check_input,
    stop_on_sigterm,
)
from unips_jax.training.sharding import make_mesh
from unips_jax.training.state import TrainState
from unips_jax.weights import load_weights, save_weights, weights_hash

CONFIG = Config(data=DataConfig(source="mixture", root="a", batch_size=8))
MESH = make_mesh(MeshConfig(data=1))


def altered(part, **fields):
    section = dataclasses.replace(getattr(CONFIG, part), **fields)
    return dataclasses.replace(CONFIG, **{part: section})


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("data", "num_images", (3,)),
        ("model", "hidden_dim", 96),
        ("scenes", "noise_rate", 0.1),
        ("train", "seed", 7),
        ("train", "squared_loss", False),
    ],
)
def test_what_a_run_learns_from_may_not_change(part, field, value):
    changed = changed_fields(
        json.loads(to_json(CONFIG)), altered(part, **{field: value})
    )
    assert list(changed) == [f"{part}.{field}"]


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("data", "root", "b"),
        ("data", "workers", 2),
        ("scenes", "mesh_file", "elsewhere/shapes.npz"),
        ("model", "remat", True),
        ("mesh", "microbatches", 2),
        ("train", "steps", 7),
    ],
)
def test_place_memory_and_length_may_change(part, field, value):
    saved = json.loads(to_json(CONFIG))
    assert not changed_fields(saved, altered(part, **{field: value}))


def test_fields_of_a_later_version_do_not_end_a_run():
    saved = json.loads(to_json(CONFIG))
    del saved["scenes"]["spare_rate"]
    assert not changed_fields(saved, CONFIG)
    assert list(changed_fields(saved, altered("scenes", spare_rate=0.9))) == [
        "scenes.spare_rate"
    ]


def test_a_folder_serves_one_run(tmp_path):
    with alone_in(tmp_path):
        with pytest.raises(InputError, match="another process trains there"):
            with alone_in(tmp_path):
                pass
    with alone_in(tmp_path):
        pass


def test_bad_input_is_named(tmp_path):
    with pytest.raises(InputError, match=r"--data\.root 'a': expected the folder"):
        check_input(CONFIG, MESH)
    there = dataclasses.replace(CONFIG.data, root=str(tmp_path))
    check_input(dataclasses.replace(CONFIG, data=there), MESH)
    nowhere = dataclasses.replace(CONFIG.data, root="")
    with pytest.raises(InputError, match=r"--data\.root: expected the folder"):
        check_input(dataclasses.replace(CONFIG, data=nowhere), MESH)
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(InputError, match=r"--data\.batch-size 8: .* 3 devices"):
        check_input(CONFIG, SimpleNamespace(size=3))
    parts = dataclasses.replace(altered("mesh", microbatches=4), data=there)
    check_input(parts, SimpleNamespace(size=2))
    with pytest.raises(InputError, match=r"--mesh\.microbatches 4: .* the 2 objects"):
        check_input(parts, SimpleNamespace(size=4))
    scenes = dataclasses.replace(CONFIG.data, source="scenes", root="")
    with pytest.raises(InputError, match="--workdir .*file: cannot be a folder"):
        loop.train(dataclasses.replace(CONFIG, data=scenes), file)
    too_many = MeshConfig(fsdp=2 * jax.device_count())
    with pytest.raises(InputError, match=r"--mesh\.fsdp"):
        make_mesh(too_many)


@pytest.mark.parametrize(
    ("part", "field", "value"),
    [
        ("optim", "warmup_steps", -1),
        ("optim", "b2", 1.0),
        ("data", "workers", -1),
        ("data", "image_size", 510),
        ("train", "validation_scenes", -1),
    ],
)
def test_configurations_name_the_field(part, field, value):
    with pytest.raises(ValueError, match=f"{field}: expected"):
        altered(part, **{field: value})


def test_sigterm_is_waited_for_until_the_checkpoint_is_written(tmp_path, monkeypatch):
    """A second one must not end the process while the first one's is on its way."""
    asked = []

    def leave(self, *_):
        handler = signal.getsignal(signal.SIGTERM)
        assert callable(handler)
        os.kill(os.getpid(), signal.SIGTERM)
        asked.append(handler)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(loop.Checkpoints, "__exit__", leave)
    monkeypatch.setattr(loop, "_new_state", interrupted)
    with pytest.raises(KeyboardInterrupt):
        loop.train(training_runs.CONFIG, tmp_path)
    assert len(asked) == 1


def test_joining_nobody_is_one_line(tmp_path):
    """In a process of its own: nothing may have used JAX before."""
    command = [sys.executable, "-m", "unips_jax.train", "--config", "tiny"]
    command += ["--workdir", str(tmp_path / "run"), "--distributed"]
    alone = {k: v for k, v in os.environ.items() if not k.startswith("SLURM")}
    done = subprocess.run(command, env=alone, capture_output=True, text=True)
    assert done.returncode == 2 and "\n" not in done.stderr.strip()
    assert done.stderr.startswith("error: --distributed: expected other processes")
    assert not (tmp_path / "run").exists()


def test_the_signal_handler_is_put_back():
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_sigterm() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(1)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_loss_that_is_not_finite_says_how_to_go_on(tmp_path):
    metrics = {"loss": np.float32("nan"), "grad_norm": np.float32(1)}
    with pytest.raises(FloatingPointError, match="choose another --workdir"):
        check_finite(3, {"mask": np.ones(2)}, metrics, tmp_path)
    assert np.all(np.load(tmp_path / "nonfinite_step3.npz")["mask"] == 1)
    metrics = {"loss": 1.0, "grad_norm": np.inf}
    with pytest.raises(InputError, match="step 4: loss 1.0 or its gradient is not"):
        check_finite(4, {"mask": np.ones(2)}, metrics, tmp_path)
    check_finite(5, {"mask": np.ones(2)}, {"loss": 1.0, "grad_norm": 2.0}, tmp_path)
    assert not (tmp_path / "nonfinite_step5.npz").exists()


def test_averaged_parameters_are_released_where_there_are_any():
    state = TrainState(np.int32(0), "last", None, "averaged")
    assert state.released_params() == "averaged"
    assert state._replace(ema_params=None).released_params() == "last"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "from unips_jax.training.config import Config, DataConfig\n"
            "def get_config():\n    return Config(data=DataConfig(batch_size=0))\n",
            "batch_size: expected a positive",
        ),
        ("import nothing_of_this_name", "line 1: ModuleNotFoundError: No module"),
        ("x = 1\ndef (:", "line 2: SyntaxError: "),
        ("\0", "SyntaxError: |ValueError: "),
        ("def get_config():\n    return 1 / 0", "line 2: ZeroDivisionError: "),
        ("def get_config(x):\n    return x", "TypeError: "),
        ("def get_config():\n    return 3", "to return a Config .*, got int"),
        ("get_config = 3", r"expected a function get_config\(\)"),
        ("", r"expected a function get_config\(\)"),
    ],
)
def test_a_bad_configuration_file_is_named(tmp_path, text, expected):
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(InputError, match=rf"mine\.py: .*({expected})"):
        load_config(file)


def test_fields_are_listed_without_a_folder(capsys):
    tiny = str(Path(__file__).parents[2] / "configs" / "tiny.py")
    with pytest.raises(SystemExit) as end:
        main(["--config", tiny, "--help"])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert "usage: unips train" in shown and "--optim.learning-rate" in shown
    rate = load_config(tiny).optim.learning_rate
    assert f"the highest learning rate. (default: {rate})" in shown
    with pytest.raises(SystemExit) as end:
        main(["--config", tiny])
    assert end.value.code == 2
    assert "--workdir" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "near"),
    [
        ("--optim.lr", "--optim.learning-rate"),
        ("--data.bs", "--data.batch-size"),
        ("--optim.wd", "--optim.weight-decay"),
        ("--optim.learning_rat", "--optim.learning-rate"),
        ("--train.step", "--train.steps"),
    ],
)
def test_an_unknown_field_has_its_nearest_named(tmp_path, capsys, option, near):
    tiny = str(Path(__file__).parents[2] / "configs" / "tiny.py")
    run = tmp_path / "run"
    assert main(["--config", tiny, "--workdir", str(run), option, "3"]) == 2
    error = capsys.readouterr().err
    assert f"unips train has no option {option}: perhaps {near}" in error
    assert not run.exists()


def test_the_best_weights_are_those_of_the_lowest_error(tmp_path, monkeypatch):
    state = SimpleNamespace(released_params=lambda: {"a": np.zeros(1)})
    log = SimpleNamespace(record=lambda *_: None, shows_pictures=False)
    written, record = [], {"best_mae_deg": None}
    monkeypatch.setattr(
        loop, "_write_weights", lambda path, *a: written.append((path.name, *a[2:]))
    )

    def run(config, *rounds):
        nonlocal record
        for state.step, error in rounds:
            scores = {"mae": error, "constant": 50 - error}
            monkeypatch.setattr(loop, "validate", lambda *_, found=scores, **__: found)
            record = loop._validate_and_keep_best(config, state, record, tmp_path, log)

    run(CONFIG, (4, np.nan), (5, 30.0), (6, 40.0), (7, 20.0), (8, 20.0), (9, np.nan))
    counts = [CONFIG.train.validation_scenes, CONFIG.train.validation_images]
    on = [*counts, code_hash("scenes.render")]
    assert record == {"best_mae_deg": 20, "best_step": 7, "best_on": on}
    assert [(name, step, scores["mae"]) for name, step, scores in written] == [
        ("best.safetensors", 5, 30),
        ("best.safetensors", 7, 20),
    ]
    fewer = dataclasses.replace(CONFIG.train, validation_images=1)
    run(dataclasses.replace(CONFIG, train=fewer), (10, 35.0), (11, 36.0))
    assert (record["best_mae_deg"], record["best_step"]) == (35, 10)
    record["best_on"] = [CONFIG.train.validation_scenes, 1]  # scenes of another code
    run(dataclasses.replace(CONFIG, train=fewer), (12, 38.0))
    assert (record["best_mae_deg"], record["best_step"]) == (38, 12)


def test_weights_of_a_run_whose_checkpoints_are_gone_stay(tmp_path):
    (tmp_path / "best.safetensors").write_bytes(b"mine")
    scenes = dataclasses.replace(CONFIG.data, source="scenes", root="")
    config = dataclasses.replace(CONFIG, data=scenes, model=SMALL_OURS)
    with pytest.raises(InputError, match=r"checkpoints beside its best\.safetensors"):
        loop.train(config, tmp_path)
    assert (tmp_path / "best.safetensors").read_bytes() == b"mine"


def test_a_run_goes_on_from_the_weights_it_began_with(tmp_path):
    files = []
    for index, change in enumerate((0.0, 1.0)):
        files.append(str(tmp_path / f"{index}.safetensors"))
        params = jax.tree.map(lambda x, by=change: x + by, lively_weights(SMALL_OURS))
        save_weights(files[-1], UniversalNetwork(SMALL_OURS, params))
    begun = {"init": weights_hash(load_weights(files[0]))}
    for given, record in (
        (files[0], begun),
        (None, begun),
        (str(tmp_path / "gone.safetensors"), begun),
        (files[1], {}),  # of an earlier version
    ):
        loop._check_same_start(given, record)
    with pytest.raises(InputError, match="those of hash .*, got weights of hash"):
        loop._check_same_start(files[1], begun)
    with pytest.raises(InputError, match="began with, drawn ones, got weights of"):
        loop._check_same_start(files[1], {"init": None})


def test_a_mesh_takes_all_devices_of_several_processes(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "device_count", lambda: 8)
    with pytest.raises(InputError, match="expected all 8 devices of the 2 processes"):
        make_mesh(MeshConfig(data=4))
    with pytest.raises(InputError, match="or take fewer processes"):
        check_input(CONFIG, SimpleNamespace(size=3))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pixel_blocks": True}, "pixel_blocks: expected no grid_loss with them"),
        ({"grid_loss": False, "steepness_weight": 1.0}, "expected pixel_blocks, got"),
        ({"differences_weight": 1.0}, "expected pixel_blocks, got none"),
    ],
)
def test_losses_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        LossOptions(num_pixels=64, **options)


def test_scenes_with_kinds_of_light_are_not_augmented():
    model = dataclasses.replace(SMALL_OURS, light_tokens=True)
    data = dataclasses.replace(CONFIG.data, augment=True)
    with pytest.raises(ValueError, match="light_tokens: expected no augment"):
        Config(model=model, data=data)
    Config(model=model, data=dataclasses.replace(data, source="folders"))


def test_weights_join_a_network_that_has_grown(tmp_path):
    """What they have is taken, what they lack stays as drawn; not the other way."""
    grown = dataclasses.replace(SMALL_OURS, fine_dim=5, light_tokens=True)
    data = dataclasses.replace(CONFIG.data, grid_loss=False, augment=False)
    files = {}
    for model in (SMALL_OURS, grown):
        files[model] = tmp_path / f"{model.fine_dim}.safetensors"
        network = UniversalNetwork(model, lively_weights(model))
        save_weights(files[model], network)
    drawn = jax.tree.map(lambda x: x + 1, lively_weights(grown))
    state = TrainState(np.int32(0), drawn, None, None)
    config = Config(model=grown, data=data)
    started = flatten_dict(
        loop._start_from(state, str(files[SMALL_OURS]), config).params
    )
    before = flatten_dict(lively_weights(SMALL_OURS))
    assert started.keys() == flatten_dict(drawn).keys() > before.keys()
    for name, value in started.items():
        expected = before.get(name, flatten_dict(drawn)[name])
        np.testing.assert_array_equal(value, expected)
    state = TrainState(np.int32(0), lively_weights(SMALL_OURS), None, None)
    with pytest.raises(InputError, match=r"fine_dim.*light_tokens"):
        loop._start_from(state, str(files[grown]), Config(model=SMALL_OURS, data=data))
