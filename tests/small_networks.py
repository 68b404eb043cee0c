"""Networks small enough to compile in seconds, for several test files."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from unips_jax.models.config import SelfCalibratingConfig, UniPSConfig
from unips_jax.models.network import UniversalNetwork, init_params

_SIZES = dict(
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
SMALL = UniPSConfig(**_SIZES)
SMALL_OURS = SelfCalibratingConfig(
    **_SIZES, ratio_dim=2, consensus_blocks=2, consensus_dim=32, observation_dim=4
)
# They compile in three quarters of the time: one stage of the backbone.
SHALLOW = dataclasses.replace(SMALL, depths=(1,), num_heads=(2,))
SHALLOW_OURS = dataclasses.replace(SMALL_OURS, depths=(1,), num_heads=(2,))


def lively_weights(config=SMALL):
    return _drawn(_layout(config))


def lively_network(config=SMALL):
    return UniversalNetwork(config, lively_weights(config))


@functools.cache
def _layout(config):
    return jax.eval_shape(lambda key: init_params(config, key), jax.random.key(0))


def lively(init, *arguments):
    """Parameters larger than those `init` gives, so that every path matters."""
    return _drawn(jax.eval_shape(init, jax.random.key(0), *arguments))


def _drawn(shapes):
    """By NumPy: compiling an initialisation takes longer than most tests."""
    generator = np.random.default_rng(3)

    def draw(path, shape):
        value = 0.3 * generator.standard_normal(shape.shape)
        return jnp.asarray(value + (path[-1].key == "scale"), shape.dtype)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def with_dtype(config, dtype):
    return dataclasses.replace(config, dtype=dtype)
