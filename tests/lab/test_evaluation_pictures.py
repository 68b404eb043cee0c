"""Sheets and charts of a report."""

import io

import evaluation_data as data
import numpy as np
from matplotlib.image import imread

from unips_jax.baselines.method import Observed
from unips_jax.evaluation.protocols import Case
from unips_jax.evaluation.sheets import Panel, sheet
from unips_jax.pictures import fonts, maps


def case_of(**changes):
    mask, normals = data.sphere(40, 60)
    images = data.shade(normals, data.lights(3)).astype(np.float32)
    case = Case(Observed(images, mask), normals.astype(np.float32))
    return case._replace(**changes)


def test_sheet_of_many_methods_wraps():
    case = case_of()
    panels = [Panel(f"method number {i}", case.normals, float(i)) for i in range(10)]
    few, many = (imread(io.BytesIO(sheet("x", case, p))) for p in (panels[:3], panels))
    assert many.shape[0] > 1.4 * few.shape[0]
    assert sheet("x", case, panels) == sheet("x", case, panels)


def test_names_on_sheets_are_no_formulas():
    panels = [Panel(r"$5_$6_\frac", case_of().normals, 1.0)]
    assert imread(io.BytesIO(sheet(r"$5_$6_\frac", case_of(), panels))).ndim == 3


def test_a_sheet_shows_each_methods_normals_and_errors():
    """The truth, and the same mirrored, in red's share and in inferno."""
    case = case_of()
    mirrored = case.normals * np.float32([-1, 1, 1])
    panels = [Panel("true", case.normals, 0.0), Panel("mirrored", mirrored, 9.0)]
    picture = imread(io.BytesIO(sheet("x", case, panels)))[..., :3]

    def at(column, row, share):
        top, left = 0.42 + 1.88 * row + 0.28, 0.08 + 1.68 * column
        return picture[round((top + 0.8) * 160), round((left + 1.6 * share) * 160)]

    # Photographs and true normals come first; then a column for each method.
    for column, red in ((0, 0.24), (1, 0.24), (2, 0.76)):
        assert abs(at(column, 1, 0.25)[0] - red) < 0.05
    assert at(1, 2, 0.25).max() < 0.1
    assert at(2, 2, 0.25)[0] > 0.9 and at(2, 2, 0.5).max() < 0.2


def test_sheet_without_truth_or_estimate():
    panels = [Panel("good", case_of().normals, None), Panel("lacking", None, None)]
    assert imread(io.BytesIO(sheet("x", case_of(normals=None), panels))).ndim == 3


def test_pictures_are_white_outside_and_exact_inside():
    mask = np.array([[True, True, True, False]])
    normals = np.array([[[1.0, 0, -1], [-0.6, 0.8, 0], [0, -1, 0], [0, 0, 1]]])
    white = [255, 255, 255]
    np.testing.assert_array_equal(
        maps.normals_picture(normals, mask),
        [[[255, 128, 0], [51, 230, 128], [128, 0, 128], white]],
    )
    # Inferno from nothing over half the scale to 80 degrees, where it is clipped.
    errors = maps.error_picture(np.array([[0.0, 40, 80, 40]]), mask)
    np.testing.assert_array_equal(
        errors, [[[0, 0, 4], [188, 55, 84], [252, 255, 164], white]]
    )
    clipped = maps.error_picture(np.array([[170.0, 0, 0, 0]]), mask)
    np.testing.assert_array_equal(clipped[0, 0], errors[0, 2])
    black = np.zeros((1, 4, 3), np.float32)
    np.testing.assert_array_equal(maps.photograph_picture(black, mask)[0, 0], 0)
    # Half of white is 188 in sRGB (IEC 61966-2-1); what lies outside has no say.
    image = np.array([[[8, 4, 0], [8, 8, 8], [8, 0, 0], [99, 99, 99]]], np.float32)
    np.testing.assert_array_equal(
        maps.photograph_picture(image, mask),
        [[[255, 188, 0], white, [255, 0, 0], white]],
    )


def test_names_of_any_script_can_be_drawn():
    """Fonts or not: filterwarnings makes a missing character an error."""
    name = "測試 кот 🐱👩\N{ZERO WIDTH JOINER}🔬 \ue000"
    case = case_of()
    panels = [Panel(name, case.normals, 1.0), Panel("x" * 200, None, None, "y " * 90)]
    assert imread(io.BytesIO(sheet(name * 20, case, panels))).ndim == 3


def test_missing_characters_become_squares():
    text, families = fonts.drawable("a\ue000\N{ZERO WIDTH JOINER}é")
    assert text.startswith("a\N{WHITE SQUARE}") and text.endswith("é")
    assert "DejaVu Sans" in families


def test_names_are_shortened_in_the_middle():
    assert fonts.shorten("short", 5) == "short"
    assert fonts.shorten("abcdefghij", 5) == "ab…ij"
    wide = fonts.shorten("測試用權重" * 4, 11)
    assert wide[0] == "測" and wide[-1] == "重" and fonts.text_width(wide) <= 11
