"""Training: configuration, data, loss, optimiser, loop, checkpoints.

The names below are public (`docs/api.md`), and imported when they are first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

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

_MODULES = {
    "Config": "training.config",
    "DataConfig": "training.config",
    "LossOptions": "training.loss",
    "MeshConfig": "training.config",
    "Objects": "training.loss",
    "OptimConfig": "training.config",
    "PSWildFolders": "io.ps_wild",
    "TrainConfig": "training.config",
    "load_config": "training.recipes",
    "read_object": "io.ps_wild",
    "train": "training.loop",
    "training_loss": "training.loss",
    "write_folder": "io.ps_wild",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"unips_jax.{_MODULES[name]}")
    return getattr(module, name)
