"""Network parameters: released files, the authors' checkpoints, untrained ones.

A weights file is a safetensors file with the parameters' paths as names and, in its
metadata, the `ModelConfig` and a record of how they were made. Half precision in the
file becomes float32 in memory.
"""

import functools
import hashlib
import importlib.resources
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from unips_jax.config import ModelConfig, from_json, to_json
from unips_jax.errors import InputError
from unips_jax.io.claims import write_whole
from unips_jax.models.unips import UniPS

Params = dict[str, Any]

_ASSETS = Path(str(importlib.resources.files("unips_jax"))) / "assets"
SHIPPED = ("tiny",)

# What the authors' weights need; sizes are the paper's.
OFFICIAL_CONFIG = ModelConfig(
    attention="released", aggregation_layers=4, context_sampling="corner"
)

# The authors' names as patterns, each with the path of the parameter here. Tables of
# (pattern, replacement); later entries see the results of earlier ones.
_OFFICIAL_NAMES = (
    (r"^(\w+)\.(?:module\.)?", r"\1."),
    (r"^encoder\.attn\.(\d+)\.0\.mab\.", r"encoder.communications_\1."),
    (r"^encoder\.backbone\.0\.", "encoder."),
    (r"patch_embed\.convs\.(\d+)\.conv\.0\.", r"patch_embed.conv\1."),
    (r"layers\.(\d+)\.blocks\.(\d+)\.", r"stages_\1.block\2."),
    (r"\.mlp\.(fc[12])\.", r".\1."),
    (r"layers\.(\d+)\.downsample\.", r"mergings_\1."),
    (r"^encoder\.norm(\d+)\.", r"encoder.norms_\1."),
    (r"^encoder\.fusion\.0\.", "encoder.fusion."),
    (r"psp_modules\.(\d+)\.1\.", r"ppm\1."),
    (r"fusion\.bottleneck\.0\.", "fusion.ppm_bottleneck."),
    (r"lateral_convs\.(\d+)\.0\.", r"lateral\1."),
    (r"fpn_convs\.(\d+)\.0\.", r"fpn\1."),
    (r"fpn_bottleneck\.0\.", "fpn_bottleneck."),
    (r"^aggregation\.enc\.(\d+)\.mab\.", r"decoder.layers_\1."),
    (r"^aggregation\.dec\.0\.mab\.", "decoder.pooling."),
    (r"^aggregation\.dec\.0\.S$", "decoder.pooling.seeds"),
    (r"^prediction\.regression\.0\.", "decoder.fc1."),
    (r"^prediction\.regression\.2\.", "decoder.fc2."),
    (r"\.fc_q\.", ".query."),
    (r"\.fc_k\.", ".key."),
    (r"\.fc_v\.", ".value."),
    (r"\.ln0\.", ".norm."),
    (r"\.ln1\.", ".mlp.norm."),
    (r"\.fc_o([12])\.", r".mlp.fc\1."),
    (r"(norm\w*)\.weight$", r"\1.scale"),
    (r"\.weight$", ".kernel"),
)
_OFFICIAL_IGNORED = "relative_position_index"


def official_name(key: str) -> str:
    """The path of a parameter here, from its name in the authors' checkpoint."""
    for pattern, replacement in _OFFICIAL_NAMES:
        key = re.sub(pattern, replacement, key)
    return key


def from_official(arrays: Mapping[str, np.ndarray]) -> tuple[ModelConfig, Params]:
    """Converts the authors' parameters.

    Args:
        arrays: their arrays under the names of their three state dicts, prefixed
            "encoder.", "aggregation." and "prediction."; with or without "module.".
            Linear weights are `[out, in]`, convolutions `[out, in, kh, kw]`.

    Returns:
        The configuration they need, and the parameters.

    Raises:
        InputError: naming all missing, unexpected and misshapen keys at once.
    """
    expected = _flat_shapes(OFFICIAL_CONFIG)
    converted, unexpected, misshapen = {}, [], []
    for key, array in arrays.items():
        if key.endswith(_OFFICIAL_IGNORED):
            continue
        name = official_name(key)
        if name not in expected or name in converted:
            unexpected.append(key)
            continue
        value = _from_torch_layout(name, np.asarray(array))
        if value.shape != expected[name]:
            misshapen.append(f"{key} {array.shape} (as {name}: {expected[name]})")
        converted[name] = value.astype(np.float32)
    missing = sorted(set(expected) - set(converted))
    _raise_all("official weights", missing, unexpected, misshapen)
    return OFFICIAL_CONFIG, unflatten_dict(converted, sep=".")


def _from_torch_layout(name: str, array: np.ndarray) -> np.ndarray:
    if name.endswith("seeds"):
        return array.reshape(array.shape[-2:])
    if name.endswith("kernel") and array.ndim == 4:
        return array.transpose(2, 3, 1, 0)
    if name.endswith("kernel") and array.ndim == 2:
        return array.T
    return array


def load_weights(source: str | os.PathLike[str]) -> tuple[ModelConfig, Params]:
    """Reads released weights.

    Args:
        source: the name of shipped weights, such as "tiny", or a safetensors file.

    Returns:
        The network's configuration and its parameters, float32.

    Raises:
        InputError: if there are none of that name, or the file is not of this kind.
    """
    path = weights_path(source)
    metadata, arrays = _read(path)
    try:
        config = from_json(ModelConfig, metadata["config"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: expected a ModelConfig as JSON in the metadata's 'config', got "
            f"{error!r}; was this file written by unips_jax?"
        ) from error
    expected = _flat_shapes(config)
    misshapen = [
        f"{name} {array.shape} (expected {expected[name]})"
        for name, array in arrays.items()
        if name in expected and array.shape != expected[name]
    ]
    missing = sorted(set(expected) - set(arrays))
    _raise_all(str(path), missing, sorted(set(arrays) - set(expected)), misshapen)
    params = {name: jnp.asarray(array, jnp.float32) for name, array in arrays.items()}
    return config, unflatten_dict(params, sep=".")


def weights_path(source: str | os.PathLike[str]) -> Path:
    """The file behind a name of shipped weights, or behind a path.

    Raises:
        InputError: if there is no such file.
    """
    path = Path(source)
    if path.suffix == ".safetensors":
        if path.is_file():
            return path
        raise InputError(f"{path}: expected a weights file, found nothing there")
    if str(source) in SHIPPED:
        return _ASSETS / f"{source}.safetensors"
    raise InputError(
        f"weights {str(source)!r}: expected the path of a .safetensors file or one of "
        f"the shipped {SHIPPED}. Train some with `unips train`, or convert the "
        "authors' with tools/convert_official.py"
    )


def weights_record(source: str | os.PathLike[str]) -> dict[str, Any]:
    """How weights were made: training record and score, with their `params_hash`."""
    metadata, _ = _read(weights_path(source))
    record = json.loads(metadata.get("record", "{}"))
    return {**record, "hash": params_hash(*load_weights(source))}


def save_weights(
    path: str | os.PathLike[str],
    config: ModelConfig,
    params: Params,
    *,
    record: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Writes weights; the file is complete or absent.

    Args:
        path: a .safetensors file.
        config: the network's configuration.
        params: its parameters.
        record: how they were made, anything JSON can hold.
        half: store float16.

    Raises:
        InputError: if it cannot be written.
    """
    dtype = np.float16 if half else np.float32
    arrays = {
        name: np.ascontiguousarray(array, dtype)
        for name, array in flatten_dict(params, sep=".").items()
    }
    metadata = {"config": to_json(config), "record": json.dumps(dict(record or {}))}
    write_whole(Path(path), save(arrays, metadata))


def params_hash(config: ModelConfig, params: Params) -> str:
    """A hash of a network's configuration and parameters.

    Args:
        config: the network's.
        params: its parameters.
    """
    digest = hashlib.blake2b(to_json(config).encode(), digest_size=16)

    def add(path: str, value: Any) -> None:
        if isinstance(value, dict):
            for name in sorted(value):
                add(f"{path}/{name}", value[name])
            return
        array = np.ascontiguousarray(value)
        digest.update(f"{path}:{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())

    add("", params)
    return digest.hexdigest()


def random_weights(config: ModelConfig, *, seed: int = 0) -> Params:
    """Untrained parameters, as training starts from."""
    return jax.jit(functools.partial(init_params, config))(jax.random.key(seed))


def init_params(config: ModelConfig, key: jax.Array) -> Params:
    """Initialises the network; pure, so that it can be jitted or shape-evaluated."""
    size = config.canonical_size
    images, pixels = jnp.zeros((1, size, size, 4)), jnp.zeros((1, 1, 3))
    places = jnp.zeros(1)
    return UniPS(config).init(key, images, pixels, places, places)["params"]


def _flat_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    shapes = jax.eval_shape(lambda key: init_params(config, key), jax.random.key(0))
    return {k: v.shape for k, v in flatten_dict(shapes, sep=".").items()}


def _read(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    try:
        with safe_open(path, framework="np") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return file.metadata() or {}, arrays
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: expected a safetensors file, got: {error}"
        ) from error


def _raise_all(
    source: str, missing: list[str], unexpected: list[str], misshapen: list[str]
) -> None:
    problems = {"missing": missing, "unexpected": unexpected, "misshapen": misshapen}
    found = [f"{len(v)} {k}: {', '.join(v)}" for k, v in problems.items() if v]
    if found:
        raise InputError(f"{source}: parameters do not fit. {'; '.join(found)}")
