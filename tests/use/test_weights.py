"""Weights files: round trip, refusals, the authors' names."""

import dataclasses
import json
import tracemalloc
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors import safe_open
from safetensors.numpy import save_file
from small_networks import SMALL, lively_network, lively_weights

import unips_jax
from unips_jax import angular_error_deg, estimate_normals, weights
from unips_jax.errors import InputError
from unips_jax.io.images import read_image
from unips_jax.io.normals import read_normals
from unips_jax.models.config import ModelConfig
from unips_jax.models.config_json import to_json
from unips_jax.models.network import UniversalNetwork
from unips_jax.models.released import from_official, official_name
from unips_jax.weights import (
    load_weights,
    save_weights,
    weights_hash,
    weights_record,
)


def test_round_trip(tmp_path):
    params = lively_weights()
    path = tmp_path / "small.safetensors"
    network = UniversalNetwork(SMALL, params)
    save_weights(path, network, record={"score": 9.5})
    loaded = load_weights(path)
    assert loaded.config == SMALL
    expected, actual = flatten_dict(params), flatten_dict(loaded.params)
    assert set(expected) == set(actual)
    for name, value in expected.items():
        np.testing.assert_array_equal(actual[name], value)
    record = weights_record(path)
    assert record["score"] == 9.5
    assert record["hash"] == weights_hash(network)
    assert [p.name for p in tmp_path.iterdir()] == ["small.safetensors"]
    path.rename(tmp_path / "mine")  # a name of one's own
    assert load_weights(tmp_path / "mine").config == SMALL


def test_shipped_weights_are_those_of_tiny():
    assert load_weights("tiny").config == ModelConfig.tiny()


def test_shipped_weights_find_the_normals_of_the_sample():
    folder = Path(unips_jax.__file__).parent / "assets/sample/obj000.data"
    images = [read_image(folder / f"L_{i:02}.png")[::2, ::2] for i in (0, 2, 4, 6)]
    mask = read_image(folder / "mask.png")[::2, ::2, 0] > 0
    truth = read_normals(folder / "normal.tif")[::2, ::2]
    normals = estimate_normals(load_weights("tiny"), np.stack(images) / 65535, mask)
    error = angular_error_deg(normals, truth)[mask].mean()
    assert error < 9  # 6.6; of a constant normal 37.4


def test_half_precision_is_float32_in_memory(tmp_path):
    params = lively_weights()
    path = tmp_path / "half.safetensors"
    save_weights(path, UniversalNetwork(SMALL, params), half=True)
    loaded = load_weights(path).params
    for name, value in flatten_dict(params).items():
        actual = flatten_dict(loaded)[name]
        assert actual.dtype == np.float32
        np.testing.assert_allclose(actual, value, rtol=1e-3, atol=1e-6)


def test_absent_and_broken_files(tmp_path):
    with pytest.raises(InputError, match=r"(?s)nothing-here.*unips train"):
        load_weights("nothing-here")
    with pytest.raises(InputError, match="found nothing there"):
        load_weights(tmp_path / "absent.safetensors")
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"not a safetensors file")
    with pytest.raises(InputError, match="expected a safetensors file"):
        load_weights(broken)
    foreign = tmp_path / "foreign.safetensors"
    save_file({"a": np.zeros(3, np.float32)}, foreign)
    with pytest.raises(InputError, match="ModelConfig"):
        load_weights(foreign)


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path):
    path = tmp_path / "small.safetensors"
    path.mkdir()
    with pytest.raises(InputError, match=r"small\.safetensors: cannot be written"):
        save_weights(path, lively_network())
    assert list(tmp_path.iterdir()) == [path]


def test_all_problems_are_named_at_once(tmp_path):
    params = flatten_dict(lively_weights(), sep=".")
    params.pop("decoder.prediction.fc1.bias")
    params["decoder.prediction.fc2.bias"] = np.zeros(4)
    params["decoder.prediction.fc9.bias"] = np.zeros(4)
    path = tmp_path / "wrong.safetensors"
    arrays = {name: np.asarray(array, np.float32) for name, array in params.items()}
    save_file(arrays, path, {"config": to_json(SMALL), "hash": ""})
    wrong = UniversalNetwork(SMALL, unflatten_dict(params, sep="."))
    for problem in (lambda: load_weights(path), lambda: save_weights(path, wrong)):
        with pytest.raises(InputError) as raised:
            problem()
        for name in (
            "decoder.prediction.fc1.bias",
            "decoder.prediction.fc2.bias (4,)",
            "decoder.prediction.fc9.bias",
        ):
            assert name in str(raised.value)


def test_official_problems_are_named_at_once():
    arrays = {
        "encoder.module.backbone.0.norm0.weight": np.zeros(95, np.float32),
        "encoder.module.backbone.0.other.weight": np.zeros(3, np.float32),
        "encoder.module.x.relative_position_index": np.zeros(3),
    }
    with pytest.raises(InputError) as raised:
        from_official(arrays)
    message = str(raised.value)
    assert "468 missing" in message
    assert "1 unexpected: encoder.module.backbone.0.other.weight" in message
    assert "1 misshapen: encoder.module.backbone.0.norm0.weight (95,)" in message
    assert "relative_position_index" not in message


@pytest.mark.parametrize("prefix", ["encoder.module.", "encoder."])
def test_names_with_and_without_module(prefix):
    key = f"{prefix}backbone.0.layers.2.blocks.17.mlp.fc1.weight"
    assert official_name(key) == "encoder.stages_2.block17.fc1.kernel"


def rewritten(path, **changes):
    """The file with other metadata."""
    with safe_open(path, framework="np") as file:
        metadata = file.metadata() | changes
        arrays = {name: file.get_tensor(name) for name in file.keys()}
    save_file(arrays, path, metadata)
    return path


def test_equal_parameters_are_equal_bytes(tmp_path):
    params = lively_weights()
    turned = {half: dict(reversed(params[half].items())) for half in reversed(params)}
    files = [tmp_path / f"{i}.safetensors" for i in range(6)]
    for file in files:
        order = params if file is files[0] else turned
        record = {"b": 2, "a": 1} if file is files[0] else {"a": 1, "b": 2}
        save_weights(file, UniversalNetwork(SMALL, order), record=record)
    assert len({file.read_bytes() for file in files}) == 1


def test_every_flipped_bit_is_found(tmp_path):
    path = tmp_path / "small.safetensors"
    save_weights(path, lively_network(), half=True)
    data = path.read_bytes()
    start = 8 + int.from_bytes(data[:8], "little")
    for place in (start, (start + len(data)) // 2, len(data) - 1):
        damaged = bytearray(data)
        damaged[place] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"small\.safetensors: damaged"):
            load_weights(path)
    rewritten(path, config=to_json(dataclasses.replace(SMALL, remat=True)))
    with pytest.raises(InputError, match=r"small\.safetensors: damaged"):
        load_weights(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e38, 7e4])
def test_parameters_that_cannot_be_are_refused(tmp_path, monkeypatch, value):
    """By who writes, which leaves the file as it was, and by who reads."""
    params = lively_weights()
    kernel = params["decoder"]["prediction"]["fc2"]["kernel"]
    params["decoder"]["prediction"]["fc2"]["kernel"] = kernel.at[0, 0].set(value)
    file, wrong = tmp_path / "bad.safetensors", UniversalNetwork(SMALL, params)
    refused = pytest.raises(
        InputError, match=r"decoder\.prediction\.fc2\.kernel: .* at most"
    )
    file.write_bytes(b"as it was")
    with refused:
        save_weights(file, wrong)
    assert file.read_bytes() == b"as it was"
    monkeypatch.setattr(weights, "_check_values", lambda *_: None)
    save_weights(file, wrong)
    monkeypatch.undo()
    with refused:
        load_weights(file)


SIZES = json.loads(to_json(SMALL))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (json.dumps(SIZES | {"canonical_size": 10**6}), "canonical_size: expected at"),
        (json.dumps(SIZES | {"depths": [10**7, 1]}), "depths: expected one to eight"),
        (json.dumps(SIZES | {"depths": [100, 100]}), "parameters of 201 blocks, got"),
        (json.dumps(SIZES | {"window_size": 10**5}), "window_size: expected at most"),
        (json.dumps(SIZES | {"mlp_ratio": 1e300}), "mlp_ratio: expected at most"),
        (json.dumps(SIZES | {"embed_dim": None}), "embed_dim: expected int"),
        (json.dumps(SIZES | {"\n" * 10**6: 1}), "unknown fields"),
        ("[]", "expected a JSON object"),
        ("[" * 10**6, "too deep a nest"),
        ("{", "ModelConfig as JSON"),
        (json.dumps({"canonical_size": 96}), "expected a network.*another version"),
    ],
)
def test_hostile_metadata_takes_one_line_and_no_memory(tmp_path, config, message):
    path = tmp_path / "hostile.safetensors"
    save_weights(path, lively_network())
    rewritten(path, config=config)
    tracemalloc.start()
    with pytest.raises(InputError, match=message) as raised:
        load_weights(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5e7
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 2000


@pytest.mark.parametrize("record", ["[", "[]", "[" * 10**6, "3"])
def test_hostile_records_take_one_line(tmp_path, record):
    path = tmp_path / "hostile.safetensors"
    save_weights(path, lively_network())
    with pytest.raises(InputError, match="expected a JSON object"):
        weights_record(rewritten(path, record=record))


def test_parameters_that_do_not_fit_are_not_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    network = UniversalNetwork(SMALL, lively_weights())
    save_weights("good.safetensors", network)
    before = Path("good.safetensors").read_bytes()
    ensemble = jax.tree.map(lambda x: jnp.stack([x, x]), network)
    half = UniversalNetwork(SMALL, {"encoder": network.params["encoder"]})
    refused = r"good\.safetensors: parameters do not fit.{1,999}$"  # names some
    for wrong in (ensemble, half):
        with pytest.raises(InputError, match=refused):
            save_weights("good.safetensors", wrong)
    assert Path("good.safetensors").read_bytes() == before
    with pytest.raises(InputError, match="tiny: expected another name than those of"):
        save_weights("tiny", network)  # load_weights("tiny") gives the shipped ones
    assert not Path("tiny").exists()
