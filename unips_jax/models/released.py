"""The authors' released parameters: Torch names and layouts, as in their files."""

import re
from collections.abc import Callable, Mapping

import numpy as np
from flax.traverse_util import unflatten_dict

from unips_jax.models.config import ModelConfig
from unips_jax.models.network import UniversalNetwork, param_shapes, raise_misfits

# The authors' names as patterns, each with the path of the parameter here. Tables of
# (pattern, replacement); later entries see the results of earlier ones.
_NAMES: tuple[tuple[str, str | Callable[[re.Match[str]], str]], ...] = (
    (r"^(\w+)\.(?:module\.)?", r"\1."),
    (r"^encoder\.attn\.(\d+)\.0\.mab\.", r"encoder.communications_\1."),
    (r"^encoder\.backbone\.0\.", "encoder."),
    (r"patch_embed\.convs\.(\d+)\.conv\.0\.", r"patch_embed.conv\1."),
    (r"layers\.(\d+)\.blocks\.(\d+)\.", r"stages_\1.block\2."),
    (r"\.mlp\.(fc[12])\.", r".\1."),
    # Ours begin a stage with the merging that ends the one before.
    (r"layers\.(\d+)\.downsample\.", lambda m: f"stages_{int(m[1]) + 1}.merging."),
    (r"^encoder\.norm(\d+)\.", r"encoder.norms_\1."),
    (r"^encoder\.fusion\.0\.", "encoder.fusion."),
    (r"psp_modules\.(\d+)\.1\.", r"ppm\1."),
    (r"fusion\.bottleneck\.0\.", "fusion.ppm_bottleneck."),
    (r"lateral_convs\.(\d+)\.0\.", r"lateral\1."),
    (r"fpn_convs\.(\d+)\.0\.", r"fpn\1."),
    (r"fpn_bottleneck\.0\.", "fpn_bottleneck."),
    (r"^aggregation\.enc\.(\d+)\.mab\.", r"decoder.aggregation.layer\1."),
    (r"^aggregation\.dec\.0\.mab\.", "decoder.aggregation.pooling."),
    (r"^aggregation\.dec\.0\.S$", "decoder.aggregation.pooling.seeds"),
    (r"^prediction\.regression\.0\.", "decoder.prediction.fc1."),
    (r"^prediction\.regression\.2\.", "decoder.prediction.fc2."),
    (r"\.fc_q\.", ".query."),
    (r"\.fc_k\.", ".key."),
    (r"\.fc_v\.", ".value."),
    (r"\.ln0\.", ".norm."),
    (r"\.ln1\.", ".mlp.norm."),
    (r"\.fc_o([12])\.", r".mlp.fc\1."),
    (r"(norm\w*)\.weight$", r"\1.scale"),
    (r"\.weight$", ".kernel"),
)
_IGNORED = "relative_position_index"


def official_name(key: str) -> str:
    """The path of a parameter here, from its name in the authors' checkpoint."""
    for pattern, replacement in _NAMES:
        key = re.sub(pattern, replacement, key)
    return key


def from_official(arrays: Mapping[str, np.ndarray]) -> UniversalNetwork:
    """The network of the authors' arrays, which `ModelConfig.released()` fits.

    Names are those of their three state dicts, after "encoder.", "aggregation." or
    "prediction."; with or without "module.". `InputError` names all missing, unexpected
    and misshapen ones at once.
    """
    config = ModelConfig.released()
    expected = param_shapes(config)
    converted, unexpected, misshapen = {}, [], []
    for key, array in arrays.items():
        if key.endswith(_IGNORED):
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
    raise_misfits("official weights", missing, unexpected, misshapen)
    return UniversalNetwork(config, unflatten_dict(converted, sep="."))


def _from_torch_layout(name: str, array: np.ndarray) -> np.ndarray:
    if name.endswith("seeds"):
        return array.reshape(array.shape[-2:])
    if name.endswith("kernel") and array.ndim == 4:
        return array.transpose(2, 3, 1, 0)
    if name.endswith("kernel") and array.ndim == 2:
        return array.T
    return array
