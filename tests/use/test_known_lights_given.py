"""Lights that are given with photographs, as a list or by hand."""

import json

import numpy as np
import pytest
from estimate_runs import EXAMPLES, pot, run

from unips_jax import weights
from unips_jax.errors import InputError
from unips_jax.estimation.extras import _with_known
from unips_jax.lighting.known import read_known_lights
from unips_jax.models.config import ModelConfig
from unips_jax.models.network import UniversalNetwork

NAMES = ["a_1.jpg", "a_2.jpg", "3.jpg", "b.jpg"]
LIST = "3\nB.TIF 0,6 0 0,8\na_2.png 0 0 2\nother.jpg 1 0 0\n"


def test_a_list_gives_lights_by_name_and_the_others_stay_unknown(tmp_path):
    (tmp_path / "dome.lp").write_text(LIST)
    found = read_known_lights([str(tmp_path / "dome.lp")], NAMES)
    expected = [[0, 0, 0], [0, 0, 1], [0, 0, 0], [0.6, 0, 0.8]]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    in_order = read_known_lights([str(tmp_path / "dome.lp")], ["x", "y", "z"])
    np.testing.assert_allclose(in_order[2], [1, 0, 0], atol=1e-6)


def test_words_give_directions_that_are_known_roughly():
    half = 0.5**0.5
    for text, row, direction in (
        ("1: left", 0, [-half, 0, half]),
        ("a_2.jpg: Upper  right", 1, [0.5, 0.5, half]),
        ("3: front", 2, [0, 0, 1]),  # the name is looked at before the number
        ("b: bottom, front", 3, [0, -(0.2**0.5), 0.8**0.5]),
        ("04:above", 3, [0, half, half]),
    ):
        found = read_known_lights([text], NAMES)
        cosine = np.cos(np.radians(35))
        np.testing.assert_allclose(found[row], cosine * np.array(direction), atol=1e-6)
        assert np.count_nonzero(found.any(axis=1)) == 1


def test_later_ones_replace_earlier_ones(tmp_path):
    (tmp_path / "dome.lp").write_text(LIST)
    given = [str(tmp_path / "dome.lp"), "b: left", "1: right"]
    found = read_known_lights(given, NAMES)
    assert found[3, 0] < 0 < found[0, 0] and found[1, 2] == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("5: left", "its number from 1 to 4, got 5"),
        ("0: left", "its number from 1 to 4, got 0"),
        ("9" * 5000 + ": left", "its number from 1 to 4, got 9"),
        ("c.jpg: left", "expected a photograph's name"),
        ("1: left right", "words that cancel out"),
        ("1: left blue", "got blue"),
        ("1: blue", "found no such file"),
        ("none.lp", "found no such file"),
        ("others.lp", "got 1 of other names"),
        ("more.lp", "got 5 of other names"),
        ("half.lp", "got 2 of 4 by name, none for 3.jpg"),
        ("pixels.lp", "three numbers, got highlights' places"),
    ],
)
def test_what_fits_no_photograph_is_refused(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "others.lp").write_text("x.jpg 0 0 1\n")
    more = "".join(f"x{i}.jpg 0 0 1\n" for i in range(5))
    (tmp_path / "more.lp").write_text(more)
    half = "".join(f"{name} 0 0 1\n" for name in ("a_1.png", "a_2.png", "a_3", "a_4"))
    (tmp_path / "half.lp").write_text(half)
    (tmp_path / "pixels.lp").write_text("b.jpg 10 20\n")
    with pytest.raises(InputError, match=message) as caught:
        read_known_lights([text], NAMES)
    assert str(caught.value).startswith("--known-lights") and "\n" not in str(caught)


def test_the_command_passes_them_on(tmp_path, network_calls, capsys):
    folder = pot(tmp_path)
    (tmp_path / "dome.lp").write_text("L_0.png 0 0 1\nL_4.png 0 0.6 0.8\n")
    given = folder, "-o", tmp_path / "out", "--known-lights"
    assert run(*given, tmp_path / "dome.lp", "2: left") == 0
    lights = network_calls[0]["lights"]
    assert lights.shape == (EXAMPLES, 3) and lights.dtype == np.float32
    assert list(np.nonzero(lights.any(axis=1))[0]) == [0, 1, 4]
    assert "known of 3 of 6" in capsys.readouterr().out
    record = json.loads((tmp_path / "out" / "pot" / "normals.json").read_text())
    assert list(record["options"]["known_lights"]) == ["L_0.png", "L_1.png", "L_4.png"]
    assert run(*given, tmp_path / "dome.lp", "2: left") == 0
    assert len(network_calls) == 1  # up to date
    assert run(*given, tmp_path / "dome.lp", "2: right") == 0
    assert len(network_calls) == 2


def test_the_papers_network_has_no_use_for_them(
    tmp_path, network_calls, monkeypatch, capsys
):
    paper = UniversalNetwork(ModelConfig.paper(), {"a": {"kernel": np.ones(2)}})
    monkeypatch.setattr(weights, "load_weights", lambda name: paper)
    folder = pot(tmp_path)
    assert run(folder, "-o", tmp_path / "out", "--known-lights", "1: left") != 0
    error = capsys.readouterr().err
    assert "--known-lights: expected weights of a network that guesses" in error
    assert not network_calls and not (tmp_path / "out" / "pot").exists()


def test_written_lights_point_where_exact_ones_do():
    guesses = np.array([[0, 0, 0.5], [0.3, 0, 0.4], [0, 0.8, 0.6]])
    known = np.array([[0, 1, 0], [0.5, 0, 0.5], [0, 0, 0]])
    found = _with_known(guesses, known)
    np.testing.assert_allclose(found, [[0, 0.5, 0], *guesses[1:]])
    assert _with_known(guesses, None) is guesses and _with_known(None, known) is None
