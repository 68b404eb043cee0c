"""The benchmark: what it refuses, counts and times."""

import dataclasses
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from reference_arrays import official_arrays
from small_networks import SHALLOW_OURS, SMALL, SMALL_OURS

from unips_jax import estimate_normals
from unips_jax.models.released import from_official
from unips_jax.scenes import SceneConfig
from unips_jax.training import batches
from unips_jax.training.config import Config, DataConfig
from unips_jax.weights import random_weights

TOOLS = Path(__file__).resolve().parents[2] / "tools"


def test_the_papers_network_by_pytorch_is_the_same(monkeypatch):
    pytest.importorskip("torch", reason="torch is not installed")
    monkeypatch.syspath_prepend(str(TOOLS))
    tool = runpy.run_path(str(TOOLS / "benchmark.py"))
    official = from_official(official_arrays())  # lively ones, not as they begin
    config = dataclasses.replace(official.config, canonical_size=64)
    network = dataclasses.replace(official, config=config)
    images, mask = tool["disc"](3, 40)
    normals = tool["torch_estimate"](network, images, mask)()
    ours = estimate_normals(network, images, mask, frame="image")[mask]
    np.testing.assert_allclose(normals, ours, atol=2e-5)


def test_torch_without_torch_is_one_line(monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.setitem(sys.modules, "torch", None)
    main = runpy.run_path(str(TOOLS / "benchmark.py"))["main"]
    assert main(["--torch", "--train"]) == 2
    network = SimpleNamespace(config=SimpleNamespace(canonical_size=64))
    monkeypatch.setitem(
        main.__wrapped__.__globals__, "random_weights", lambda config: network
    )
    assert main(["--torch", "--size", "32", "--images", "1"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert "leave --train and --config out" in errors[0]
    assert errors[1].endswith("--torch: torch is not installed: pip install torch")


def test_benchmark_refuses_what_it_would_ignore(capsys):
    benchmark = runpy.run_path(str(TOOLS / "benchmark.py"))["main"]
    tiny = str(TOOLS.parent / "configs" / "tiny.py")
    assert benchmark(["--train", "--config", tiny, "--size", "64"]) == 2
    assert benchmark(["--objects", "2"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2
    assert "--size 64: with --train" in errors[0]
    assert "--objects 2: expected --train" in errors[1]


@pytest.mark.parametrize(
    "config",
    [
        SMALL,
        dataclasses.replace(SMALL, attention="released"),
        dataclasses.replace(SMALL_OURS, observation_dim=5),
        dataclasses.replace(SMALL, context_dim=SMALL.hidden_dim - 3),
        dataclasses.replace(SMALL, aggregation="max"),
        dataclasses.replace(
            SMALL, aggregation_layers=0, context_dim=SMALL.hidden_dim - 3
        ),
    ],
)
def test_benchmark_counts_every_layer_of_the_decoder(config):
    count = runpy.run_path(str(TOOLS / "benchmark.py"))["decoder_operations"]
    shapes = jax.eval_shape(lambda: random_weights(config)).params["decoder"]
    kernels = {
        name: kernel.size
        for name, kernel in flatten_dict(shapes, sep=".").items()
        if name.endswith("kernel")
    }
    pooling = ("aggregation.pooling." + name for name in ("query", "out", "mlp"))
    once = ("prediction", *pooling)  # per pixel
    each = [size for name, size in kernels.items() if not name.startswith(once)]
    assert count(config) == 2 * sum(each)


def test_benchmark_counts_an_encoder_that_sees_details():
    count = runpy.run_path(str(TOOLS / "benchmark.py"))["encoder_operations"]
    fine = dataclasses.replace(SHALLOW_OURS, fine_dim=4)
    assert count(fine, 2) > count(SHALLOW_OURS, 2) > 1e6


@pytest.mark.parametrize(("platform", "unit"), [("darwin", 1e9), ("freebsd", 1e6)])
def test_benchmark_knows_the_unit_of_memory(platform, unit, monkeypatch, tmp_path):
    peak = runpy.run_path(str(TOOLS / "benchmark.py"))["peak_memory_gb"]
    names = peak.__globals__
    monkeypatch.setitem(names, "Path", lambda _: tmp_path / "no-proc")
    usage = SimpleNamespace(ru_maxrss=int(3 * unit))
    monkeypatch.setattr(names["resource"], "getrusage", lambda _: usage)
    monkeypatch.setattr("sys.platform", platform)
    assert peak() == 3


def test_benchmark_trains_on_all_that_scenes_give(tmp_path, monkeypatch):
    timed = runpy.run_path(str(TOOLS / "benchmark.py"))["training_benchmark"]
    stepped, meshes = [], np.zeros((1, 4, 4, 4), np.float16)
    np.savez(tmp_path / "shapes.npz", distance=meshes)

    def step(state, batch, key):
        stepped.append(batch)
        return state, {}

    def rendered(keys, *, size, num_images, meshes, incident, **_):
        assert meshes.shape == (1, 4, 4, 4)
        each, pixels = (len(keys), num_images), (size, size, 3)
        return SimpleNamespace(
            images=jnp.ones((*each, *pixels)),
            mask=jnp.ones((len(keys), size, size), bool),
            normals=jnp.ones((len(keys), *pixels)),
            light_means=jnp.ones((*each, 3)),
            incident={"lamp_direction": jnp.ones((*each, 3))} if incident else None,
        )

    names = timed.__globals__
    monkeypatch.setitem(names, "new_state", lambda *_: None)
    monkeypatch.setitem(names, "compile_together", lambda *_, **__: step)
    monkeypatch.setitem(names, "encoder_operations", lambda *_: 1.0)
    monkeypatch.setitem(names, "matrix_rate", lambda *_: 1.0)
    monkeypatch.setattr(batches, "render_batch", rendered)
    config = Config(
        model=dataclasses.replace(SMALL_OURS, light_tokens=True),
        data=DataConfig("scenes", image_size=8, batch_size=2, augment=False),
        scenes=SceneConfig(mesh_rate=0.5, mesh_file=str(tmp_path / "shapes.npz")),
    )
    assert timed(config, 3, repeats=1)["objects"] == 2
    shapes = jax.tree.map(jnp.shape, stepped[0])
    assert shapes["images"] == (2, 3, 8, 8, 3) and shapes["lights"] == (2, 3, 3)
    assert shapes["incident"] == {"lamp_direction": (2, 3, 3)}
    assert 0 < stepped[0]["mask"].mean() < 1 and stepped[0]["images"].std() > 0.1
