"""Lists of lights as programs and people write them."""

import codecs
import time

import numpy as np
import pytest

from unips_jax.errors import InputError
from unips_jax.io.light_list import read_light_list
from unips_jax.io.selection import select

NAMES = [f"photo {i}.jpg" for i in range(1, 5)]
LIGHTS = np.array([[0.707, 0, 0.707], [-0.5, 0.5, 0.707], [0, -1, 0], [0.1, 1e-3, 1]])


def listed(between=" ", *, comma=False, quote="", end="\n", lights=LIGHTS):
    rows = [str(len(NAMES))]
    for name, light in zip(NAMES, lights, strict=True):
        numbers = [f"{n:.6g}".replace(".", "," if comma else ".") for n in light]
        rows.append(between.join([f"{quote}{name}{quote}", *numbers]))
    return end.join([*rows, ""])


STYLES = {
    "blanks": listed(),
    "several blanks": listed("    "),
    "tabs": listed("\t"),
    "decimal commas": listed(comma=True),
    "decimal commas, tabs": listed("\t", comma=True),
    "commas and blanks": listed(", "),
    "commas": listed(","),
    "a blank after the name, commas": listed(",").replace(".jpg,", ".jpg "),
    "semicolons": listed(";"),
    "semicolons, decimal commas": listed(" ; ", comma=True),
    "quoted": listed(quote='"'),
    "single quotes, commas": listed(",", quote="'"),
    "CRLF": listed(end="\r\n"),
    "CR": listed(end="\r"),
    "without a count": listed().partition("\n")[2],
    "without a last line's end": listed().rstrip(),
    "comments and empty lines": "# measured\n\n" + listed(end="\n\n"),
    "Windows folders": listed().replace("photo", r"C:\a, b\photo"),
    "folders": listed().replace("photo", "../set 1/photo"),
}
CODINGS = {
    "utf-8": b"",
    "utf-8 with a mark": codecs.BOM_UTF8,
    "utf-16-le": codecs.BOM_UTF16_LE,
    "utf-16-be": codecs.BOM_UTF16_BE,
    "utf-16-le without a mark": b"",
}


@pytest.mark.parametrize("coding", CODINGS)
@pytest.mark.parametrize("style", STYLES)
def test_ways_to_write_the_same(tmp_path, style, coding):
    data = CODINGS[coding] + STYLES[style].encode(coding.split(" with")[0])
    (tmp_path / "a.lp").write_bytes(data)
    found = read_light_list(tmp_path / "a.lp")
    assert found.names == tuple(NAMES) and found.problems == ()
    np.testing.assert_allclose(found.lights, LIGHTS, rtol=1e-5)


def test_names_may_be_numbers(tmp_path):
    (tmp_path / "a.lp").write_text("2\n7 0 0 1\n08 0 1 0\n")
    found = read_light_list(tmp_path / "a.lp")
    assert found.names == ("7", "08") and found.problems == ()
    np.testing.assert_array_equal(found.lights, [[0, 0, 1], [0, 1, 0]])


def test_places_in_pixels(tmp_path):
    pixels = np.array([[340, 220], [12.5, 7], [0, 0], [1, 2]])
    for number, between in enumerate(" ,;"):
        text = listed(between, lights=pixels)
        (tmp_path / f"{number}.lp").write_text(text)
        found = read_light_list(tmp_path / f"{number}.lp")
        assert found.names == tuple(NAMES) and found.problems == ()
        np.testing.assert_array_equal(found.lights, pixels)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("nonsense", "a.lp, line 3: no name and light, 'nonsense'"),
        ("0.1 0.2 0.9", "a.lp, line 3: a light without a name, '0.1 0.2 0.9'"),
        ("b.jpg,0,1,0,2,0,9", "line 3: no name and light, 'b.jpg,0,1,0,2,0,9'"),
        ("a.jpg 0 0 1", "a.lp, line 3: a.jpg is there twice"),
        ("b.jpg 12 13", "a.lp, line 3: 2 numbers, other than before"),
        ("b.jpg 1e999 0 1", "line 3: no name and light, 'b.jpg 1e999 0 1'"),
    ],
)
def test_lines_that_cannot_be_used_are_named(tmp_path, line, problem):
    (tmp_path / "a.lp").write_text(f"3\na.jpg 0 1 0\n{line}\nc.jpg 0 0 1\n")
    found = read_light_list(tmp_path / "a.lp")
    assert found.names == ("a.jpg", "c.jpg")
    assert len(found.problems) == 1 and problem in found.problems[0]


def test_other_counts_are_said(tmp_path):
    (tmp_path / "a.lp").write_text("7\na.jpg 0 1 0\n")
    problems = read_light_list(tmp_path / "a.lp").problems
    assert problems == ("a.lp: 7 lights by its first line, 1 there",)
    with pytest.raises(InputError, match="b.lp: cannot be read: No such file"):
        read_light_list(tmp_path / "b.lp")


@pytest.mark.parametrize("part", [" ", ";", ",", "0 ", '"', "a b", "0,", "\0"])
def test_long_lines_take_no_time(tmp_path, part):
    (tmp_path / "a.lp").write_text("a" + part * 2_000_000)
    start = time.process_time()
    assert read_light_list(tmp_path / "a.lp").names == ()
    assert time.process_time() - start < 3


def test_photographs_that_were_converted_since(tmp_path):
    for name in ("1.png", "2.png", "3.png", "wall.jpg", "2.tif"):
        (tmp_path / name).touch()
    (tmp_path / "a.lp").write_text("3\n1.jpg 0 0 1\n2.png 0 1 0\n3.jpg 0,1 0 1\n")
    selection = select(tmp_path)
    assert selection.names == ("1.png", "2.png", "3.png")
    assert selection.left_out == {"not listed in a.lp": ["2.tif", "wall.jpg"]}
    (tmp_path / "a.lp").write_text("x.jpg 0 0 1\ny.jpg 0 1 0\n")
    selection = select(tmp_path)
    assert "wall.jpg" in selection.names
    assert selection.left_out["a list of 2 lights, 0 of photographs here"] == ["a.lp"]


def test_lists_that_were_found_somewhere(shared_dir):
    folders = sorted((shared_dir / "cases/lp_not_quite_read").glob("lp_*"))
    if not folders:
        pytest.skip(f"no lists in {shared_dir}")
    for folder in folders:
        selection = select(folder)
        assert len(selection.files) == 8 and "wall.jpg" not in selection.names
        assert selection.left_out in ({}, {"not listed in lights.lp": ["wall.jpg"]})
