"""Recipes by name: which ship, what the paper's one writes out, what is refused."""

import dataclasses
import re
from pathlib import Path

import pytest

from unips_jax.errors import InputError
from unips_jax.models.config import ModelConfig
from unips_jax.scenes.config import LIGHT_KINDS, MATERIALS, SHAPE_KINDS, SceneConfig
from unips_jax.train import main
from unips_jax.training.config import Config
from unips_jax.training.recipes import load_config, shipped_recipes

FOLDER = Path(__file__).resolve().parents[2] / "configs"


def test_all_recipes_ship():
    """From the wheel, where the tests run on one: they lie in the package there."""
    shipped = shipped_recipes()
    files = {path.stem: path.read_text() for path in FOLDER.glob("*.py")}
    assert {name: path.read_text() for name, path in shipped.items()} == files
    assert {"finetune", "small", "tiny", "unips", "unips_official"} <= set(files)


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.py")))
def test_a_recipe_is_known_by_its_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # not by a path from here
    config, file = load_config(name), load_config(FOLDER / f"{name}.py")
    assert isinstance(config, Config)
    # A file of meshes is looked for where the recipe lies.
    scenes = dataclasses.replace(config.scenes, mesh_file=file.scenes.mesh_file)
    assert dataclasses.replace(config, scenes=scenes) == file


def test_an_unknown_recipe_has_the_names_listed(tmp_path, capsys):
    run = tmp_path / "run"
    assert main(["--config", "tyny", "--workdir", str(run)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and not run.exists()
    assert "--config tyny: expected a Python file or one of ablation, " in error
    assert "tiny, unips, unips_official, found none" in error
    with pytest.raises(InputError, match="expected a Python file or one of"):
        load_config(tmp_path / "absent.py")


def test_the_papers_recipe_writes_every_value_out():
    """But those of parts of ours that it has not, which are 0 or off."""
    text, config = (FOLDER / "unips.py").read_text(), load_config("unips")
    guesses = {f"{name}_guess_weight" for name in ("coarse", "lights", "kinds")}
    for part in (config.model, config.data, config.optim, config.train):
        written = {name for name, value in vars(part).items() if value}
        unused = {"network", "scene_share", "distance_smoothing"}
        for name in written - guesses - unused:
            assert re.search(rf"\b{name}=", text), name
    departures = re.findall(r"# Departure: ([^\n]*)", text)
    assert len(departures) == 4, departures
    paper = dataclasses.replace(ModelConfig.paper(), remat=True)
    assert load_config("unips") == Config(model=paper)


def test_finetuning_begins_from_the_shipped_network():
    config, tiny = load_config("finetune"), load_config("tiny")
    assert config.model == tiny.model == ModelConfig.tiny()
    weights = dict(zip(MATERIALS, config.scenes.material_weights, strict=True))
    assert weights["metal"] == pytest.approx(0.5) == sum(weights.values()) / 2
    assert config.train.seed != tiny.train.seed  # scenes seen once are remembered
    for source in ("mixture", "folders"):  # that know no lights
        data = dataclasses.replace(config.data, source=source, root="mine")
        assert dataclasses.replace(config, data=data).data.known_lights_rate == 0.3


@pytest.mark.parametrize("name", ["ablation", "finetune", "long", "small", "tiny"])
def test_our_recipes_use_all_parts_of_the_network(name):
    config = load_config(name)
    assert config.model.light_tokens and config.train.kinds_guess_weight > 0
    assert config.model.known_lights and config.data.known_lights_rate > 0


def test_help_names_what_weights_are_of_in_their_order():
    text = " ".join(SceneConfig.__doc__.split())
    for kinds in (LIGHT_KINDS, SHAPE_KINDS, MATERIALS):
        assert f": {', '.join(kinds)}." in text
