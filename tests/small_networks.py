"""Networks small enough to compile in seconds, for several test files."""

import dataclasses

import jax

from unips_jax.config import ModelConfig
from unips_jax.weights import random_weights

SMALL = ModelConfig(
    canonical_size=16,
    patch_channels=(3, 5),
    embed_dim=8,
    depths=(1, 1),
    num_heads=(2, 4),
    window_size=2,
    communication_heads=4,
    context_dim=8,
    pool_scales=(1, 2),
    aggregation_layers=1,
    hidden_dim=12,
    aggregation_heads=3,
    aggregation_mlp_dim=13,
    pma_mlp_dim=11,
    predictor_dim=5,
    drop_path_rate=0.0,
    dropout_rate=0.0,
)


def lively_weights(config=SMALL):
    return lively(random_weights(config))


def lively(params):
    """Larger parameters than the initial ones, so that every path matters."""
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(3), len(leaves))
    noisy = [
        x + 0.3 * jax.random.normal(k, x.shape)
        for x, k in zip(leaves, keys, strict=True)
    ]
    return jax.tree.unflatten(tree, noisy)


def with_dtype(config, dtype):
    return dataclasses.replace(config, dtype=dtype)
