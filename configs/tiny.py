r"""The embedded default: small enough to train on two CPU cores.

    unips train --config tiny --workdir runs/tiny

What: 12.4 M parameters, on endless scenes made on the device: a mixture with more
environments, metals, machines and plates than `SceneConfig` draws, borders that mix
with a background under wrong masks, light from one side, and whole frames. In three
of ten sets with a lamp the network is given it, roughly or exactly. Scores are compared
by `unips validate`, weights chosen by `tools/real_sets.py`.
Hardware: two CPU cores. Time: 5.2 s a step there.
Score: the shipped weights have 8.8 degrees on 256 held-out scenes with 8 images
(constant normal 39.7), 6.8 on photographs of DiLiGenT's objects; more in
`docs/results.md`.

These fields train from nothing, and were not run in one go. The shipped weights came
by 47 runs, 75,872 steps, each from the weights before, the last on the scenes of
`configs/long.py` (`docs/history/tiny.md`). A further run is

    unips train --config tiny --workdir runs/more --init-weights tiny \
        --optim.learning-rate 2e-4 --optim.warmup-steps 30 --optim.fall-steps 600 \
        --optim.ema-decay 0.99 --train.steps 1000 --train.seed 1

(the seed must be new, since scenes seen once are remembered).
"""

from unips_jax.models.config import ModelConfig
from unips_jax.scenes.config import SceneConfig
from unips_jax.training.config import Config, DataConfig, OptimConfig, TrainConfig


def get_config() -> Config:
    """The configuration."""
    return Config(
        model=ModelConfig.tiny(),
        data=DataConfig(
            source="scenes",
            image_size=128,
            frame="mask",
            batch_size=12,
            num_images=(2, 4, 8, 8),
            num_pixels=384,
            max_tokens=1024,
            grid_loss=False,
            augment=False,
            known_lights_rate=0.3,
        ),
        scenes=SceneConfig(
            light_weights=(0.2, 0.38, 0.24, 0.09, 0.09),
            shape_weights=(0.14, 0.2, 0.18, 0.14, 0.08, 0.14, 0.12),
            material_weights=(0.1, 0.09, 0.09, 0.08, 0.08, 0.2, 0.12, 0.06, 0.1, 0.08),
            rim_rate=0.6,
            side_rate=0.2,
            whole_frame_rate=0.15,
        ),
        optim=OptimConfig(
            name="muon",
            learning_rate=2e-3,
            schedule="trapezoid",
            warmup_steps=100,
            fall_steps=1000,
            ema_decay=0.998,
        ),
        train=TrainConfig(
            steps=1500,
            squared_loss=False,
            coarse_guess_weight=0.2,
            lights_guess_weight=0.1,
            checkpoint_every=250,
            validate_every=1000,
        ),
    )
