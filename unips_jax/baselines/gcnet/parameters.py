"""Parameters of GCNet, PS-FCN and LCNet: the authors' arrays, and files of our own.

The authors' checkpoints are dictionaries with one entry `state_dict`; read one without
executing it (`torch.load(path, weights_only=True)`), turn its tensors into NumPy arrays
and pass them to `from_official`. The released weights are not licensed for
redistribution: convert them on your own machine.

    GCNet.pth              "gcnet"   91 entries
    PS-FCN_B_S_32.pth      "ps_fcn"  19 entries
    LCNet_CVPR2019.pth     "lcnet"   34 entries
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from unips_jax.errors import InputError
from unips_jax.io.door import write_whole

Network = Literal["gcnet", "ps_fcn", "lcnet"]

_HEADS = {
    "dir_x_est": ("azimuth", 36),
    "dir_y_est": ("elevation", 36),
    "int_est": ("intensity", 20),
}


class _Entry(NamedTuple):
    """One array of the authors': its name, its shape there, and its place here."""

    key: str
    shape: tuple[int, ...]
    path: tuple[str, ...] | None  # None: a buffer with nothing to learn from
    transposed: bool = False


def identify(arrays: Mapping[str, np.ndarray]) -> Network:
    """Which network these arrays belong to, by the names of their parts."""
    keys = [key.removeprefix("module.") for key in arrays]
    if any(key.startswith(("L_Net1.", "L_Net2.", "N_Net.")) for key in keys):
        return "gcnet"
    if any(key.startswith(("extractor.", "regressor.")) for key in keys):
        return "ps_fcn"
    if any(key.startswith(("featExtractor.", "classifier.")) for key in keys):
        return "lcnet"
    raise InputError(
        "these are not the arrays of GCNet, PS-FCN or LCNet; pass the checkpoint's "
        f"entry 'state_dict' (its names here: {sorted(arrays)[:5]} ...)"
    )


def from_official(
    arrays: Mapping[str, np.ndarray], network: Network | None = None
) -> dict[str, Any]:
    """The network's parameters, of the authors' arrays; every one is used exactly once.

    A prefix `module.` of names is ignored; without `network` the names show which it
    is. `InputError` names every missing, unexpected and misshapen array.
    """
    network = identify(arrays) if network is None else network
    entries = {entry.key: entry for entry in _entries(network)}
    given = {key.removeprefix("module."): value for key, value in arrays.items()}
    shapes = {key: tuple(np.shape(value)) for key, value in given.items()}
    problems = [f"missing {key}" for key in entries if key not in given]
    problems += [f"unexpected {key}" for key in given if key not in entries]
    problems += [
        f"{key}: expected shape {entries[key].shape}, got {shape}"
        for key, shape in shapes.items()
        if key in entries and shape != entries[key].shape
    ]
    if len(given) < len(arrays):
        problems.append("names that differ only by the prefix 'module.'")
    if problems:
        raise InputError(
            f"{network}: {len(problems)} problems with the arrays: "
            + "; ".join(problems)
        )
    flat = {
        entry.path: _convert(np.asarray(given[key], np.float32), entry.transposed)
        for key, entry in entries.items()
        if entry.path is not None
    }
    return unflatten_dict(flat)


def save_params(path: Path | str, params: Mapping[str, Any], network: Network) -> None:
    """Writes parameters to a safetensors file with the network's name inside."""
    flat = {
        "/".join(key): np.ascontiguousarray(value)
        for key, value in flatten_dict(params).items()
    }
    write_whole(Path(path), save(flat, {"network": network}))


def load_params(path: Path | str) -> tuple[dict[str, Any], Network]:
    """Reads what `save_params` wrote: parameters, float32, and the network's name."""
    try:
        with safe_open(path, framework="numpy") as file:
            network: Any = (file.metadata() or {}).get("network")
            flat = {
                tuple(key.split("/")): file.get_tensor(key).astype(np.float32)
                for key in file.keys()
            }
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: cannot read the weights ({error})") from error
    if network not in get_args(Network):
        raise InputError(
            f"{path}: expected weights of one of {get_args(Network)}, got those of "
            f"{network!r}; convert the authors' file first"
        )
    return unflatten_dict(flat), network


def _entries(network: Network) -> Iterator[_Entry]:
    if network == "gcnet":
        for prefix, part, channels in (
            ("L_Net1.", "light_1", 4),
            ("L_Net2.", "light_2", 8),
        ):
            yield _Entry(f"{prefix}dirs_step", (36,), None)
            yield _Entry(f"{prefix}ints_step", (20,), None)
            widths = (channels, 32, 64, 64, 128, 128, 128, 256)
            yield from _light_entries(prefix, (part,), widths, 128)
        widths = (6, 16, 32, 64, 128, 128, 128, 128)
        yield from _normal_entries("N_Net.", ("coarse",), widths)
    elif network == "ps_fcn":
        yield from _normal_entries("", (), (6, 64, 128, 128, 256, 256, 128, 128))
    elif network == "lcnet":
        widths = (4, 64, 128, 128, 128, 128, 256, 256)
        yield from _light_entries("", (), widths, 256)
    else:
        raise ValueError(
            f"network: expected one of {get_args(Network)}, got {network!r}"
        )


def _light_entries(
    prefix: str, part: tuple[str, ...], widths: tuple[int, ...], classifier: int
) -> Iterator[_Entry]:
    for i in range(1, 8):
        key, shape = f"{prefix}featExtractor.conv{i}.0", (widths[i], widths[i - 1])
        yield from _conv(key, (*part, f"extractor_{i - 1}"), shape, 3)
    for i in range(1, 5):
        shape = (classifier, 2 * widths[-1] if i == 1 else classifier)
        key = f"{prefix}classifier.conv{i}.0"
        yield from _conv(key, (*part, f"classifier_{i - 1}"), shape, 3)
    for name, (head, count) in _HEADS.items():
        key = f"{prefix}classifier.{name}"
        yield from _conv(f"{key}.0.0", (*part, f"{head}_hidden"), (64, classifier), 1)
        yield from _conv(f"{key}.1.0", (*part, f"{head}_logits"), (count, 64), 1)


def _normal_entries(
    prefix: str, part: tuple[str, ...], widths: tuple[int, ...]
) -> Iterator[_Entry]:
    for i in range(1, 8):
        key, path = f"{prefix}extractor.conv{i}.0", (*part, f"extractor_{i - 1}")
        if i == 6:
            yield _deconv(key, path, (widths[5], widths[6]))
        else:
            yield from _conv(key, path, (widths[i], widths[i - 1]), 3)
    key = f"{prefix}regressor.deconv"
    yield from _conv(f"{key}1.0", (*part, "regressor_0"), (128, widths[-1]), 3)
    yield from _conv(f"{key}2.0", (*part, "regressor_1"), (128, 128), 3)
    yield _deconv(f"{key}3.0", (*part, "regressor_2"), (128, 64))
    path = (*part, "normal", "conv", "kernel")
    yield _Entry(f"{prefix}regressor.est_normal.0.weight", (3, 64, 3, 3), path)


def _conv(
    key: str, path: tuple[str, ...], shape: tuple[int, int], size: int
) -> Iterator[_Entry]:
    """A convolution's weight (out, in, size, size) and bias (out,)."""
    yield _Entry(f"{key}.weight", (*shape, size, size), (*path, "conv", "kernel"))
    yield _Entry(f"{key}.bias", shape[:1], (*path, "conv", "bias"))


def _deconv(key: str, path: tuple[str, ...], shape: tuple[int, int]) -> _Entry:
    """A transposed convolution's weight (in, out, 4, 4)."""
    return _Entry(f"{key}.weight", (*shape, 4, 4), (*path, "conv", "kernel"), True)


def _convert(array: np.ndarray, transposed: bool) -> np.ndarray:
    """To (height, width, in, out); a transposed convolution's kernel is flipped."""
    if array.ndim == 1:
        return array
    if transposed:
        return np.ascontiguousarray(array.transpose(2, 3, 0, 1)[::-1, ::-1])
    return np.ascontiguousarray(array.transpose(2, 3, 1, 0))
