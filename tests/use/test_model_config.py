"""Configurations of networks: refused, and kept as JSON."""

import dataclasses
import re

import pytest
from small_networks import SMALL, SMALL_OURS

from unips_jax.models.config import ModelConfig
from unips_jax.models.config_json import from_json, to_json


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"canonical_size": 30}, "canonical_size"),
        ({"canonical_size": 10**6}, "canonical_size: expected at most"),
        ({"num_heads": (3, 6)}, "num_heads"),
        ({"num_heads": (5, 6, 12, 24)}, "num_heads[0]"),
        ({"communication_heads": 7}, "communication_heads"),
        ({"communication": "post", "context_dim": 100}, "communication_heads"),
        ({"aggregation_heads": 7}, "aggregation_heads"),
        ({"attention": "mine"}, "attention: expected one of ('pre_norm', 'released')"),
        ({"dropout_rate": 1.5}, "dropout_rate"),
        ({"mlp_ratio": float("nan")}, "mlp_ratio: expected finite numbers"),
        ({"depths": (2, 0, 4, 2)}, "depths"),
        ({"depths": (10**7, 2, 2, 2)}, "depths: expected one to eight numbers"),
        ({"depths": [2, 2, 18, 2]}, "depths: expected tuple[int, ...], got [2"),
        ({"pool_scales": 3}, "pool_scales: expected tuple[int, ...], got 3"),
        ({"num_heads": (3, 6, 12, 0)}, "num_heads: expected one to eight numbers"),
        ({"num_heads": (3, 6, 12, 2.5)}, "num_heads: expected tuple[int, ...]"),
        ({"patch_channels": (48,)}, "patch_channels: expected tuple[int, int]"),
        ({"aggregation_layers": -1}, "aggregation_layers"),
        ({"embed_dim": "96"}, "embed_dim: expected int, got '96'"),
    ],
)
def test_configuration_errors_name_the_field(changes, field):
    with pytest.raises(ValueError, match=re.escape(field)):
        dataclasses.replace(ModelConfig.paper(), **changes)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"ratio_dim": 0}, "ratio_dim"),
        ({"observation_dim": -1}, "observation_dim"),
        ({"consensus_blocks": 0}, "consensus_blocks"),
        ({"consensus_dim": 48}, "consensus_dim: expected a multiple of 32, got 48"),
    ],
)
def test_our_configuration_errors_name_the_field(changes, field):
    with pytest.raises(ValueError, match=field):
        dataclasses.replace(ModelConfig.tiny(), **changes)


def test_no_network_is_between_the_two():
    """What the one has, the other does not take; what they share is no network."""
    with pytest.raises(TypeError, match="communication"):
        dataclasses.replace(ModelConfig.tiny(), communication="pre")
    with pytest.raises(TypeError, match="ratio_dim"):
        dataclasses.replace(ModelConfig.paper(), ratio_dim=4)
    with pytest.raises(ValueError, match="expected one of the networks"):
        ModelConfig()


@pytest.mark.parametrize("config", [SMALL, SMALL_OURS], ids=["paper", "ours"])
def test_configuration_survives_json(config):
    assert from_json(ModelConfig, to_json(config)) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"network": "unips", "canonical_sice": 3}', "unknown fields"),
        ('{"canonical_size": 96}', "expected a network, one of .* another version"),
        ('{"network": ["unips"]}', "expected a network, one of"),
        ("[]", "expected a JSON object"),
        ("[" * 10**5, "too deep a nest"),
    ],
)
def test_configurations_of_others_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        from_json(ModelConfig, text)
