"""Writes `tests/golden`: what a small network computes today, so that it stays so.

    python tools/make_golden.py [-o tests/golden]

One file for each arithmetic of set attention. Weights and inputs follow from their
names alone; the files hold contexts, normals, the loss and the norm of its gradient
with respect to every parameter. Run it again only for a change that is meant to change
results. (That the network is the authors' is checked against their own arrays,
`unips_official.npz` beside them, in `tests/use/test_official_parity.py`.)
"""

import argparse
import math
import zlib
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from unips_jax import estimate_normals
from unips_jax.console import command
from unips_jax.estimation.frame import canonical_images, normalize_images, square_frame
from unips_jax.estimation.pure import encode
from unips_jax.models.config import UniPSConfig
from unips_jax.models.network import init_params
from unips_jax.training.loss import training_loss

CONFIGS = {
    attention: UniPSConfig(
        canonical_size=16,
        patch_channels=(3, 5),
        embed_dim=8,
        depths=(1, 2),
        num_heads=(2, 4),
        window_size=3,
        communication_heads=4,
        context_dim=8,
        pool_scales=(1, 2),
        attention=attention,  # type: ignore[arg-type]
        aggregation_layers=2,
        hidden_dim=12,
        aggregation_heads=3,
        aggregation_mlp_dim=13,
        pma_mlp_dim=11,
        predictor_dim=5,
        context_sampling=sampling,  # type: ignore[arg-type]
    )
    for attention, sampling in (("pre_norm", "center"), ("released", "corner"))
}


def draw(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Normal numbers that follow from a name."""
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    return generator.standard_normal(shape).astype(np.float32)


def golden_arrays(config: UniPSConfig) -> dict[str, np.ndarray]:
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
    params = unflatten_dict(flat, sep="/")

    images = np.abs(draw("images", (3, 18, 24, 3)))
    mask = draw("mask", (18, 24)) > -1
    normals = draw("normals", (18, 24, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)

    @jax.jit
    def contexts(params):
        frame = square_frame(mask)
        normalised = normalize_images(jnp.asarray(images), jnp.asarray(mask))
        inputs = canonical_images(
            normalised, jnp.asarray(mask), frame, config.canonical_size
        )
        return encode(params, inputs, config=config)

    @jax.jit
    def loss(params):
        return jax.value_and_grad(
            lambda params: training_loss(
                params,
                jnp.asarray(images)[None],
                jnp.asarray(mask)[None],
                jnp.asarray(normals)[None],
                jax.random.split(jax.random.key(0), 1),
                config=config,
                num_pixels=mask.size,
                deterministic=True,
            )[0]
        )(params)

    value, gradients = loss(params)
    norms = {
        f"gradient/{name}": np.linalg.norm(gradient)
        for name, gradient in flatten_dict(gradients, sep="/").items()
    }
    arrays = {
        "contexts": contexts(params),
        "normals": estimate_normals(params, images, mask, config=config),
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
