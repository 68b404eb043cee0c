"""Validation on held-out scenes."""

import dataclasses
import json
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from evaluation_data import tilted
from small_networks import SMALL, lively_network

from unips_jax.cli import validate as command
from unips_jax.scenes import Scene, SceneConfig
from unips_jax.training import validation
from unips_jax.training.config import Config, DataConfig, TrainConfig
from unips_jax.training.log import TrainLog
from unips_jax.training.validation import validate, validation_pictures
from unips_jax.weights import save_weights

CONFIG = Config(
    model=dataclasses.replace(SMALL, depths=(1,), num_heads=(2,)),
    data=DataConfig(source="scenes", image_size=32),
    train=TrainConfig(validation_images=2),
)


def made_up(true, estimate, light, shape, material, focal):
    mask = np.array([[True] * (len(true) - 1) + [False]])
    images = np.full((2, *mask.shape, 3), 0.5, np.float32)
    lights = np.zeros(0)
    scene = Scene(
        images=images,
        mask=mask,
        normals=tilted(*true),
        light_kind=np.int32(light),
        shape_kind=np.int32(shape),
        material=np.int32(material),
        focal=np.float32(focal),
        light_directions=lights,
        light_intensities=lights,
        light_means=lights,
        base_color=np.full((*mask.shape, 3), 0.5, np.float32),
        roughness=np.full(mask.shape, 0.5, np.float32),
        metallic=np.zeros(mask.shape, np.float32),
    )
    return scene, 3 * tilted(*estimate)


def test_pictures_and_their_log(tmp_path, monkeypatch):
    scene, normals = made_up(np.full(32, 20), np.full(32, 30), 0, 2, 5, 0)
    found = scene, normals / 3
    monkeypatch.setattr(validation, "estimate_held_out", lambda *_, **__: [found])
    pictures = validation_pictures(None, CONFIG, count=1)
    picture = pictures["validation/scene0"]
    assert picture.dtype == np.uint8
    photograph, true, estimate, error = np.split(picture, 4, axis=1)
    assert photograph.shape == (1, 32, 3)
    inside = np.s_[0, :31]
    expected = 127.5 * (1 + tilted(20)[0, 0])
    assert np.abs(true[inside] - expected).max() < 1.5
    assert np.abs(estimate[inside] - 127.5 * (1 + tilted(30)[0, 0])).max() < 1.5
    assert (error[inside] == error[0, 0]).all() and error[0, 0].max() > 0

    seen = []

    class Writer:
        def __init__(self, *_, **__):
            pass

        def add_image(self, *arguments, **options):
            seen.append((*arguments, options))

    fake = SimpleNamespace(SummaryWriter=Writer)
    monkeypatch.setitem(sys.modules, "tensorboardX", fake)
    log = TrainLog(tmp_path, 0, 1)
    assert log.shows_pictures
    log.pictures(7, pictures)
    assert seen[0][0] == "validation/scene0"
    np.testing.assert_array_equal(seen[0][1], picture)
    assert seen[0][2:] == (7, {"dataformats": "HWC"})


def test_scores_by_hand(monkeypatch):
    """Means over each scene's object first, then over scenes."""
    held_out = [
        made_up((0, 10, 20, 0), (10, 10, 25, 80), 0, 2, 5, 0),  # 10, 0 and 5
        made_up((40, 0), (70, 80), 0, 6, 5, 50),
        made_up((-30, 30, 0), (-10, 10, 80), 4, 2, 0, 50),
    ]
    monkeypatch.setattr(validation, "estimate_held_out", lambda *_, **__: held_out)
    options = {"count": 3, "num_images": 2, "size": 8}
    scores = validate(None, SceneConfig(), **options)
    assert scores == pytest.approx(
        {
            "mae": (5 + 30 + 20) / 3,
            "constant": (10 + 40 + 30) / 3,
            "light/directional": (5 + 30) / 2,
            "light/area": 20,
            "shape/machine": (5 + 20) / 2,
            "shape/plate": 30,
            "material/metal": (5 + 30) / 2,
            "material/fabric": 20,
            "camera/orthographic": 5,
            "camera/perspective": (30 + 20) / 2,
        },
        rel=1e-4,
    )


def as_asked(_, __, *, count, light_kind, material, shape, **sizes):
    """In place of scenes that are rendered, which takes long to compile."""
    assert sizes == {"num_images": 2, "size": 32}
    return count * [made_up((0, 10), (10, 10), light_kind, shape, material, 0)]


@pytest.mark.parametrize(
    "rendered", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_all_scenes_of_one_kind(rendered, tmp_path, capsys, monkeypatch):
    if not rendered:
        monkeypatch.setattr(validation, "estimate_held_out", as_asked)
    weights = str(tmp_path / "w.safetensors")
    save_weights(weights, lively_network(CONFIG.model))
    sizes = ["--scenes", "3", "--images", "2", "--size", "32"]
    kinds = ["--light", "point", "--material", "dark", "--shape", "relief"]
    assert command.main(["--weights", weights, *sizes, *kinds, "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    groups = {name for name in scores if "/" in name and "camera" not in name}
    assert groups == {"light/point", "material/dark", "shape/relief"}
    assert command.main(["--weights", weights, *sizes, *kinds]) == 0
    shown = capsys.readouterr().out
    assert re.search(rf"all +\S {scores['mae']:.2f}", shown)
    assert re.search(rf"light: point +\S {scores['light/point']:.2f}", shown)
    assert "2 images" in shown and "3 held-out scenes of 32 x 32" in shown


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--size", "50"], "--size: expected a multiple of 4, got 50"),
        (["--images", "8", "0"], "--images: expected at least 1, got 0"),
        (["--scenes", "0"], "--scenes, --images: expected at least 1, got 0"),
        (["--images"], "--scenes, --images: expected at least 1, got 0"),
    ],
)
def test_bad_arguments_are_named(arguments, expected, capsys):
    assert command.main(arguments) == 2
    assert expected in capsys.readouterr().err
