"""The configuration of a training run, saved with every checkpoint."""

import dataclasses
from typing import Literal

from unips_jax.checks import (
    check_types,
    require,
    require_at_most,
    require_not_negative,
    require_positive,
)
from unips_jax.models.config import ModelConfig
from unips_jax.scenes.config import SceneConfig

LAST_STEP = 2**31 - 1
"""The state counts in int32."""


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """What a training step sees.

    Attributes:
        source: scenes made on the device ("scenes"), PS-Wild folders ("folders"), or a
            share of steps from each ("mixture").
        root: the folder that holds the `X.data` folders, not of "scenes".
        scene_share: share of steps on scenes in a mixture.
        image_size: side of the training images, in pixels.
        frame: what the encoder's square surrounds: the whole "image", as in the paper,
            or the "mask", as in `estimate_normals` by default.
        batch_size: objects per step, over all devices.
        num_images: sizes of the sets; every step draws one of them for all its
            objects. The paper draws from 2..10.
        num_pixels: full-resolution pixels drawn per object (2500 in the paper; all
            masked ones if there are fewer).
        max_tokens: upper bound on set size times pixels drawn per object, to even out
            the cost of large sets; 0: no bound.
        pixel_blocks: draw them in blocks of 2 x 2, whose pixels are compared too.
        grid_loss: also decode every pixel of the contexts' grid, the first of the
            paper's two samplings.
        augment: the paper's four augmentations. They turn images on their side and
            upside down, so that a network cannot learn that skies and lamps are above;
            configurations that train on endless scenes do without.
        known_lights_rate: share of the sets whose lights the network is given, roughly
            or exactly (see `training.known_lights`); of scenes alone.
        workers: processes that read folders; 0 reads in the training process.
    """

    source: Literal["scenes", "folders", "mixture"] = "folders"
    root: str = ""
    scene_share: float = 0.5
    image_size: int = 512
    frame: Literal["image", "mask"] = "image"
    batch_size: int = 3
    num_images: tuple[int, ...] = tuple(range(2, 11))
    num_pixels: int = 2500
    max_tokens: int = 0
    pixel_blocks: bool = False
    grid_loss: bool = True
    augment: bool = True
    known_lights_rate: float = 0.0
    workers: int = 0

    def __post_init__(self) -> None:
        check_types(self)
        require_positive(self, "image_size", "batch_size", "num_pixels")
        require_not_negative(self, "max_tokens", "workers")
        # More is a slip: memory would not hold it.
        require_at_most(self, 2**14, "image_size")
        require_at_most(self, 2**16, "batch_size")
        require_at_most(self, 2**24, "num_pixels")
        require_at_most(self, 1024, "workers")
        require(
            len(self.num_images) > 0
            and min(self.num_images) >= 1
            and max(self.num_images) <= 2**12,
            f"num_images: expected set sizes from 1 to {2**12}, got {self.num_images}",
        )
        require(
            self.image_size % 4 == 0,  # of scenes, which runs on folders validate on
            f"image_size: expected a multiple of 4, got {self.image_size}",
        )
        require(
            0 <= self.scene_share <= 1,
            f"scene_share: expected a share in [0, 1], got {self.scene_share}",
        )
        require(
            not (self.pixel_blocks and self.grid_loss),
            "pixel_blocks: expected no grid_loss with them, got both",
        )
        require(
            0 <= self.known_lights_rate <= 1,
            "known_lights_rate: expected a share in [0, 1], got "
            f"{self.known_lights_rate}",
        )
        require(
            not self.known_lights_rate or not self.augment or self.source == "folders",
            "known_lights_rate: expected no augment (--data.no-augment) with scenes, "
            "whose lights it would not turn, got both",
        )

    def pixels_for(self, num_images: int) -> int:
        """Full-resolution pixels drawn per object for sets of this size."""
        if not self.max_tokens:
            return self.num_pixels
        return max(1, min(self.num_pixels, self.max_tokens // num_images))


@dataclasses.dataclass(frozen=True)
class OptimConfig:
    """The optimiser and its schedule.

    Attributes:
        name: "adamw" (the paper's) or "muon" (orthogonalised momentum for kernels,
            AdamW for the rest).
        learning_rate: the highest learning rate.
        schedule: "cosine" (to zero at the last step), "trapezoid" (constant, then
            linearly to zero; from a checkpoint before the fall a run may be prolonged)
            or "step" (the paper's decay).
        warmup_steps: linear rise from zero.
        fall_steps: length of the fall of "trapezoid"; 0: none.
        decay_every: steps between two decays of "step" (the paper: 3 epochs).
        decay_rate: factor of each decay.
        weight_decay: on the kernels alone.
        b2: decay of the second moments.
        clip_norm: largest global norm of the gradient; 0: no clipping.
        ema_decay: of the averaged parameters that are validated and released; 0: none.
    """

    name: Literal["adamw", "muon"] = "adamw"
    learning_rate: float = 1e-4
    schedule: Literal["cosine", "trapezoid", "step"] = "step"
    warmup_steps: int = 0
    fall_steps: int = 0
    decay_every: int = 10_099
    decay_rate: float = 0.8
    weight_decay: float = 0.05
    b2: float = 0.999
    clip_norm: float = 1.0
    ema_decay: float = 0.999

    def __post_init__(self) -> None:
        check_types(self)
        rates = ("learning_rate", "decay_every", "decay_rate")
        require_positive(self, *rates)
        require_not_negative(
            self, "warmup_steps", "fall_steps", "weight_decay", "clip_norm"
        )
        require_at_most(self, LAST_STEP, "warmup_steps", "fall_steps", "decay_every")
        for name in ("b2", "ema_decay"):
            decay = getattr(self, name)
            require(0 <= decay < 1, f"{name}: expected a decay in [0, 1), got {decay}")


@dataclasses.dataclass(frozen=True)
class MeshConfig:
    """How devices are used.

    Attributes:
        data: devices along which the batch is split; 0: all that `fsdp` leaves.
        fsdp: devices along which parameters and optimiser state are split too.
        microbatches: parts of a batch that go through the network one after the other,
            in the memory of one; the gradient is their mean, that of the whole batch.
    """

    data: int = 0
    fsdp: int = 1
    microbatches: int = 1

    def __post_init__(self) -> None:
        check_types(self)
        require(self.data >= 0, f"data: expected 0 or more devices, got {self.data}")
        require_positive(self, "fsdp", "microbatches")
        require_at_most(self, 2**16, "microbatches")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Length, seed, loss and rhythm of a training run.

    Attributes:
        steps: length of the run.
        seed: of parameters, data order, scenes and dropout.
        squared_loss: square the distance between true and predicted normals, as the
            paper does; False takes the distance itself, which follows the mean angular
            error.
        distance_smoothing: of that distance: errors whose square is below it count by
            their square, so that small ones hardly count (1e-3: below 1.8 degrees).
        coarse_guess_weight: what the consensus' guess of coarse normals weighs in the
            loss, next to the normals' own distance.
        lights_guess_weight: what its guess of where the lights are weighs there.
        kinds_guess_weight: what its guesses of the kinds of light weigh there, if the
            network makes any (`light_tokens`); of scenes alone.
        steepness_weight: pixels count by the exponential of this times how much the
            true normals change within their block of 2 x 2; 0: all the same.
        differences_weight: what the differences between the pixels of a block weigh.
        log_every: steps between metric lines, each of their means since the one before.
        checkpoint_every: steps between checkpoints; the first step has one, too.
        keep: how many checkpoints are kept.
        validate_every: steps between validations.
        validation_scenes: held-out scenes in a validation; 0: no validation.
        validation_images: images of each.
    """

    steps: int = 67_327
    seed: int = 0
    squared_loss: bool = True
    distance_smoothing: float = 1e-3
    coarse_guess_weight: float = 0.5
    lights_guess_weight: float = 0.25
    kinds_guess_weight: float = 0.1
    steepness_weight: float = 0.0
    differences_weight: float = 0.0
    log_every: int = 20
    checkpoint_every: int = 500
    keep: int = 2
    validate_every: int = 2000
    validation_scenes: int = 64
    validation_images: int = 8

    def __post_init__(self) -> None:
        check_types(self)
        rhythm = ("log_every", "checkpoint_every", "keep", "validate_every")
        require_positive(
            self, "steps", *rhythm, "validation_images", "distance_smoothing"
        )
        guesses = ("coarse_guess_weight", "lights_guess_weight", "kinds_guess_weight")
        blocks = ("steepness_weight", "differences_weight")
        require_not_negative(self, "seed", *guesses, *blocks, "validation_scenes")
        require_at_most(self, LAST_STEP, "steps", *rhythm)
        require_at_most(self, 2**32 - 1, "seed")  # keys have no more bits
        require_at_most(self, 2**16, "validation_scenes")
        require_at_most(self, 2**12, "validation_images")


@dataclasses.dataclass(frozen=True)
class Config:
    """A training run.

    Attributes:
        model: the network.
        data: what a step sees.
        scenes: the distribution of scenes.
        optim: the optimiser.
        mesh: the devices.
        train: length, loss and rhythm.
    """

    model: ModelConfig = ModelConfig.paper()
    data: DataConfig = DataConfig()
    scenes: SceneConfig = SceneConfig()
    optim: OptimConfig = OptimConfig()
    mesh: MeshConfig = MeshConfig()
    train: TrainConfig = TrainConfig()

    def __post_init__(self) -> None:
        check_types(self)
        data, train = self.data, self.train
        require(
            not (self.model.sees_details and data.grid_loss),
            "fine_dim: expected no grid_loss with it (--data.no-grid-loss), got both",
        )
        require(
            data.pixel_blocks
            or not (train.steepness_weight or train.differences_weight),
            "steepness_weight, differences_weight: expected blocks of pixels "
            "(--data.pixel-blocks), got none",
        )
        require(
            getattr(self.model, "known_lights", False) or not data.known_lights_rate,
            "known_lights_rate: expected a network that knows lights "
            "(--model.known-lights), got another; or set it to 0",
        )
        require(
            not (
                getattr(self.model, "light_tokens", False)
                and data.augment
                and data.source != "folders"
            ),
            "light_tokens: expected no augment (--data.no-augment) with scenes, whose "
            "kinds of light it would not turn, got both",
        )
