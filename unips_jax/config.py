"""Configuration: frozen dataclasses, checked on construction, saved as JSON.

`ModelConfig` sizes the network and is stored inside every weights file; `Config`
describes a training run and is saved with every checkpoint. The defaults of
`ModelConfig` are the paper's (UniPS, Ikehata, CVPR 2022, Sec. 4 and supplement).
"""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

from unips_jax.checks import (
    require,
    require_choice,
    require_not_negative,
    require_positive,
)

_T = TypeVar("_T")


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Sizes and variants of the network.

    Attributes:
        canonical_size: side in pixels of the images the encoder sees; a multiple of 4.
        antialias: resize them with antialiasing, so that contexts depend little on the
            photographs' resolution (the paper does not).
        patch_channels: widths of the patch embedding's first two pairs of
            convolutions (the last width is `embed_dim`).
        embed_dim: channels of Swin's first stage; doubles at every stage.
        ratio_dim: width of a second patch embedding, of each image's ratio to the mean
            of its set, which no albedo changes; 0: none (the paper's network).
        depths: Swin blocks per stage.
        num_heads: attention heads per Swin stage; must divide the stage's channels.
        window_size: side of Swin's windows, in tokens.
        mlp_ratio: hidden width of Swin's MLPs over their input width.
        drop_path_rate: stochastic depth of the last Swin block, rising linearly from 0.
        communication: where the images exchange features: between backbone and
            fusion ("pre", the paper's choice), after every Swin stage ("during"),
            after fusion ("post") or nowhere ("none"). Paper Sec. 4.1 and Table 3.
        communication_heads: attention heads of the communication blocks.
        communication_mlp_ratio: hidden width of their MLPs over the input width.
        context_dim: channels of the global lighting contexts (UPerNet's width).
        pool_scales: bins per side of the pyramid pooling module.
        linear_pooling: no ReLUs in and after that module (the paper's network has
            them). Where they are all off, the coarsest stage is cut off for good.
        attention: arithmetic of set attention: "pre_norm" is the paper's standard
            Transformer layer, "released" what the authors' network computes.
        aggregation: how a pixel's set becomes one vector: "pma" or "max".
        aggregation_layers: set-attention layers before it.
        hidden_dim: width of the aggregation.
        aggregation_heads: its attention heads.
        aggregation_mlp_dim: hidden width of its MLPs.
        pma_mlp_dim: hidden width of the MLP in the pooling by attention.
        predictor_dim: hidden width of the normal predictor.
        observation_dim: width of an embedding of a pixel's observations, set beside
            their mean over the images, that scales and shifts its contexts; 0: none
            (the paper's network).
        consensus_blocks: blocks of attention over the one map that all images of a set
            share, our addition to the encoder (see `models.consensus`); 0: none. They
            attend to the whole map: their cost grows as canonical_size**4.
        consensus_dim: their width, a multiple of 32.
        dropout_rate: dropout in set attention, training only.
        context_sampling: where a pixel reads the contexts: at its centre ("center",
            clamped at the border) or at its corner with zeros beyond the border
            ("corner", half a pixel off, as the authors' weights need).
        mirror: estimate from the mirrored images too, and average, so that mirrored
            images give exactly the mirrored normals; takes twice the time. Not in the
            paper, and not part of training.
        dtype: compute type; parameters stay float32 ("float64", for checks, needs
            `jax_enable_x64`).
        remat: recompute Swin blocks and set attention in the backward pass, for memory
            (on CPU Swin only, a few images at a time).
    """

    canonical_size: int = 256
    antialias: bool = False
    patch_channels: tuple[int, int] = (48, 96)
    embed_dim: int = 96
    ratio_dim: int = 0
    depths: tuple[int, ...] = (2, 2, 18, 2)
    num_heads: tuple[int, ...] = (3, 6, 12, 24)
    window_size: int = 7
    mlp_ratio: float = 4.0
    drop_path_rate: float = 0.2
    communication: Literal["none", "during", "pre", "post"] = "pre"
    communication_heads: int = 8
    communication_mlp_ratio: float = 2.0
    context_dim: int = 256
    pool_scales: tuple[int, ...] = (1, 2, 3, 6)
    linear_pooling: bool = False
    attention: Literal["pre_norm", "released"] = "pre_norm"
    aggregation: Literal["pma", "max"] = "pma"
    aggregation_layers: int = 3
    hidden_dim: int = 384
    aggregation_heads: int = 8
    aggregation_mlp_dim: int = 1024
    pma_mlp_dim: int = 512
    predictor_dim: int = 192
    observation_dim: int = 0
    consensus_blocks: int = 0
    consensus_dim: int = 128
    dropout_rate: float = 0.1
    context_sampling: Literal["center", "corner"] = "center"
    mirror: bool = False
    dtype: Literal["float32", "bfloat16", "float64"] = "float32"
    remat: bool = False

    def __post_init__(self) -> None:
        """Checks every field.

        Raises:
            ValueError: naming the field, what was expected and what came.
        """
        require_positive(
            self,
            *("canonical_size", "embed_dim", "window_size", "mlp_ratio"),
            *("communication_heads", "communication_mlp_ratio", "context_dim"),
            *("hidden_dim", "aggregation_heads", "aggregation_mlp_dim"),
            *("pma_mlp_dim", "predictor_dim"),
        )
        require_not_negative(
            self,
            *("ratio_dim", "aggregation_layers", "observation_dim"),
            "consensus_blocks",
        )
        for name in ("patch_channels", "depths", "num_heads", "pool_scales"):
            values = getattr(self, name)
            require(
                isinstance(values, tuple) and min(values, default=1) >= 1,
                f"{name}: expected a tuple of positive numbers, got {values!r}",
            )
        require(
            len(self.patch_channels) == 2,
            f"patch_channels: expected two widths, got {self.patch_channels}",
        )
        require(
            self.canonical_size % 4 == 0,
            f"canonical_size: expected a multiple of 4, got {self.canonical_size}",
        )
        require(
            len(self.depths) == len(self.num_heads) >= 1,
            f"depths and num_heads: expected one entry per stage in both, got "
            f"{self.depths} and {self.num_heads}",
        )
        for stage, heads in enumerate(self.num_heads):
            dim = self.stage_dim(stage)
            require(
                dim % heads == 0,
                f"num_heads[{stage}]: expected a divisor of the stage's {dim} "
                f"channels, got {heads}",
            )
            require(
                self.communication not in ("pre", "during")
                or dim % self.communication_heads == 0,
                f"communication_heads: expected a divisor of stage {stage}'s {dim} "
                f"channels, got {self.communication_heads}",
            )
        require(
            self.communication != "post"
            or self.context_dim % self.communication_heads == 0,
            f"communication_heads: expected a divisor of "
            f"context_dim={self.context_dim}, got {self.communication_heads}",
        )
        require(
            self.hidden_dim % self.aggregation_heads == 0,
            f"aggregation_heads: expected a divisor of hidden_dim={self.hidden_dim}, "
            f"got {self.aggregation_heads}",
        )
        require(
            self.consensus_dim >= 32 and self.consensus_dim % 32 == 0,
            f"consensus_dim: expected a multiple of 32, got {self.consensus_dim}",
        )
        for name in ("drop_path_rate", "dropout_rate"):
            rate = getattr(self, name)
            require(0 <= rate < 1, f"{name}: expected a rate in [0, 1), got {rate}")
        require_choice(
            "communication", self.communication, ("none", "during", "pre", "post")
        )
        require_choice("attention", self.attention, ("pre_norm", "released"))
        require_choice("aggregation", self.aggregation, ("pma", "max"))
        require_choice("context_sampling", self.context_sampling, ("center", "corner"))
        require_choice("dtype", self.dtype, ("float32", "bfloat16", "float64"))

    def stage_dim(self, stage: int) -> int:
        """Channels of Swin's stage number `stage`, counted from 0."""
        return self.embed_dim * 2**stage


def to_json(config: Any) -> str:
    """Writes a configuration dataclass as JSON text."""
    return json.dumps(dataclasses.asdict(config), sort_keys=True)


def from_json(cls: type[_T], text: str) -> _T:
    """Reads back what `to_json` wrote.

    Args:
        cls: the configuration's class.
        text: JSON text.

    Raises:
        ValueError: if a field is unknown, or a value is not acceptable.
    """
    return _from_mapping(cls, json.loads(text))


def _from_mapping(cls: type[_T], values: Mapping[str, Any]) -> _T:
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - set(fields))
    require(
        not unknown,
        f"{cls.__name__}: unknown fields {unknown}; this version knows "
        f"{sorted(fields)}. Was the file written by a newer unips_jax?",
    )
    kwargs = {}
    for name, value in values.items():
        kind = fields[name].type
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            value = _from_mapping(kind, value)
        elif isinstance(value, list):
            value = tuple(value)
        kwargs[name] = value
    return cls(**kwargs)
