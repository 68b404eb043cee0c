"""The network with the authors' arithmetic reproduces the authors' arrays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.traverse_util import flatten_dict
from reference_arrays import GOLDEN, official_arrays

from unips_jax import estimate_normals
from unips_jax.metrics import angular_error_deg
from unips_jax.models import ops
from unips_jax.models.encoding import communicate
from unips_jax.models.network import EncoderDecoder, read_contexts
from unips_jax.models.released import from_official, official_name
from unips_jax.training.loss import LossOptions, Objects, training_loss


@pytest.fixture(scope="module")
def official():
    network = from_official(official_arrays())
    config = dataclasses.replace(network.config, canonical_size=64)
    return dataclasses.replace(network, config=config)


@pytest.fixture(scope="module")
def golden():
    with np.load(GOLDEN / "unips_official.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def computed(official, golden):
    """Every intermediate array, by the golden file's names."""
    config, params = official.config, official.params
    network = EncoderDecoder(config)

    @jax.jit
    def encode(params, images, mask):
        inputs = ops.resize_bilinear(images, (64, 64))
        small = ops.resize_mask_nearest(mask, (64, 64))[None, :, :, None]
        inputs = jnp.concatenate(
            [inputs * small, jnp.broadcast_to(small, (3, 64, 64, 1))], axis=-1
        )
        encoder = network.bind({"params": params}).encoder
        x = encoder.patch_embed(inputs)
        out = {"patch_embed": x}
        for i, (stage, norm) in enumerate(
            zip(encoder.stages, encoder.norms, strict=True)
        ):
            x = stage(x, True)
            out[f"swin_{i}"] = level = norm(x)
            block = encoder.communications[i]
            out[f"comm_{i}"] = communicate(block, level, 3, None, True)
        return out | {"glc": encoder(inputs).contexts}

    arrays = encode(params, golden["images"], golden["mask"])
    y, x = golden["pixels_yx"].T

    @jax.jit
    def decode(params, contexts, pixels):
        decoder = network.bind({"params": params}).decoder
        cells = y * 16 / 96 - 0.5, x * 16 / 96 - 0.5
        read = read_contexts(jnp.moveaxis(contexts, 0, 2), *cells, config=config)
        features = decoder.aggregation(pixels, read)
        return features, decoder.prediction(features)

    pixels = golden["images"][:, y, x].transpose(1, 0, 2)
    features, predicted = decode(params, arrays["glc"], pixels)
    return arrays | {"agg_rows": features, "pred_rows": predicted}


@pytest.mark.parametrize(
    "name",
    ["patch_embed", *(f"{part}_{i}" for part in ("swin", "comm") for i in range(4))]
    + ["glc", "agg_rows", "pred_rows"],
)
def test_layer(computed, golden, name):
    expected = golden[name]
    error = np.linalg.norm(computed[name] - expected) / np.linalg.norm(expected)
    assert error <= 1e-5


def test_predicted_rows_are_the_golden_normals(computed, golden):
    rows = golden["normals"][golden["rows"]]
    assert np.max(angular_error_deg(computed["pred_rows"], rows)) <= 0.02


def test_normals_of_all_pixels(official, golden):
    images, mask = golden["images"], golden["mask"]
    normals = estimate_normals(official, images, mask, frame="image")
    error = angular_error_deg(normals[mask > 0], golden["normals"])
    assert np.max(error) <= 0.02


def summed_loss(network, golden):
    """The loss as the authors sum it, over all masked pixels, without dropout."""
    loss, _ = training_loss(
        network,
        Objects(golden["images"], golden["mask"] > 0, golden["normals"]),
        jax.random.split(jax.random.key(0), len(golden["images"])),
        LossOptions(num_pixels=48 * 48),
        deterministic=True,
    )
    return loss * len(golden["images"])


@pytest.fixture(scope="module")
def golden_loss(shared_dir):
    with np.load(shared_dir / "golden/unips_official_loss.npz") as arrays:
        return dict(arrays)


@pytest.mark.slow
def test_loss_and_gradients(official, golden_loss):
    """Every gradient norm to 1e-4, but for a few of the encoder's to 2e-4.

    (Of a small network `tests/golden` keeps both as they are here.)

    In float64 these deviate by the same 1.5e-4: it is the reference's rounding, at an
    activation next to a ReLU's kink. The norms of the key biases are rounding alone:
    a constant added to all keys drops out of the softmax.
    """
    config = dataclasses.replace(official.config, remat=True)
    run = jax.jit(jax.value_and_grad(lambda net: summed_loss(net, golden_loss)))
    loss, found = run(dataclasses.replace(official, config=config))
    np.testing.assert_allclose(loss, golden_loss["loss"], rtol=1e-4)
    gradients = flatten_dict(found.params, sep=".")
    loose = 0
    for key, norm in zip(
        golden_loss["grad_names"], golden_loss["grad_norms"], strict=True
    ):
        actual = float(jnp.linalg.norm(gradients[official_name(str(key))]))
        if norm < 1e-6:
            assert actual < 1e-6, key
            continue
        error = abs(actual - norm) / norm
        assert error <= (2e-4 if key.startswith("encoder.") else 1e-4), key
        loose += error > 1e-4
    assert loose <= 12
