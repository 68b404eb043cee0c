"""Converts the authors' checkpoints to weights files of this package.

    python tools/convert_official.py DIR -o unips_official.safetensors
    python tools/convert_official.py GCNet.pth -o gcnet.safetensors

DIR holds UniPS' `*_enc.pytmodel`, `*_agg.pytmodel` and `*_pred.pytmodel` (torch state
dicts). A `.pth` file is GCNet, PS-FCN or LCNet, known by its keys. The authors'
licence applies to the result. Needs torch: `pip install ".[convert]"`.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unips_jax.baselines.gcnet import parameters as gcnet_weights
from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.models.released import from_official
from unips_jax.weights import save_weights

# The part of the network in each file, by the end of its name.
PARTS = {"enc": "encoder", "agg": "aggregation", "pred": "prediction"}


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Reads a torch state dict without running code from it.

    Args:
        path: a file written by `torch.save`.

    Returns:
        Arrays by name.

    Raises:
        InputError: if torch is absent or the file is not a state dict.
    """
    try:
        import torch
    except ImportError:
        raise InputError(
            "torch is needed to read the authors' files: pip install torch"
        ) from None
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        state = state.get("state_dict", state)
        return {name: tensor.numpy() for name, tensor in state.items()}
    except Exception as error:  # torch raises many kinds for files it cannot read
        reason = str(error).split("\n")[0]
        raise InputError(
            f"{path}: expected a torch state dict, got: {reason}"
        ) from None


def read_checkpoint(folder: Path) -> dict[str, np.ndarray]:
    """Reads the three files of a UniPS checkpoint.

    Args:
        folder: holds them.

    Returns:
        Arrays by name, prefixed with their part of the network.

    Raises:
        InputError: if there is not exactly one file of each part.
    """
    arrays = {}
    for suffix, part in PARTS.items():
        found = sorted(folder.glob(f"*_{suffix}.pytmodel"))
        if len(found) != 1:
            raise InputError(
                f"{folder}: expected one file *_{suffix}.pytmodel, found "
                f"{[path.name for path in found]}"
            )
        state = read_state_dict(found[0])
        arrays.update({f"{part}.{name}": array for name, array in state.items()})
    return arrays


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Converts one folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path, help="folder or .pth file")
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args(argv)
    if arguments.output.suffix != ".safetensors":
        raise InputError(f"-o {arguments.output}: expected a name in .safetensors")
    if arguments.checkpoint.is_file():
        arrays = read_state_dict(arguments.checkpoint)
        kind = gcnet_weights.identify(arrays)
        params = gcnet_weights.from_official(arrays, kind)
        gcnet_weights.save_params(arguments.output, params, kind)
        method = f"{kind.replace('_', '-')}:weights={arguments.output}"
        if kind != "ps_fcn":  # it finds lights; least squares find the normals
            method += ",normals=woodham"
        print(f"{arguments.output}: use it with --method {method}")
        return
    network = from_official(read_checkpoint(arguments.checkpoint))
    record = {"source": "the authors' checkpoint, converted"}
    save_weights(arguments.output, network, record=record)
    print(f"{arguments.output}: use it with --weights {arguments.output}")


if __name__ == "__main__":
    raise SystemExit(main())
