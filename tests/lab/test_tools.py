"""The tools: converter, benchmark, Blender's setup, training of GCNet."""

import dataclasses
import json
import runpy
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from flax.serialization import from_state_dict, to_bytes
from flax.traverse_util import flatten_dict, unflatten_dict
from reference_arrays import made_up, official_arrays
from small_networks import SMALL, SMALL_OURS, lively_network, lively_weights

from unips_jax.evaluation.methods import UnipsOptions, load_variants
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import EncoderDecoder, param_shapes, read_contexts
from unips_jax.weights import load_weights, random_weights, save_weights, weights_record

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture(scope="module")
def convert():
    pytest.importorskip("torch", reason="torch is not installed")
    return runpy.run_path(str(TOOLS / "convert_official.py"))["main"]


@pytest.mark.parametrize("prefix", ["module.", ""])
def test_unips(convert, tmp_path, prefix):
    import torch

    parts = {"encoder": "enc", "aggregation": "agg", "prediction": "pred"}
    states = {part: {} for part in parts}
    for name, array in official_arrays().items():
        part, key = name.split(".", 1)
        key = prefix + key.removeprefix("module.")
        states[part][key] = torch.from_numpy(array)
    for part, suffix in parts.items():
        torch.save(states[part], tmp_path / f"nml_{suffix}.pytmodel")
    output = tmp_path / "unips_official.safetensors"
    assert convert([str(tmp_path), "-o", str(output)]) == 0
    network = load_weights(output)
    assert network.config.attention == "released"
    kernel = network.params["decoder"]["prediction"]["fc2"]["kernel"]
    source = states["prediction"][f"{prefix}regression.2.weight"].numpy()
    np.testing.assert_array_equal(kernel, source.T)


def test_refusals_are_one_line(convert, tmp_path, capsys):
    output = tmp_path / "out.safetensors"
    assert convert([str(tmp_path), "-o", str(output)]) == 2
    (tmp_path / "GCNet.pth").write_bytes(b"not a checkpoint")
    assert convert([str(tmp_path / "GCNet.pth"), "-o", str(output)]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2
    assert "expected one file *_enc.pytmodel" in errors[0]
    assert "GCNet.pth: expected a torch state dict" in errors[1]
    assert not output.exists()


@pytest.mark.parametrize("network", ["gcnet", "ps_fcn", "lcnet"])
def test_converted_weights_are_the_method_that_is_told(
    network, tmp_path, monkeypatch, capsys
):
    tool = runpy.run_path(str(TOOLS / "convert_official.py"))
    arrays = made_up(network)
    names = tool["main"].__wrapped__.__globals__
    monkeypatch.setitem(names, "read_state_dict", lambda path: arrays)
    checkpoint = tmp_path / "checkpoint.pth"
    checkpoint.touch()
    output = tmp_path / "converted.safetensors"
    assert tool["main"]([str(checkpoint), "-o", str(output)]) == 0
    told = capsys.readouterr().out.strip().partition("--method ")[2]
    method, _ = load_variants([told], UnipsOptions(()))
    assert method.label.startswith(f"{network.replace('_', '-')}:weights=converted")


@pytest.mark.parametrize("better", [True, False])
def test_only_better_weights_are_shipped(better, tmp_path, monkeypatch, capsys):
    ship = runpy.run_path(str(TOOLS / "ship_weights.py"))["main"]
    old, new = tmp_path / "old.safetensors", tmp_path / "new.safetensors"
    first, second = (random_weights(SMALL, seed=seed) for seed in (0, 1))
    save_weights(old, first, record={"steps": {"all scenes": 40}}, half=True)
    save_weights(new, second, record={"step": 2})
    untouched = old.read_bytes()

    def validate(network, *_, num_images, **__):
        is_new = np.allclose(
            network.params["decoder"]["prediction"]["fc2"]["kernel"], kernel_of(second)
        )
        return {"mae": 20 / num_images - (is_new and better), "constant": 40}

    def kernel_of(network):
        return np.float16(network.params["decoder"]["prediction"]["fc2"]["kernel"])

    monkeypatch.setitem(ship.__wrapped__.__globals__, "validate", validate)
    output = tmp_path / "out"
    argv = [str(new), "--over", str(old), "--images", "8", "2", "-o", str(output)]
    assert ship(argv) == 0
    printed = capsys.readouterr().out
    assert f"{{'2': {10 - better}.0, '8': {2.5 - better}" in printed
    assert old.read_bytes() == untouched
    if not better:
        assert not output.exists()
        return
    (file,) = output.iterdir()
    record = weights_record(file)
    assert file.name == f"old-{record['hash'][:8]}.safetensors"
    assert f"gh release upload TAG {file}" in printed
    assert record["steps"] == {"all scenes": 42}
    assert record["scores"]["mae_deg"]["8"] == 1.5
    kernel = load_weights(file).params["decoder"]["prediction"]["fc2"]["kernel"]
    np.testing.assert_array_equal(kernel, kernel_of(second))


def test_the_mean_of_old_and_new_weights_can_be_shipped(tmp_path, monkeypatch, capsys):
    ship = runpy.run_path(str(TOOLS / "ship_weights.py"))["main"]
    old, new = tmp_path / "old.safetensors", tmp_path / "new.safetensors"
    networks = [random_weights(SMALL, seed=seed) for seed in (0, 1)]
    save_weights(old, networks[0], record={"steps": {"all scenes": 40}})
    save_weights(new, networks[1], record={"step": 2})
    kernels = [x.params["decoder"]["prediction"]["fc2"]["kernel"] for x in networks]
    mean = (kernels[0] + kernels[1]) / 2

    def validate(network, *_, **__):
        kernel = network.params["decoder"]["prediction"]["fc2"]["kernel"]
        return {"mae": float(np.abs(kernel - mean).max()), "constant": 40}

    monkeypatch.setitem(ship.__wrapped__.__globals__, "validate", validate)
    argv = [str(new), "--over", str(old), "--images", "8", "--average", "--install"]
    argv += ["-o", str(tmp_path / "out")]
    assert ship(argv) == 0
    kernel = load_weights(old).params["decoder"]["prediction"]["fc2"]["kernel"]
    np.testing.assert_allclose(kernel, mean, atol=1e-3)
    (file,) = (tmp_path / "out").iterdir()
    assert file.read_bytes() == old.read_bytes()

    other = dataclasses.replace(SMALL, hidden_dim=2 * SMALL.hidden_dim)
    save_weights(new, random_weights(other), record={"step": 2})
    shipped = old.read_bytes()
    assert ship(argv) == 2
    assert "--average: expected two networks alike" in capsys.readouterr().err
    assert old.read_bytes() == shipped


def test_weights_without_steps_are_refused_unscored(tmp_path, monkeypatch, capsys):
    ship = runpy.run_path(str(TOOLS / "ship_weights.py"))["main"]
    run, shipped = tmp_path / "run.safetensors", tmp_path / "shipped.safetensors"
    network = random_weights(SMALL)
    save_weights(run, network, record={"step": 2})
    save_weights(shipped, network, record={"steps": {"all scenes": 40}})
    monkeypatch.setitem(ship.__wrapped__.__globals__, "validate", None)
    for file in (run, shipped):
        assert ship([str(file), "--over", str(file)]) == 2
        error = capsys.readouterr().err
        assert f"{file}: expected a record with 'step" in error
        assert error.count("\n") == 1


def test_wrong_paths_are_one_line(tmp_path, capsys):
    absent = str(tmp_path / "absent")
    rate, maps = (
        runpy.run_path(str(TOOLS / f"{name}.py"))["main"]
        for name in ("data_rate", "maps")
    )
    assert rate([absent, "--workers", "0"]) == 2
    assert maps(["--diligent", absent]) == 2
    assert maps(["--ps-wild", absent]) == 2
    assert maps(["--weights", absent]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 4
    assert all("absent" in error and "expected" in error for error in errors)
    assert errors[0].startswith(f"error: {absent}: expected folders X.data")


def test_setup_names_the_python_that_is_not_there(monkeypatch, tmp_path, capsys):
    main = runpy.run_path(str(TOOLS / "render_cycles.py"))["main"]
    given = ["--setup", str(tmp_path / "bpy"), "--python", "python3.0"]
    monkeypatch.setattr(sys, "argv", ["render_cycles.py", *given])
    assert main() == 2
    assert "found no python3.0" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_gcnet_goes_on_with_the_same_options_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(TOOLS)
    tool = runpy.run_path(str(TOOLS / "train_gcnet.py"))
    output, kept = tmp_path / "gcnet.safetensors", tmp_path / "gcnet.part"
    settings = {"steps": 100, "objects": 8, "seed": 0}
    tool["write_state"](kept, settings, ({"kernel": np.arange(3)}, 50))
    read = tool["read_state"](kept, settings)
    params, done = from_state_dict(({"kernel": np.zeros(3)}, 0), read)
    assert params["kernel"].tolist() == [0, 1, 2] and done == 50
    before = kept.read_bytes()
    for other in (["--steps", "200"], ["--objects", "4"], ["--seed", "1"]):
        assert tool["main"](["-o", str(output), "--steps", "100", *other]) == 2
        error = capsys.readouterr().err
        assert f"{kept}: expected training with" in error and error.count("\n") == 1
        assert kept.read_bytes() == before and not output.exists()
    kept.write_bytes(to_bytes((1, 2)))  # as it was written before
    assert tool["main"](["-o", str(output)]) == 2
    assert "got one with unknown settings" in capsys.readouterr().err


@pytest.mark.slow
def test_gcnet_trains_and_its_file_is_a_method(tmp_path, monkeypatch):
    from unips_jax.baselines.gcnet.pipeline import gcnet
    from unips_jax.baselines.method import Observed

    monkeypatch.syspath_prepend(TOOLS)
    tool = runpy.run_path(str(TOOLS / "train_gcnet.py"))
    output = tmp_path / "gcnet.safetensors"
    names = tool["main"].__wrapped__.__globals__
    monkeypatch.setitem(names, "held_out", lambda params: {})
    assert tool["main"](["-o", str(output), "--steps", "2", "--objects", "2"]) == 0
    y, x = np.mgrid[1:-1:32j, -1:1:32j]
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    images = np.repeat(np.stack([z, z + 0.5 * x, z + 0.5 * y])[..., None], 3, -1)
    seen = {}

    def normals(observed):
        seen.update(observed.lights._asdict())
        return np.zeros((*observed.mask.shape, 3), np.float32)

    gcnet(output, normals=normals)(Observed(np.maximum(images, 0), z > 0))
    lengths = np.linalg.norm(seen["directions"], axis=-1)
    np.testing.assert_allclose(lengths, np.ones(3), atol=1e-5)
    assert np.all(seen["directions"][:, 2] > 0) and np.all(seen["intensities"] > 0)


def test_widened_networks_are_the_same_function():
    """But for a pixel's colours: normals, and the guesses by known lights."""
    widen = runpy.run_path(str(TOOLS / "widen_weights.py"))["widen"]
    narrow = dataclasses.replace(
        SMALL_OURS, patch_channels=(4, 6), light_tokens=True, known_lights=True
    )
    twice = ("embed_dim", "context_dim", "hidden_dim", "aggregation_mlp_dim")
    twice += ("pma_mlp_dim", "predictor_dim", "ratio_dim", "consensus_dim")
    twice += ("observation_dim", "communication_heads", "aggregation_heads")
    wide = dataclasses.replace(
        narrow,
        patch_channels=(8, 12),
        num_heads=(4, 8),
        **{name: 2 * getattr(narrow, name) for name in twice},
    )
    params = lively_weights(narrow)
    # Of a pixel's three colours next to eight contexts, the first norm sees less.
    first = params["decoder"]["aggregation"]["layer0"]
    for name in ("query", "key", "value"):
        first[name]["kernel"] = 0.0 * first[name]["kernel"]
    made = widen(params, narrow.context_dim, narrow.window_size)
    shapes = {name: x.shape for name, x in flatten_dict(made, sep=".").items()}
    assert shapes == param_shapes(wide)
    images = jax.random.uniform(jax.random.key(0), (3, 16, 16, 4))
    pixels = jax.random.uniform(jax.random.key(1), (5, 3, 3))
    places = jax.numpy.linspace(0.0, 3.0, 5)
    lights = jax.numpy.array([[0.6, 0.0, 0.8], [0.0, -0.5, 0.6], [0.0, 0.0, 0.0]])

    def outputs(module, lights):
        encoded = module.encode(images, lights=lights)
        cells = jax.numpy.moveaxis(encoded.contexts, 0, 2)
        read = read_contexts(cells, places, places, config=module.config)
        return module.decode(pixels, read), encoded.guesses

    def found(config, params):
        apply = jax.jit(partial(EncoderDecoder(config).apply, method=outputs))
        return [
            jax.tree.leaves(apply({"params": params}, x)) for x in (lights, 0 * lights)
        ]

    expected = found(narrow, params)
    for old, new in zip(expected, found(wide, made), strict=True):
        for x, y in zip(old, new, strict=True):
            np.testing.assert_allclose(y, x, atol=3e-4)
    for x, y in zip(*expected, strict=True):  # known lights do count
        assert np.abs(x - y).max() > 1e-3
    # Twins differ in their rows.
    kernel = made["decoder"]["prediction"]["fc1"]["kernel"]
    assert np.abs(kernel[:12] - kernel[12:]).min() > 0


def test_tiny_widened_is_small():
    widen = runpy.run_path(str(TOOLS / "widen_weights.py"))["widen"]
    tiny, small = ModelConfig.tiny(), ModelConfig.small()
    shapes = {name: np.zeros(x, np.float32) for name, x in param_shapes(tiny).items()}
    made = widen(unflatten_dict(shapes, sep="."), tiny.context_dim, small.window_size)
    wide = {name: x.shape for name, x in flatten_dict(made, sep=".").items()}
    assert wide == param_shapes(small)


def test_only_weights_half_as_wide_are_widened(tmp_path, capsys):
    main = runpy.run_path(str(TOOLS / "widen_weights.py"))["main"]
    save_weights(tmp_path / "own.safetensors", lively_network(SMALL_OURS))
    output = tmp_path / "wide.safetensors"
    assert main([str(tmp_path / "own.safetensors"), "-o", str(output)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "half as wide as `small`" in error
    assert not output.exists()


def test_seconds_say_of_which_weights(tmp_path, monkeypatch):
    main = runpy.run_path(str(TOOLS / "seconds.py"))["main"]
    for name in ("commands", "growth"):
        monkeypatch.setitem(main.__wrapped__.__globals__, name, lambda *_: {})
    assert main(["-o", str(tmp_path / "seconds.json")]) == 0
    found = json.loads((tmp_path / "seconds.json").read_text())
    assert found["hash"] == weights_record("tiny")["hash"]


def test_seconds_of_a_process_are_its_own(tmp_path):
    tool = runpy.run_path(str(TOOLS / "seconds.py"))
    idle = tool["measured"](["-c", "import time; time.sleep(0.4)"], tmp_path)
    assert idle["wall"] >= 0.4 > idle["cpu"]
    busy = "import time\nwhile time.process_time() < 0.5: pass"
    assert tool["measured"](["-c", busy], tmp_path)["cpu"] >= 0.5
    assert abs(tool["disc"](640, 74_000).sum() - 74_000) < 500
    with pytest.raises(SystemExit, match="ended with status"):
        tool["measured"](["-c", "raise SystemExit(3)"], tmp_path)
