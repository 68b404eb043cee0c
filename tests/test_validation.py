"""Validation on held-out scenes."""

import dataclasses

import numpy as np
from small_networks import SMALL, lively_weights

from unips_jax.config import Config, DataConfig, TrainConfig
from unips_jax.scenes import SceneConfig
from unips_jax.train_log import TrainLog
from unips_jax.validation import validate, validation_pictures

CONFIG = Config(
    model=dataclasses.replace(SMALL, depths=(1,), num_heads=(2,)),
    data=DataConfig(source="scenes", image_size=32),
    train=TrainConfig(validation_images=2),
)


def test_scores_groups_and_pictures(tmp_path):
    params = lively_weights(CONFIG.model)
    options = {"count": 3, "num_images": 2, "size": 32}
    scores = validate(params, CONFIG.model, SceneConfig(), **options)
    assert 0 < scores["constant"] < 90
    for group in ("light", "material", "shape", "camera"):
        members = [v for k, v in scores.items() if k.startswith(f"{group}/")]
        assert min(members) - 1e-6 <= scores["mae"] <= max(members) + 1e-6

    pictures = validation_pictures(params, CONFIG, count=1)
    picture = pictures["validation/scene0"]
    assert picture.shape == (32, 4 * 32, 3)
    assert picture.dtype == np.uint8

    log = TrainLog(tmp_path, 0, 1)
    seen = []

    class Writer:
        def add_image(self, *arguments, **options):
            seen.append((*arguments, options))

    log._tensorboard = Writer()
    assert log.shows_pictures
    log.pictures(7, pictures)
    assert seen[0][0] == "validation/scene0"
    assert seen[0][2:] == (7, {"dataformats": "HWC"})
