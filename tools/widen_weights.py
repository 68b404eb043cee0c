"""Widens the shipped weights: twice the channels, almost the same function.

    python tools/widen_weights.py tiny -o begin.safetensors

A run of `configs/small.py` begins from them (`--init-weights`). Every channel becomes
two that carry the same; a kernel's rows for the two sum to what the one row was. They
differ by random numbers, so that training tells the two channels apart. Windows and the
encoder's images become those of `ModelConfig.small`, tables of relative positions are
stretched linearly. What differs then is the larger image, and the weight of a pixel's
three colours in one LayerNorm.

Source: Samragh et al., "Scaling Smart: Accelerating Large Language Model Pre-training
with Small Model Initialization", 2024.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.models.config import ModelConfig
from unips_jax.models.light_tokens import TOKENS
from unips_jax.models.network import Params, UniversalNetwork, param_shapes
from unips_jax.weights import load_weights, save_weights, weights_record

_SPREAD = 0.5  # of the rows of two equal channels, see `_widen_kernel`

# A part of an axis: how many channels, and whether they double.
Part = tuple[int, bool]

# Layers whose outputs do not double: normals, lights and kinds of light.
_GUESSES = ("normals", "lights", "around", "near", "distant")


def _parts_in(layer: str, size: int, width: int) -> list[Part]:
    """What an input's channels are made of: pixels' values, or features in rows.

    Args:
        layer: path of the layer.
        size: channels.
        width: channels of the contexts.
    """
    name = layer.rsplit(".", 1)[-1]
    if name in ("conv0", "place", "embed"):
        return [(size, False)]
    if "layer0." in layer and size == 3 + width:
        return [(3, False), (width, True)]
    if name == "fpn_bottleneck":
        return [(width, True)] * (size // width)
    if name == "ppm_bottleneck":
        return [(size - 2 * width, True), (width, True), (width, True)]
    if layer.endswith("tokens.change"):
        return [(size // TOKENS, True)] * TOKENS
    if "merging" in layer:
        return [(size // 4, True)] * 4
    if name in ("pooled", "pooled_lit", "whole"):
        return [(size // 2, True)] * 2
    return [(size, True)]


def _parts_out(layer: str, size: int) -> list[Part]:
    """What an output's channels are made of; arguments as in `_parts_in`."""
    name = layer.rsplit(".", 1)[-1]
    if name in _GUESSES or layer.endswith("prediction.fc2"):
        return [(size, False)]
    two = name == "known" or layer.endswith("observation.change")
    count = 3 if name == "qkv" else 2 if two else 1
    return [(size // count, True)] * count


def _index(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """For every wide channel its narrow one, and a sign: 1, -1, or 0 for no twin."""
    index, sign, first = [], [], 0
    for size, doubles in parts:
        own = np.arange(first, first + size)
        index += [own, own] if doubles else [own]
        sign += [np.ones(size), -np.ones(size)] if doubles else [np.zeros(size)]
        first += size
    return np.concatenate(index), np.concatenate(sign)


def _widen_kernel(
    kernel: np.ndarray,
    rows: Sequence[Part],
    columns: Sequence[Part],
    random: np.random.Generator,
    spread: float,
) -> np.ndarray:
    """A kernel `[..., in, out]` between doubled channels, `[..., 2 in, 2 out]`.

    Args:
        kernel: of the narrow network.
        rows: what its inputs are made of; those that do not double keep their rows.
        columns: the same of its outputs.
        random: tells the rows of equal channels apart.
        spread: how much, in standard deviations of the kernel.
    """
    narrow, sign = _index(rows)
    column, _ = _index(columns)
    share = np.where(sign == 0, 1.0, 0.5)[:, None]
    wide = kernel[..., column][..., narrow, :] * share
    shape = (*kernel.shape[:-1], column.size)
    apart = random.normal(0, 0.5 * spread * kernel.std(), shape)
    return (wide + sign[:, None] * apart[..., narrow, :]).astype(np.float32)


def widen(params: Params, width: int, window: int, seed: int = 0) -> Params:
    """The parameters of a network twice as wide.

    Args:
        params: of the narrow one.
        width: channels of its contexts.
        window: the wide network's window size.
        seed: of what tells equal channels apart.
    """
    random = np.random.default_rng(seed)
    wide = {
        name: _widen(name, np.asarray(value), width, window, random)
        for name, value in flatten_dict(params, sep=".").items()
    }
    return unflatten_dict(wide, sep=".")


def _widen(
    name: str,
    value: np.ndarray,
    width: int,
    window: int,
    random: np.random.Generator,
) -> np.ndarray:
    """One parameter of the wide network; `name` is its path, `value` the narrow one."""
    layer, kind = name.rsplit(".", 1)
    if kind == "relative_position_bias_table":
        side = int(value.shape[0] ** 0.5)
        size = (2 * window - 1,) * 2
        square = cv2.resize(value.reshape(side, side, -1), size)
        return np.tile(square.reshape(-1, value.shape[1]), 2)
    if kind == "kernel":
        rows = _parts_in(layer, value.shape[-2], width)
        columns = _parts_out(layer, value.shape[-1])
        # Lights that are known move features by this kernel's pseudoinverse: equal
        # rows keep that the same.
        spread = 0.0 if layer.endswith("consensus.lights") else _SPREAD
        return _widen_kernel(value, rows, columns, random, spread)
    size, name = value.shape[-1], layer.rsplit(".", 1)[-1]
    norm = name.startswith("norm") and name != "normals"
    parts = _parts_in(layer, size, width) if norm else _parts_out(layer, size)
    return value[..., _index(parts)[0]]


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Reads, widens, writes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("weights", help="shipped name or file of narrow weights")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    narrow, small = load_weights(arguments.weights), ModelConfig.small()
    wide = widen(
        narrow.params, narrow.config.context_dim, small.window_size, arguments.seed
    )
    shapes = {name: x.shape for name, x in flatten_dict(wide, sep=".").items()}
    if shapes != param_shapes(small):
        raise InputError(
            f"{arguments.weights}: expected weights half as wide as `small`, such as "
            "tiny, got others"
        )
    record = {"widened": weights_record(arguments.weights)["hash"]}
    save_weights(arguments.output, UniversalNetwork(small, wide), record=record)
    print(f"wrote {arguments.output}")


if __name__ == "__main__":
    raise SystemExit(main())
