r"""What further parts and losses gain, from the shipped weights: one arm of four.

    unips train --config ablation --init-weights tiny --workdir runs/nothing
    unips train --config ablation --init-weights tiny --workdir runs/fine \
        --model.fine-dim 32
    unips train --config ablation --init-weights tiny --workdir runs/blocks \
        --data.pixel-blocks --train.steepness-weight 1 --train.differences-weight 0.1
    unips train --config ablation --init-weights tiny --workdir runs/all \
        --model.fine-dim 32 \
        --data.pixel-blocks --train.steepness-weight 1 --train.differences-weight 0.1

What: every arm sees the same scenes, larger than those of `configs/tiny.py` so that
there is detail to see; its new parts begin without a change to the network. A run that
was stopped goes on with the same command. Each leaves `last.safetensors` (and
`best.safetensors`) in its folder.
"""

import dataclasses
import runpy
from pathlib import Path

from unips_jax.training.config import Config


def get_config() -> Config:
    """The configuration of the arm without changes."""
    tiny = runpy.run_path(str(Path(__file__).with_name("tiny.py")))["get_config"]()
    return dataclasses.replace(
        tiny,
        data=dataclasses.replace(tiny.data, image_size=192),
        optim=dataclasses.replace(
            tiny.optim,
            learning_rate=3e-4,
            warmup_steps=30,
            fall_steps=300,
            ema_decay=0.99,
        ),
        train=dataclasses.replace(
            tiny.train,
            steps=600,
            seed=67,
            checkpoint_every=50,
            validate_every=600,
        ),
    )
