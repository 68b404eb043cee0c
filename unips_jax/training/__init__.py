"""Training: configuration, data, loss, optimiser, loop, checkpoints.

The names below are public (`docs/api.md`), and imported when they are first used.
"""

from typing import TYPE_CHECKING

from unips_jax.lazy import attributes

if TYPE_CHECKING:
    from unips_jax.io.ps_wild import PSWildFolders, read_object, write_folder
    from unips_jax.training.config import (
        Config,
        DataConfig,
        MeshConfig,
        OptimConfig,
        TrainConfig,
    )
    from unips_jax.training.loop import train
    from unips_jax.training.loss import LossOptions, Objects, training_loss
    from unips_jax.training.recipes import load_config

__all__ = [
    "Config",
    "DataConfig",
    "LossOptions",
    "MeshConfig",
    "Objects",
    "OptimConfig",
    "PSWildFolders",
    "TrainConfig",
    "load_config",
    "read_object",
    "train",
    "training_loss",
    "write_folder",
]

__getattr__ = attributes(
    __name__,
    {
        "io.ps_wild": "PSWildFolders read_object write_folder",
        "training.config": "Config DataConfig MeshConfig OptimConfig TrainConfig",
        "training.loop": "train",
        "training.loss": "LossOptions Objects training_loss",
        "training.recipes": "load_config",
    },
)
