"""The network as a module of flax.nnx, and folders in the shape of a model hub."""

import json
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from small_disk import files_below, fill_after
from small_networks import SHALLOW, SHALLOW_OURS, lively_network

from unips_jax import NnxNetwork, estimate_normals, load_weights
from unips_jax.errors import InputError


@pytest.fixture(scope="module")
def network():
    return lively_network(SHALLOW_OURS)


@pytest.fixture(scope="module")
def seen():
    images = jax.random.uniform(jax.random.key(0), (3, 16, 16, 3))
    return images, jnp.ones((16, 16), bool).at[:3].set(False)


def test_it_gives_the_functions_normals_and_gradients(seen):
    network = lively_network(SHALLOW)
    model = NnxNetwork(network)
    np.testing.assert_allclose(
        nnx.jit(model)(*seen), estimate_normals(network, *seen), atol=1e-6
    )
    found = nnx.grad(lambda model: model(*seen)[..., 2].mean())(model)
    wanted = jax.grad(lambda net: estimate_normals(net, *seen)[..., 2].mean())(network)
    leaves = jax.tree.leaves(found)
    assert len(leaves) == len(jax.tree.leaves(network.params))
    for a, b in zip(leaves, jax.tree.leaves(wanted.params), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_on_a_full_disk_a_folder_stays_what_it_was(
    count, network, tmp_path, monkeypatch
):
    (tmp_path / "config.json").write_text("before")
    with monkeypatch.context() as patch:
        fill_after(patch, count)
        with pytest.raises(InputError, match="cannot be written: No space left"):
            NnxNetwork(network).save_pretrained(tmp_path)
    assert files_below(tmp_path) == {"config.json": b"before"}
    NnxNetwork(network).save_pretrained(tmp_path)
    assert len(files_below(tmp_path)) == 3


def test_a_folder_comes_back_with_what_was_trained(network, seen, tmp_path):
    model = NnxNetwork(network)
    state = nnx.state(model, nnx.Param)
    nnx.update(model, jax.tree.map(lambda leaf: 1.1 * leaf, state))
    folder = tmp_path / "mine"
    model.save_pretrained(folder, record={"step": 3})
    assert sorted(path.name for path in folder.iterdir()) == [
        "README.md",
        "config.json",
        "model.safetensors",
    ]
    config = json.loads((folder / "config.json").read_text())
    assert config["kind"] == "SelfCalibratingConfig"
    assert config["config"]["embed_dim"] == SHALLOW_OURS.embed_dim
    assert "license: apache-2.0" in (folder / "README.md").read_text()
    again = NnxNetwork.from_pretrained(folder)
    assert again.config == SHALLOW_OURS
    for a, b in zip(*map(jax.tree.leaves, (again.network, model.network)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert load_weights(folder / "model.safetensors").config == SHALLOW_OURS
    (folder / "weights").write_bytes((folder / "model.safetensors").read_bytes())
    assert NnxNetwork.from_pretrained(folder / "weights").config == SHALLOW_OURS
    (folder / "weights").unlink()
    with pytest.raises(InputError, match="expected another name than that of shipped"):
        model.save_pretrained(tmp_path / "tiny")  # from_pretrained("tiny") is another
    (folder / "README.md").write_text("my own words")
    model.save_pretrained(folder)
    assert (folder / "README.md").read_text() == "my own words"


def test_a_hubs_model_is_fetched(network, tmp_path, monkeypatch):
    NnxNetwork(network).save_pretrained(tmp_path / "cache")
    monkeypatch.chdir(tmp_path)
    hub = SimpleNamespace(snapshot_download=lambda name, **_: tmp_path / "cache")
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    assert NnxNetwork.from_pretrained("user/mine").config == SHALLOW_OURS

    def offline(name, **_):
        raise OSError("no route to host")

    hub.snapshot_download = offline
    with pytest.raises(InputError, match="user/mine: cannot be fetched: no route"):
        NnxNetwork.from_pretrained("user/mine")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match="`pip install huggingface_hub`"):
        NnxNetwork.from_pretrained("user/mine")
    with pytest.raises(InputError, match="expected one of tiny, a weights file, a fol"):
        NnxNetwork.from_pretrained("no such thing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="a folder with model.safetensors, found none"):
        NnxNetwork.from_pretrained(tmp_path / "empty")
