"""Parameters of other networks, drawn as the reference arrays' were."""

import json
import math
import zlib
from pathlib import Path

import numpy as np

from unips_jax.baselines.gcnet import parameters as gcnet_weights

GOLDEN = Path(__file__).parent / "golden"


def official_arrays() -> dict[str, np.ndarray]:
    """The deterministic weights the golden arrays were made with."""
    shapes = json.loads((GOLDEN / "unips_official_keys.json").read_text())
    arrays = {}
    for key, shape in shapes.items():
        x = np.random.default_rng(zlib.crc32(key.encode())).standard_normal(shape)
        x = x.astype(np.float32)
        if len(shape) == 1:
            x = 1 + 0.1 * x if key.endswith(".weight") else 0.05 * x
        elif "relative_position_bias_table" in key:
            x = 0.1 * x
        else:
            x = x / math.sqrt(math.prod(shape[1:]))
        arrays[key] = x.astype(np.float32)
    return arrays


def made_up(network, *, gain=2**0.5, out_gain=8.0):
    """The authors' arrays, by the reference's recipe R2 (R1: both gains 1)."""
    arrays = {}
    for key, shape, *_ in gcnet_weights._entries(network):
        rng = np.random.default_rng(zlib.crc32(key.encode()))
        array = rng.standard_normal(shape)
        if key.endswith("_step"):
            array = np.arange(shape[0])
        elif len(shape) == 1:
            array *= 0.05
        else:
            array *= gain / np.sqrt(np.prod(shape[1:]))
            array *= out_gain if key.endswith("_est.1.0.weight") else 1
        arrays[key] = array.astype(np.float32)
    return arrays
