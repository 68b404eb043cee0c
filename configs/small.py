r"""For one GPU, on scenes made on the device.

    python tools/widen_weights.py tiny -o begin.safetensors
    unips train --config small --workdir runs/small \
        --init-weights begin.safetensors

What: 49 M parameters, `tiny` twice as wide and on larger images. Its run begins from
the shipped `tiny`, widened, which is almost the same function. Scenes are those of
`tiny`, larger, with photographed environments, light that bounces from what is near,
paint, and carvings.
Hardware: meant for one GPU. Time and score: none, it was not trained yet; steps of
smaller batches were seen to run on two CPU cores. Before a step, the widened `tiny` has
6.9 degrees on photographs of DiLiGenT's four objects with 10 images, `tiny` 6.8.
"""

import dataclasses

from unips_jax.models.config import ModelConfig
from unips_jax.scenes.config import SceneConfig
from unips_jax.training.config import Config, DataConfig, OptimConfig, TrainConfig


def get_config() -> Config:
    """The configuration."""
    return Config(
        model=dataclasses.replace(ModelConfig.small(), dtype="bfloat16"),
        data=DataConfig(
            source="scenes",
            image_size=192,
            frame="mask",
            batch_size=32,
            num_images=(3, 10, 10),
            num_pixels=512,
            max_tokens=4096,
            grid_loss=False,
            augment=False,
            known_lights_rate=0.3,
        ),
        scenes=SceneConfig(
            light_weights=(0.25, 0.34, 0.25, 0.08, 0.08),
            shape_weights=(0.15, 0.2, 0.18, 0.14, 0.08, 0.14, 0.11),
            material_weights=(0.1, 0.09, 0.09, 0.08, 0.08, 0.18, 0.14, 0.06, 0.1, 0.08),
            rim_rate=0.6,
            side_rate=0.15,
            whole_frame_rate=0.1,
            photograph_rate=0.3,
            bounce_rate=0.6,
            paint_rate=0.25,
            carving_rate=0.3,
        ),
        optim=OptimConfig(
            name="muon",
            learning_rate=5e-4,
            schedule="cosine",
            warmup_steps=100,
            ema_decay=0.995,
        ),
        train=TrainConfig(
            steps=4000,
            seed=28,
            squared_loss=False,
            coarse_guess_weight=0.2,
            lights_guess_weight=0.1,
            checkpoint_every=400,
            validate_every=2000,
        ),
    )
