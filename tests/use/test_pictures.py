"""Pictures without matplotlib: letters of any script, colours of its maps."""

import matplotlib
import numpy as np
import pytest

from unips_jax.pictures import lettering
from unips_jax.pictures.maps import colours_of


def written(text, size=20.0):
    picture = np.zeros((40, 300, 3), np.uint8)
    lettering.write_line(picture, (4, 20), text, size=size, colour="#ff8000")
    return picture


def test_letters_stand_where_they_should_in_their_colour():
    picture = written("Größe")
    rows, columns = np.nonzero(picture[..., 0])
    assert columns.min() in range(3, 8) and 50 < columns.max() < 80
    assert abs((rows.min() + rows.max()) / 2 - 20) < 5  # with the dots of the ö
    assert picture[..., 0].max() == 255 and picture[..., 2].max() == 0
    assert np.abs(written("Große").astype(int) - picture).max() > 100


def test_what_no_font_has_is_a_box(monkeypatch):
    private = "\ue123\ue124"
    a, b = (written(character) for character in private)
    assert a.any() and np.array_equal(a, b)
    monkeypatch.setattr(lettering, "_dejavu", lambda: "no such font.ttf")
    lettering._first_font.cache_clear()
    assert written("Größe").any()
    lettering._first_font.cache_clear()


@pytest.mark.parametrize("name", ["inferno", "viridis"])
def test_colours_are_those_of_matplotlib(name):
    share = np.linspace(0, 1, 1001)
    expected = matplotlib.colormaps[name](share)[:, :3]
    np.testing.assert_allclose(colours_of(share, name), expected, atol=0.5 / 255)


def test_what_is_no_letter_is_a_gap():
    expected = written("a b")
    for code in (*range(0x20), *range(0x7F, 0xA0), 0x2028, 0x2029):
        np.testing.assert_array_equal(written(f"a{chr(code)}b"), expected)
