"""The networks' configurations: frozen dataclasses, checked, saved as JSON.

Two networks exist, and no others can be built: the paper's (UniPS, Ikehata, CVPR 2022,
Sec. 4 and supplement) with its ablations and the authors' arithmetic, `UniPSConfig`;
and ours, `SelfCalibratingConfig`. `ModelConfig` is what they share, and has the sizes
in use as constructors. It is stored inside every weights file and checkpoint.
"""

import dataclasses
from typing import ClassVar, Literal, TypeVar

from unips_jax.checks import (
    check_types,
    require,
    require_at_most,
    require_not_negative,
    require_positive,
)

_T = TypeVar("_T")


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Sizes that both networks have; the defaults are the paper's.

    Attributes:
        network: which network it is; follows from the class.
        canonical_size: side in pixels of the images the encoder sees; a multiple of 4.
        patch_channels: widths of the patch embedding's first two pairs of
            convolutions (the last width is `embed_dim`).
        embed_dim: channels of Swin's first stage; doubles at every stage.
        depths: Swin blocks per stage.
        num_heads: attention heads per Swin stage; must divide the stage's channels.
        window_size: side of Swin's windows, in tokens.
        mlp_ratio: hidden width of Swin's MLPs over their input width.
        drop_path_rate: stochastic depth of the last Swin block, rising linearly from 0.
        communication_heads: attention heads of the communication between images.
        communication_mlp_ratio: hidden width of its MLPs over the input width.
        context_dim: channels of the global lighting contexts (UPerNet's width).
        pool_scales: bins per side of the pyramid pooling module.
        aggregation_layers: set-attention layers of the aggregation.
        hidden_dim: its width.
        aggregation_heads: its attention heads.
        aggregation_mlp_dim: hidden width of its MLPs.
        pma_mlp_dim: hidden width of the MLP in the pooling by attention.
        predictor_dim: hidden width of the normal predictor.
        dropout_rate: dropout in set attention, training only.
        dtype: compute type; parameters stay float32 ("float64", for checks, needs
            `jax_enable_x64`).
        remat: recompute Swin blocks and set attention in the backward pass, for memory
            (on CPU the encoder's parts, a few images at a time).
    """

    # Of the network itself, not to choose: whether images are resized for the encoder
    # with antialiasing, whether normals are the mean over images and mirrored images,
    # and whether the encoder guesses normals and lights on its way.
    antialias: ClassVar[bool] = False
    mirror: ClassVar[bool] = False
    guesses: ClassVar[bool] = False

    network: str = dataclasses.field(init=False, default="")
    canonical_size: int = 256
    patch_channels: tuple[int, int] = (48, 96)
    embed_dim: int = 96
    depths: tuple[int, ...] = (2, 2, 18, 2)
    num_heads: tuple[int, ...] = (3, 6, 12, 24)
    window_size: int = 7
    mlp_ratio: float = 4.0
    drop_path_rate: float = 0.2
    communication_heads: int = 8
    communication_mlp_ratio: float = 2.0
    context_dim: int = 256
    pool_scales: tuple[int, ...] = (1, 2, 3, 6)
    aggregation_layers: int = 3
    hidden_dim: int = 384
    aggregation_heads: int = 8
    aggregation_mlp_dim: int = 1024
    pma_mlp_dim: int = 512
    predictor_dim: int = 192
    dropout_rate: float = 0.1
    dtype: Literal["float32", "bfloat16", "float64"] = "float32"
    remat: bool = False

    def __post_init__(self) -> None:
        """Raises `ValueError` naming the field, what was expected and what came."""
        require(
            self.network in NETWORKS,
            "ModelConfig: expected one of the networks, from ModelConfig.paper(), "
            ".released(), .tiny() or .small(), got what they share",
        )
        check_types(self)
        sizes = ("canonical_size", "embed_dim", "window_size", "context_dim")
        widths = ("hidden_dim", "aggregation_mlp_dim", "pma_mlp_dim", "predictor_dim")
        heads = ("communication_heads", "aggregation_heads")
        ratios = ("mlp_ratio", "communication_mlp_ratio")
        require_positive(self, *sizes, *widths, *heads, *ratios)
        require_not_negative(self, "aggregation_layers")
        # Beyond these a file is damaged or hostile: memory would grow without bound.
        require_at_most(self, 2048, "canonical_size")
        require_at_most(self, 32, "window_size")
        require_at_most(self, 100, "aggregation_layers", *ratios)
        require_at_most(self, 2**14, "embed_dim", "context_dim", *widths)
        lists = {"patch_channels": 2**14, "num_heads": 2**14}
        lists |= {"depths": 100, "pool_scales": 64}
        for name, most in lists.items():
            values = getattr(self, name)
            require(
                1 <= len(values) <= 8 and min(values) >= 1 and max(values) <= most,
                f"{name}: expected one to eight numbers from 1 to {most}, got "
                f"{values!r:.200}",
            )
        require(
            self.canonical_size % 4 == 0,
            f"canonical_size: expected a multiple of 4, got {self.canonical_size}",
        )
        require(
            len(self.depths) == len(self.num_heads),
            f"depths and num_heads: expected one entry per stage in both, got "
            f"{self.depths} and {self.num_heads}",
        )
        for stage, count in enumerate(self.num_heads):
            self._require_divisor(f"num_heads[{stage}]", count, self.stage_dim(stage))
        for dim in self.communication_dims:
            self._require_divisor("communication_heads", self.communication_heads, dim)
        self._require_divisor(
            "aggregation_heads", self.aggregation_heads, self.hidden_dim
        )
        for name in ("drop_path_rate", "dropout_rate"):
            rate = getattr(self, name)
            require(0 <= rate < 1, f"{name}: expected a rate in [0, 1), got {rate}")

    @staticmethod
    def _require_divisor(name: str, heads: int, channels: int) -> None:
        require(
            channels % heads == 0,
            f"{name}: expected a divisor of the {channels} channels, got {heads}",
        )

    def stage_dim(self, stage: int) -> int:
        """Channels of Swin's stage number `stage`, counted from 0."""
        return self.embed_dim * 2**stage

    @property
    def stage_dims(self) -> list[int]:
        """Channels of each of Swin's stages."""
        return [self.stage_dim(stage) for stage in range(len(self.depths))]

    @property
    def communication_dims(self) -> list[int]:
        """Channels of each map at which the images of a set communicate."""
        return self.stage_dims

    @property
    def num_blocks(self) -> int:
        """Transformer blocks of which the configuration says how many there are."""
        return sum(self.depths) + self.aggregation_layers

    @property
    def context_size(self) -> int:
        """Side of the contexts' grid, in cells."""
        return self.canonical_size // 4

    @property
    def sees_details(self) -> bool:
        """Whether the encoder also sees what images twice as large have more."""
        return False

    @property
    def input_channels(self) -> int:
        """Channels of the encoder's images: colour, mask, and details if it has any."""
        return 13 if self.sees_details else 4

    @property
    def reads_at_corners(self) -> bool:
        """Whether a pixel reads the contexts at its corner, with zeros around them."""
        return False

    @staticmethod
    def paper() -> "UniPSConfig":
        """The paper's network: 72 M parameters."""
        return UniPSConfig()

    @staticmethod
    def released() -> "UniPSConfig":
        """What the authors' released weights need: 69 M parameters."""
        return UniPSConfig(
            attention="released", aggregation_layers=4, context_sampling="corner"
        )

    @staticmethod
    def tiny() -> "SelfCalibratingConfig":
        """Our network in the size of the shipped weights: 12 M parameters."""
        return SelfCalibratingConfig(
            canonical_size=96,
            patch_channels=(24, 64),
            embed_dim=64,
            ratio_dim=16,
            depths=(2, 6, 3),
            num_heads=(2, 4, 8),
            window_size=6,
            drop_path_rate=0.0,
            context_dim=64,
            pool_scales=(1, 2),
            consensus_blocks=6,
            consensus_dim=256,
            observation_dim=64,
            hidden_dim=128,
            aggregation_heads=4,
            aggregation_mlp_dim=256,
            pma_mlp_dim=256,
            predictor_dim=128,
            dropout_rate=0.0,
            light_tokens=True,
            known_lights=True,
        )

    @staticmethod
    def small() -> "SelfCalibratingConfig":
        """Our network for one GPU, `tiny` twice as wide: 49 M parameters."""
        return SelfCalibratingConfig(
            canonical_size=128,
            patch_channels=(48, 128),
            embed_dim=128,
            ratio_dim=32,
            depths=(2, 6, 3),
            num_heads=(4, 8, 16),
            window_size=8,
            drop_path_rate=0.0,
            communication_heads=16,
            context_dim=128,
            pool_scales=(1, 2),
            consensus_blocks=6,
            consensus_dim=512,
            observation_dim=128,
            hidden_dim=256,
            aggregation_heads=8,
            aggregation_mlp_dim=512,
            pma_mlp_dim=512,
            predictor_dim=256,
            dropout_rate=0.0,
            light_tokens=True,
            known_lights=True,
        )


@dataclasses.dataclass(frozen=True)
class UniPSConfig(ModelConfig):
    """The paper's network, its ablations, and the authors' arithmetic.

    Attributes:
        communication: where the images exchange features: between backbone and
            fusion ("pre", the paper's choice), after every Swin stage ("during"),
            after fusion ("post") or nowhere ("none"). Paper Sec. 4.1 and Table 3.
        attention: arithmetic of set attention: "pre_norm" is the paper's standard
            Transformer layer, "released" what the authors' network computes.
        aggregation: how a pixel's set becomes one vector: "pma" or "max".
        context_sampling: where a pixel reads the contexts: at its centre ("center",
            clamped at the border) or at its corner with zeros beyond the border
            ("corner", half a pixel off, as the authors' weights need).
    """

    network: str = dataclasses.field(init=False, default="unips")
    communication: Literal["none", "during", "pre", "post"] = "pre"
    attention: Literal["pre_norm", "released"] = "pre_norm"
    aggregation: Literal["pma", "max"] = "pma"
    context_sampling: Literal["center", "corner"] = "center"

    @property
    def communication_dims(self) -> list[int]:
        if self.communication == "none":
            return []
        return [self.context_dim] if self.communication == "post" else self.stage_dims

    @property
    def reads_at_corners(self) -> bool:
        return self.context_sampling == "corner"


@dataclasses.dataclass(frozen=True)
class SelfCalibratingConfig(ModelConfig):
    """Our network, which finds each image's light on its way (see `models`).

    Attributes:
        ratio_dim: width of the patch embedding of each image's ratio to its set's mean.
        consensus_blocks: blocks of attention over the one map that all images of a set
            share. They attend to the whole map: their cost grows as canonical_size**4.
        consensus_dim: their width, a multiple of 32.
        observation_dim: width of the embedding of a pixel's observations, that scales
            and shifts its contexts.
        fine_dim: width of the convolutions that refine the contexts on a grid twice as
            fine, by images twice as large (see `models.fine`); 0: none.
        light_tokens: whether the consensus knows kinds of light, by a token for each
            (see `models.light_tokens`).
        known_lights: whether it learns to use lights that are given with the images;
            its guesses move to them in any case (see `models.known_lights`).
    """

    antialias: ClassVar[bool] = True
    mirror: ClassVar[bool] = True
    guesses: ClassVar[bool] = True

    network: str = dataclasses.field(init=False, default="self_calibrating")
    ratio_dim: int = 24
    consensus_blocks: int = 6
    consensus_dim: int = 256
    observation_dim: int = 128
    fine_dim: int = 0
    light_tokens: bool = False
    known_lights: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        widths = ("ratio_dim", "consensus_dim", "observation_dim")
        require_positive(self, *widths, "consensus_blocks")
        require_not_negative(self, "fine_dim")
        require_at_most(self, 2**14, *widths, "fine_dim")
        require_at_most(self, 100, "consensus_blocks")
        require(
            self.consensus_dim % 32 == 0,
            f"consensus_dim: expected a multiple of 32, got {self.consensus_dim}",
        )

    @property
    def num_blocks(self) -> int:
        return super().num_blocks + self.consensus_blocks

    @property
    def sees_details(self) -> bool:
        return self.fine_dim > 0

    @property
    def context_size(self) -> int:
        cells = super().context_size
        return 2 * cells + 1 if self.sees_details else cells  # nodes, half a cell apart


def require_known_lights(config: ModelConfig) -> None:
    """Raises `ValueError` for a network that has no use for known lights."""
    require(
        config.guesses,
        "lights: expected weights of a network that guesses lights, as the shipped "
        "ones, got the paper's; leave the lights out or take other weights",
    )


def check_lights(config: ModelConfig, shape: tuple[int, ...], images: int) -> None:
    """Raises `ValueError` unless known lights of this shape fit network and images."""
    require_known_lights(config)
    require(
        shape == (images, 3),
        f"lights: expected [N, 3] = {(images, 3)}, one direction per image, got "
        f"{shape}",
    )


NETWORKS = {"unips": UniPSConfig, "self_calibrating": SelfCalibratingConfig}
