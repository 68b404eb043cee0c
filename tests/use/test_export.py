"""Exported networks give the normals of `estimate_normals`, without this package."""

import dataclasses
import json
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from small_networks import SHALLOW_OURS, SMALL, lively_network

from unips_jax import estimate_normals
from unips_jax.cli.main import main
from unips_jax.export import files
from unips_jax.export.files import _shapes, write_export
from unips_jax.weights import save_weights, weights_hash

onnx = pytest.importorskip("onnx", reason="onnx is not installed")
pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
from unips_jax.export.onnx_graph import Graph  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
# A grid of contexts too large to be read by a product, the released arithmetic.
LARGER = dataclasses.replace(
    SMALL,
    canonical_size=100,
    attention="released",
    context_sampling="corner",
    aggregation="max",
)
# What the guesses alone need (arc cosines, softplus) has no ONNX operator.
KNOWING = dataclasses.replace(SHALLOW_OURS, known_lights=True, light_tokens=True)
# Runs where neither this package nor Flax can be imported.
BARE = """
import os, sys
class Refuse:
    def find_spec(self, name, *rest):
        if name.split(".")[0] in ("unips_jax", "flax"):
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
"""


def photographs(n, height, width, seed=0):
    generator = np.random.default_rng(seed)
    images = generator.random((n, height, width, 3), np.float32)
    mask = np.zeros((height, width), bool)
    mask[2 : height - 5, 1 : width - 2] = (
        generator.random((height - 7, width - 3)) > 0.3
    )
    return images, mask


def documented(title):
    """The code that docs/export.md shows under a title."""
    text = (ROOT / "docs" / "export.md").read_text().split(f"\n## {title}\n")[1]
    return re.search(r"^```py\n(.*?)^```", text, re.DOTALL | re.MULTILINE)[1]


def save(folder, images, mask):
    folder.mkdir(exist_ok=True)
    np.save(folder / "images.npy", images)
    np.save(folder / "mask.npy", mask)


@pytest.mark.parametrize("config", [KNOWING, LARGER], ids=["ours", "unips"])
def test_onnx_gives_the_same_normals(config, tmp_path, monkeypatch):
    network, out = lively_network(config), tmp_path / "unips-onnx"
    record = write_export(out, network, format="onnx", name="small")
    for n, height, width in ((3, 31, 23), (5, 19, 40)):
        images, mask = photographs(n, height, width)
        expected = np.asarray(estimate_normals(network, images, mask))
        save(tmp_path, images, mask)
        monkeypatch.chdir(tmp_path)
        found = {}
        exec(documented("onnxruntime in Python"), found)
        np.testing.assert_allclose(found["normals"], expected, rtol=1e-4, atol=5e-5)
    model = onnx.load(out / "encoder.onnx")
    (entry,) = model.metadata_props
    told = json.loads(entry.value)
    assert entry.key == "unips_jax" and told["version"] == record["version"]
    assert told["weights"]["hash"] == record["weights"]["hash"]


def test_stablehlo_gives_the_same_normals_without_this_package(tmp_path):
    network = lively_network(SHALLOW_OURS)
    out = tmp_path / "unips-stablehlo"
    write_export(out, network, format="stablehlo", name="small")
    sets = {"low": photographs(3, 31, 23), "wide": photographs(5, 19, 40)}
    code = BARE
    for name, given in sets.items():
        save(tmp_path / name, *given)
        (tmp_path / name / out.name).symlink_to(out)
        code += f"os.chdir(sys.argv[1] + '/{name}')\n{documented('JAX')}"
        code += "np.save('normals.npy', normals)\n"
    subprocess.run([sys.executable, "-I", "-c", code, tmp_path], check=True)
    for name, (images, mask) in sets.items():
        expected = estimate_normals(network, images, mask)
        found = np.load(tmp_path / name / "normals.npy")
        np.testing.assert_allclose(found, expected, atol=1e-4)
        assert (found[~mask] == 0).all() and np.abs(found[mask]).max() > 0.5


def test_parameters_that_half_precision_holds_are_stored_so(tmp_path):
    network = lively_network(SHALLOW_OURS)
    sizes = {}
    for half in (False, True):
        folder = tmp_path / str(half)
        write_export(folder, network, format="onnx", name="small", half=half)
        model = onnx.load(folder / "decoder.onnx")
        types = [x.data_type for x in model.graph.initializer if np.prod(x.dims) > 64]
        sizes[half] = types.count(onnx.TensorProto.FLOAT16)
    assert sizes[False] == 0 and sizes[True] > 5


def test_the_hash_is_that_of_the_weights_as_they_are(tmp_path, monkeypatch):
    """Also of a network that trains in half precision, and of a rounded file."""
    network = lively_network(SHALLOW_OURS)
    config = dataclasses.replace(network.config, dtype="bfloat16", remat=True)
    network = dataclasses.replace(network, config=config)
    monkeypatch.setattr(files, "write_stablehlo", lambda *given: None)
    for half in (False, True):
        how = {"format": "stablehlo", "name": "mine", "half": half}
        record = write_export(tmp_path / str(half), network, **how)
        assert record["weights"]["hash"] == weights_hash(network)


def test_command(tmp_path, capsys):
    save_weights(tmp_path / "small.safetensors", lively_network(SHALLOW_OURS))
    weights, out = str(tmp_path / "small.safetensors"), tmp_path / "out"
    assert (
        main(["export", "--format", "onnx", "--weights", weights, "-o", str(out)]) == 0
    )
    record = json.loads((out / "export.json").read_bytes())
    assert sorted(record["files"]) == ["decoder.onnx", "encoder.onnx"]
    assert record["config"]["network"] == "self_calibrating"
    assert "encoder.onnx" in capsys.readouterr().out
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    assert main(["export", "--format", "onnx", "-o", str(tmp_path / "mine")]) == 2
    assert "with other files" in capsys.readouterr().err


def test_what_has_no_operator_is_named():
    traced = jax.make_jaxpr(jax.numpy.cumsum)(np.ones(3, np.float32))
    graph = Graph()
    value = graph.input("x", traced.in_avals[0])
    with pytest.raises(NotImplementedError, match="JAX's cumsum"):
        graph.add_jaxpr(traced.jaxpr, traced.consts, [value])


def test_a_decoder_takes_as_many_views_as_asked_for():
    views = [_shapes(SHALLOW_OURS, count)["views"].shape[0] for count in (None, 1)]
    assert views == [2, 1]
