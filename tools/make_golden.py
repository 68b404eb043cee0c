"""Writes `tests/golden`: what a small network computes today, so that it stays so.

    python tools/make_golden.py [-o tests/golden]

One file for each arithmetic of set attention, and one for our network with its parts.
Weights and inputs follow from their names alone; the files hold contexts, normals, the
loss and (not of ours) the norm of its gradient with respect to every parameter. Run it
again only for a change that is meant to change results. (That the network is the
authors' is checked against their own arrays, `unips_official.npz` next to them, in
`tests/use/test_official_parity.py`.)
"""

import argparse
import math
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from unips_jax import estimate_normals
from unips_jax.console import command
from unips_jax.models.config import ModelConfig, SelfCalibratingConfig, UniPSConfig
from unips_jax.models.network import UniversalNetwork, encode, init_params
from unips_jax.models.views import make_views, normalize_images
from unips_jax.training.loss import LossOptions, Objects, training_loss

_SMALL: dict[str, Any] = dict(
    canonical_size=16,
    patch_channels=(3, 5),
    embed_dim=8,
    depths=(1, 2),
    num_heads=(2, 4),
    window_size=3,
    communication_heads=4,
    context_dim=8,
    pool_scales=(1, 2),
    aggregation_layers=2,
    hidden_dim=12,
    aggregation_heads=3,
    aggregation_mlp_dim=13,
    pma_mlp_dim=11,
    predictor_dim=5,
)
CONFIGS: dict[str, ModelConfig] = {
    "pre_norm": UniPSConfig(**_SMALL, attention="pre_norm", context_sampling="center"),
    "released": UniPSConfig(**_SMALL, attention="released", context_sampling="corner"),
    "self_calibrating": SelfCalibratingConfig(
        **_SMALL,
        ratio_dim=2,
        consensus_blocks=2,
        consensus_dim=32,
        observation_dim=4,
        fine_dim=5,
        light_tokens=True,
        known_lights=True,
    ),
}


def draw(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Normal numbers that follow from a name."""
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    return generator.standard_normal(shape).astype(np.float32)


def golden_arrays(config: ModelConfig) -> dict[str, np.ndarray]:
    """What is kept of a network.

    Args:
        config: of the network.

    Returns:
        Arrays by name: "contexts" `[N, s/4, s/4, C]`, "normals" `[H, W, 3]`, "loss",
        and "gradient/..." for the norms.
    """
    shapes = jax.eval_shape(lambda key: init_params(config, key), jax.random.key(0))
    flat = {}
    for name, shape in flatten_dict(shapes, sep="/").items():
        value = draw(name, shape.shape)
        if len(shape.shape) == 1:
            value = 0.1 * value + name.endswith("scale")
        else:
            value = value / math.sqrt(math.prod(shape.shape[:-1]))
        flat[name] = value
    network = UniversalNetwork(config, unflatten_dict(flat, sep="/"))

    images = np.abs(draw("images", (3, 18, 24, 3)))
    mask = draw("mask", (18, 24)) > -1
    normals = draw("normals", (18, 24, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals *= mask[..., None]  # what is outside does not count
    lights = draw("lights", (3, 3))
    lights = lights / np.linalg.norm(lights, axis=-1, keepdims=True)
    known = lights if config.guesses else None

    @jax.jit
    def contexts(network):
        inside = jnp.asarray(mask)
        views = make_views(normalize_images(images, inside), inside, config)
        return jnp.moveaxis(encode(network, views).contexts[0], 2, 0)

    def loss(network):
        one = jnp.asarray(images), jnp.asarray(mask), jnp.asarray(normals)
        objects = Objects(one[0][None], one[1][None], one[2][None])
        if known is not None:
            given = jnp.asarray(known)[None]
            objects = objects._replace(lights=given, known_lights=given)
        keys = jax.random.split(jax.random.key(0), 1)
        grid_loss = known is None  # ours has none beside its fine contexts
        options = LossOptions(num_pixels=mask.size, grid_loss=grid_loss)
        return training_loss(network, objects, keys, options, deterministic=True)[0]

    norms = {}
    if known is None:
        value, gradients = jax.jit(jax.value_and_grad(loss))(network)
        norms = {
            f"gradient/{name}": np.linalg.norm(gradient)
            for name, gradient in flatten_dict(gradients.params, sep="/").items()
        }
    else:  # ours takes long to differentiate
        value = jax.jit(loss)(network)
    arrays = {
        "contexts": contexts(network),
        "normals": estimate_normals(network, images, mask, lights=known),
        "loss": value,
    }
    return {name: np.asarray(x, np.float32) for name, x in (arrays | norms).items()}


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Writes the files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("tests/golden"))
    folder = parser.parse_args(argv).output
    folder.mkdir(parents=True, exist_ok=True)
    for name, config in CONFIGS.items():
        arrays = golden_arrays(config)
        np.savez_compressed(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    raise SystemExit(main())
