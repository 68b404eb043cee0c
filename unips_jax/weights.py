"""Files of network parameters: released ones, and those of training runs.

A weights file is a safetensors file with the parameters' paths as names and, in its
metadata, the network's configuration, a record of how they were made, and a hash that
is checked on reading. Half precision in the file becomes float32 in memory. Files of
equal contents are equal bytes.
"""

import hashlib
import importlib.resources
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from unips_jax.errors import InputError
from unips_jax.io.door import write_whole
from unips_jax.models.config import ModelConfig
from unips_jax.models.config_json import from_json, to_json
from unips_jax.models.network import (
    UniversalNetwork,
    init_params,
    param_shapes,
    raise_misfits,
)

_ASSETS = Path(str(importlib.resources.files("unips_jax"))) / "assets"
SHIPPED = ("tiny",)
# What float16 holds; those of trained networks are below 100.
_LARGEST = float(np.finfo(np.float16).max)


def load_weights(source: str | os.PathLike[str]) -> UniversalNetwork:
    """Reads released weights.

    Args:
        source: the name of shipped weights, such as "tiny", or a safetensors file.

    Returns:
        The network; its parameters are float32, on the default device.

    Raises:
        InputError: if there are none of that name, or the file is not of this kind or
            damaged.
    """
    path = weights_path(source)
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            config = _read_config(path, metadata)
            # The shipped ones are known to fit; laying a network out takes seconds.
            if str(source) not in SHIPPED:
                _check_parameters(path, config, file)
            arrays = {
                name: np.asarray(file.get_tensor(name), np.float32)
                for name in file.keys()
            }
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: expected a safetensors file, got: {error}"
        ) from error
    if metadata.get("hash") != _hash(metadata["config"], arrays):
        raise InputError(
            f"{path}: damaged: its parameters are not those of its hash "
            f"{metadata.get('hash')!r:.40}; fetch the file again"
        )
    _check_values(path, arrays)
    # Not `jnp.asarray`: it compiles a program for every shape.
    return UniversalNetwork(config, unflatten_dict(jax.device_put(arrays), sep="."))


def _read_config(path: Path, metadata: Mapping[str, str]) -> ModelConfig:
    try:
        return from_json(ModelConfig, metadata["config"])
    except (KeyError, ValueError) as error:
        reason = "no such entry" if isinstance(error, KeyError) else error
        raise InputError(
            f"{path}: expected a ModelConfig as JSON in the metadata's 'config', got: "
            f"{reason}"
        ) from error


def _check_values(
    path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]
) -> None:
    for name, array in arrays.items():
        largest = np.abs(array).max(initial=0)  # NaN if there is one
        if not largest <= _LARGEST:
            raise InputError(
                f"{path}: {name}: expected parameters of at most {_LARGEST:.0f}, got "
                f"{largest:.3g}; take weights of an earlier step"
            )


def _check_parameters(path: Path, config: ModelConfig, file: Any) -> None:
    """Compares names, shapes and types, which need no parameter to be read."""
    stored = {name: file.get_slice(name) for name in file.keys()}
    if config.num_blocks > len(stored):  # such a network would take long to lay out
        raise InputError(
            f"{path}: expected the parameters of {config.num_blocks} blocks, got "
            f"{len(stored)} arrays"
        )
    expected = param_shapes(config)
    misshapen = []
    for name in sorted(set(stored) & set(expected)):
        shape, kind = tuple(stored[name].get_shape()), stored[name].get_dtype()
        if shape != expected[name] or kind not in ("F16", "F32"):
            misshapen.append(
                f"{name} {shape} {kind} (expected {expected[name]}, F16 or F32)"
            )
    missing = sorted(set(expected) - set(stored))
    raise_misfits(str(path), missing, sorted(set(stored) - set(expected)), misshapen)


def _check_shapes(
    path: str | os.PathLike[str], config: ModelConfig, arrays: Mapping[str, np.ndarray]
) -> None:
    expected = param_shapes(config)
    misshapen = [
        f"{name} {arrays[name].shape} (expected {expected[name]})"
        for name in sorted(set(arrays) & set(expected))
        if arrays[name].shape != expected[name]
    ]
    missing = sorted(set(expected) - set(arrays))
    raise_misfits(str(path), missing, sorted(set(arrays) - set(expected)), misshapen)


def weights_path(source: str | os.PathLike[str]) -> Path:
    """The file behind a name of shipped weights, or behind a path."""
    if str(source) in SHIPPED:
        return _ASSETS / f"{source}.safetensors"
    path = Path(source)
    if path.is_file():
        return path
    if path.suffix == ".safetensors":
        raise InputError(f"{path}: expected a weights file, found nothing there")
    raise InputError(
        f"weights {str(source)!r}: expected the path of a .safetensors file or one of "
        f"the shipped {SHIPPED}. Train some with `unips train`, or convert the "
        "authors' with tools/convert_official.py"
    )


def weights_record(source: str | os.PathLike[str]) -> dict[str, Any]:
    """How weights were made: training record and score, with their `weights_hash`."""
    path = weights_path(source)
    digest = weights_hash(load_weights(path))
    with safe_open(path, framework="np") as file:
        text = file.metadata().get("record", "{}")
    try:
        return {**json.loads(text), "hash": digest}
    except (TypeError, ValueError, RecursionError):
        raise InputError(
            f"{path}: expected a JSON object in the metadata's 'record', got "
            f"{text!r:.60}"
        ) from None


def save_weights(
    path: str | os.PathLike[str],
    network: UniversalNetwork,
    *,
    record: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Writes weights, a .safetensors file that is complete or absent.

    `record` is how they were made, anything JSON can hold; `half` stores float16.
    `InputError` for parameters that `load_weights` refuses; the file stays as it was.
    """
    if str(path) in SHIPPED:
        raise InputError(
            f"{path}: expected another name than those of shipped weights, which "
            "`load_weights` reads by it; add .safetensors"
        )
    dtype = np.float16 if half else np.float32
    arrays = {
        name: np.ascontiguousarray(array, dtype)
        for name, array in flatten_dict(network.params, sep=".").items()
    }
    _check_shapes(path, network.config, arrays)
    _check_values(path, arrays)
    text = to_json(network.config)
    metadata = {
        "config": text,
        "hash": _hash(text, arrays),
        "record": json.dumps(dict(record or {}), sort_keys=True),
    }
    write_whole(Path(path), _in_order(save(arrays, metadata)))


def _in_order(data: bytes) -> bytes:
    """A safetensors file with its header in order: the library's varies."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:start])
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[start:]


def weights_hash(network: UniversalNetwork) -> str:
    """A hash of a network's configuration and parameters."""
    return _hash(to_json(network.config), flatten_dict(network.params, sep="."))


def _hash(config: str, arrays: Mapping[str, Any]) -> str:
    """Of the configuration's text, and of the parameters as float32, by name."""
    digest = hashlib.blake2b(config.encode(), digest_size=16)
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name], np.float32)
        digest.update(f"{name}{array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def random_weights(config: ModelConfig, *, seed: int = 0) -> UniversalNetwork:
    """An untrained network, as training starts from."""
    initial = jax.jit(init_params, static_argnums=0)
    return UniversalNetwork(config, initial(config, jax.random.key(seed)))
