"""For one GPU, on scenes made on the device.

    unips train --config configs/small.py --workdir runs/small

What: 23.1 M parameters. Communication, ratios, observations, consensus, windows that
cover as much of the object and mirrored images are those of `tiny`; what they gain at
this size was not measured.
Hardware: meant for one GPU. Time and score: none, it was not trained yet; twenty steps,
with smaller batches, were seen to run on two CPU cores.
"""

from unips_jax.models.config import ModelConfig
from unips_jax.training.config import Config, DataConfig, OptimConfig, TrainConfig


def get_config() -> Config:
    """The configuration."""
    return Config(
        model=ModelConfig.small(),
        data=DataConfig(
            source="scenes",
            image_size=128,
            frame="mask",
            batch_size=32,
            num_images=(2, 4, 8),
            num_pixels=1024,
            max_tokens=2048,
            grid_loss=False,
            augment=False,
        ),
        optim=OptimConfig(
            name="muon",
            learning_rate=1e-3,
            schedule="cosine",
            warmup_steps=500,
            ema_decay=0.999,
        ),
        train=TrainConfig(
            steps=8000,
            squared_loss=False,
            checkpoint_every=500,
            validate_every=2000,
        ),
    )
