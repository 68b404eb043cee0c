r"""The long run: rich scenes at a constant rate, until nothing more is gained.

    python tools/fetch_assets.py assets --shapes
    unips train --config long --workdir runs/long --init-weights tiny --train.seed 1

(the seed must be new, since scenes seen once are remembered).

What: `tiny` from its weights, on scenes of which a quarter are meshes by others, in
environments of which a third are photographed, with light that bounces from what is
near, paint, carvings, spotted metal, masks that miss the object in 30 % (they are
learnt), and borders that mix with a background in nearly all. Half of the near lamps
stand 3 to 15 radii away, lenses are those that photograph objects, and small errors
count, too. Images have 192 x 192 pixels: objects in photographs are larger than the 128
x 128 of `tiny`. A fork that falls shows what a checkpoint is worth: copy the folder,
and go on in it with `--train.steps N --optim.fall-steps 400`.
Hardware: two CPU cores, over as many sittings as it takes. Time: 6.6 s a step.
Score: that of the shipped weights, half way between the mean after
2,601 steps and where they began (`docs/history/tiny.md`).
"""

import dataclasses
import runpy
from pathlib import Path

from unips_jax.scenes.config import SceneConfig
from unips_jax.training.config import Config

SHAPES = "assets/shapes/shapes.npz"  # where the first command puts them


def get_config() -> Config:
    """The configuration."""
    tiny = runpy.run_path(str(Path(__file__).with_name("tiny.py")))["get_config"]()
    return dataclasses.replace(
        tiny,
        data=dataclasses.replace(tiny.data, image_size=192),
        scenes=SceneConfig(
            light_weights=(0.24, 0.32, 0.24, 0.1, 0.1),
            shape_weights=(0.14, 0.2, 0.17, 0.14, 0.08, 0.15, 0.12),
            material_weights=(0.1, 0.09, 0.09, 0.08, 0.08, 0.2, 0.12, 0.06, 0.1, 0.08),
            perspective_rate=0.5,
            focal_range_mm=(24.0, 400.0),
            rim_rate=0.3,
            mixed_rate=0.9,
            far_lamp_rate=0.5,
            side_rate=0.1,
            whole_frame_rate=0.1,
            photograph_rate=0.33,
            linear_rate=0.8,
            bounce_rate=0.4,
            paint_rate=0.2,
            carving_rate=0.2,
            metal_spot_rate=0.3,
            mesh_rate=0.25,
            mesh_file=SHAPES,
        ),
        optim=dataclasses.replace(
            tiny.optim,
            learning_rate=2e-4,
            warmup_steps=100,
            fall_steps=2500,
            ema_decay=0.998,
        ),
        train=dataclasses.replace(
            tiny.train,
            steps=14_500,
            seed=670,
            distance_smoothing=1e-4,
            checkpoint_every=50,
            validate_every=2500,
        ),
    )
