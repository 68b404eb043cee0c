"""What a reader measures, enhances, writes into the page and saves from it."""

import re
import time

import cv2
import known_results
import numpy as np
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")

from browser import ABSENT, browser, messages
from selenium.webdriver import ActionChains
from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from viewer_page import (
    choose,
    drag,
    drawn,
    element,
    opened,
    point,
    press,
    slide,
)

from unips_jax.viewer.page import notes_in, write_tiled_view, write_view

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tools")


@pytest.fixture(scope="module")
def driver(folder):
    (folder / "saved").mkdir()
    saved = {"download.default_directory": str(folder / "saved")}
    with browser(preferences=saved) as driver:
        yield driver


@pytest.fixture
def page(driver, folder):
    path = folder / "hemisphere.html"
    if not path.exists():
        write_view(path, known_results.result())
    driver.get(path.as_uri())
    opened(driver)
    yield driver
    assert messages(driver) == []
    driver.execute_script("onbeforeunload = null")


def saved(folder, name):
    """A file that the browser saved, once it is whole."""
    path = folder / "saved" / name
    for _ in range(100):
        if path.exists() and not list(path.parent.glob("*.crdownload")):
            return path
        time.sleep(0.1)
    raise AssertionError(f"{name} was not saved")


def set_scale(page, millimetres):
    press(page, "[data-tool=scale]")
    drag(page, (-0.5, 0), (0.5, 0))
    element(page, "millimetres").clear()
    element(page, "millimetres").send_keys(millimetres, Keys.ENTER)


def overlay(page):
    return page.find_element(By.ID, "overlay").text


def ends(page, name, attribute):
    """An attribute of all marks of a kind, in the screen's pixels."""
    # At once: they are drawn anew at any time.
    read = """const [marks, name] = arguments;
        return [...document.querySelectorAll(marks)].map((x) => +x.getAttribute(name));
    """
    return page.execute_script(read, f"#overlay {name}", attribute)


def test_a_drag_draws_a_profile(page):
    press(page, "[data-tool=profile]")
    drag(page, (0, 0), (0.8, 0))
    text = element(page, "reading").text
    numbers = [float(x) for x in re.findall(r"-?\d+(?:\.\d+)?", text)]
    # 0.8 of the radius along, from its top to 0.6 of it: straight through space 0.894.
    expected = known_results.RADIUS * np.array([0.8, -0.4])
    np.testing.assert_allclose(numbers[0], expected[0], atol=1)
    np.testing.assert_allclose(numbers[1], expected[1], atol=1)
    assert numbers[-1] == pytest.approx(0.8**0.5 * known_results.RADIUS, abs=1)
    assert element(page, "chart").is_displayed()
    # With Shift it moves a magnified picture, and the line stays where it is.
    element(page, "stage").send_keys("+", "+", "+")
    before = ends(page, "line", "x1")
    keys = ActionChains(page).key_down(Keys.SHIFT)
    keys.move_to_element(element(page, "stage")).click_and_hold()
    keys.move_by_offset(40, 0).move_by_offset(20, 0).release().key_up(Keys.SHIFT)
    keys.perform()
    drawn(page)
    after = ends(page, "line", "x1")
    assert len(before) == 2 and after[0] == pytest.approx(before[0] + 60, abs=2)
    assert element(page, "reading").text == text


def test_two_points_and_their_length_give_everything_a_unit(page):
    assert "mm" not in overlay(page)
    set_scale(page, "18")  # half a millimetre a pixel
    drawn(page)
    bar = element(page, "scale-bar").text
    assert re.fullmatch(r"[125]0? mm", bar)
    press(page, "[data-tool=profile]")
    drag(page, (-0.5, 0), (0.5, 0))
    text = element(page, "reading").text
    assert (
        text.startswith("Profile of 18")
        and text.endswith("space: 18 mm.")
        or (
            float(re.search(r"space: ([\d.]+) mm", text)[1])
            == pytest.approx(18, abs=0.3)
        )
    )
    choose(page, "left", "depth")
    reach = float(re.search(r"([\d.]+) mm", element(page, "legend").text)[1])
    assert reach == pytest.approx(0.5 * 0.86 * known_results.RADIUS, rel=0.02)
    # What the bar's length is on the screen.
    path = page.find_element(By.CSS_SELECTOR, "#overlay path:nth-last-child(2)")
    width = float(re.search(r"H([\d.]+)", path.get_attribute("d"))[1]) - 14
    places = ends(page, "circle", "cx")
    per_mm = (places[-1] - places[0]) / 18
    assert width == pytest.approx(float(bar.split()[0]) * per_mm, rel=0.03)
    press(page, "[data-tool=scale]")
    drag(page, (-0.5, 0), (0.5, 0))
    element(page, "millimetres").send_keys("no number", Keys.ENTER)
    drawn(page)
    assert element(page, "scale-bar").text == bar
    # Up the slope it is the length through space that was entered.
    press(page, "[data-tool=scale]")
    drag(page, (0, 0), (0.7, 0))
    element(page, "millimetres").clear()
    element(page, "millimetres").send_keys("20", Keys.ENTER)
    assert re.search(r"\b20 mm", element(page, "reading").text)
    press(page, "#drop-scale")
    drawn(page)
    assert "mm" not in overlay(page)


def test_detail_makes_small_relief_stronger(driver, folder):
    write_view(
        folder / "ripples.html", known_results.ripples(size=120, length=5, slope=0.04)
    )
    driver.get((folder / "ripples.html").as_uri())
    opened(driver)
    slide(driver, "gloss", 0)
    slide(driver, "azimuth", 0)
    slide(driver, "elevation", 45)

    def contrast():
        picture = drawn(driver) / 255
        row = picture[picture.shape[0] // 2, :, 1]
        middle = row[row.size // 2 - 90 : row.size // 2 + 90]
        return np.std(((middle + 0.055) / 1.055) ** 2.4)

    plain = contrast()
    slide(driver, "detail", 50)
    half = contrast()
    slide(driver, "detail", 100)
    # n + 4 (n - mean), and the mean of whole waves is flat: five times as steep.
    assert contrast() / plain == pytest.approx(5, rel=0.15)
    assert half / plain == pytest.approx(3, rel=0.15)
    slide(driver, "detail", 0)
    assert contrast() == pytest.approx(plain, rel=1e-3)
    assert messages(driver) == []


def test_notes_views_and_scale_are_in_the_saved_page(page, folder):
    set_scale(page, "18")
    press(page, "[data-tool=note]")
    point(page, 0.4, 0.3).click().perform()
    evil = "</script><b>crack"
    ActionChains(page).send_keys(evil).perform()
    choose(page, "left", "normals")
    press(page, "[data-tool=light]")
    element(page, "stage").send_keys("+", "+")
    press(page, "#add-view")
    assert element(page, "unsaved").is_displayed()
    drawn(page)
    assert evil in overlay(page)
    press(page, "#save-page")
    path = saved(folder, "hemisphere.html")
    assert not element(page, "unsaved").is_displayed()
    zoomed = drawn(page)
    page.get(path.as_uri())
    opened(page)
    drawn(page)
    assert evil in overlay(page) and element(page, "scale-bar").text
    fields = page.find_elements(By.CSS_SELECTOR, "#notes-list input, #views-list input")
    assert [f.get_attribute("value") for f in fields] == [evil, "View 1"]
    press(page, "#views-list button")
    assert value_of(page, "left") == "normals"
    np.testing.assert_allclose(drawn(page), zoomed, atol=3)
    # The place is that of the hemisphere, in pixels of the result.
    notes = notes_in(path)
    place = np.array(notes["notes"][0]["place"]) - known_results.SIZE / 2
    np.testing.assert_allclose(place / known_results.RADIUS, [0.4, -0.3], atol=0.03)
    assert notes["scale"]["mm"] == pytest.approx(0.5, rel=0.02)
    # The command writes the page anew and keeps them.
    write_view(path, known_results.result(pixel_mm=2.0))
    assert notes_in(path)["notes"] == notes["notes"] and "scale" not in notes_in(path)
    press(page, "#notes-list button:last-child")
    assert not page.find_elements(By.CSS_SELECTOR, "#notes-list li")
    path.unlink()


def value_of(page, name):
    return element(page, name).get_attribute("value")


def test_a_view_of_a_photograph_that_is_no_more_shows_the_lit_surface(page, folder):
    for side in ("left", "right"):
        choose(page, side, "photograph-1")
    press(page, "#add-view")
    press(page, "#save-page")
    path = saved(folder, "hemisphere.html")
    write_view(path, known_results.result(photographs=()))
    page.get(path.as_uri())
    opened(page)
    choose(page, "left", "normals")
    press(page, "#views-list button")
    drawn(page)
    assert value_of(page, "left") == "lit"
    # Of two there is one left: nothing next to it.
    chosen = "return document.getElementById('right').selectedIndex"
    assert page.execute_script(chosen) == 0
    assert not element(page, "divider").is_displayed()
    path.unlink()


def test_a_long_note_is_cut_between_letters(page, folder):
    press(page, "[data-tool=note]")
    point(page, 0, 0).click().perform()
    # Each has two units of UTF-16: one of these texts would be cut within one.
    for text in ("\N{GRINNING FACE}" * 50, "x" + "\N{GRINNING FACE}" * 50):
        page.execute_script(
            "const field = document.querySelector('#notes-list input');"
            "field.value = arguments[0]; field.dispatchEvent(new Event('input'))",
            text,
        )
        drawn(page)
        assert re.search(
            "\N{GRINNING FACE}\N{HORIZONTAL ELLIPSIS}$", overlay(page), re.M
        )
        press(page, "#save-picture")
        saved(folder, "hemisphere.png").unlink()


def test_a_picture_is_saved_as_it_is_seen(page, folder):
    choose(page, "left", "normals")
    press(page, "#save-picture")
    path = saved(folder, "hemisphere.png")
    picture = cv2.imread(str(path))[..., ::-1]
    shown = drawn(page)
    assert max(picture.shape) == 2000
    small = cv2.resize(picture, shown.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(small - shown).mean() < 1.5
    path.unlink()


@pytest.mark.parametrize("millimetres", [None, "18"])
def test_the_surface_is_saved_in_metres(page, folder, millimetres):
    trimesh = pytest.importorskip("trimesh")
    if millimetres:
        set_scale(page, millimetres)
    press(page, "#save-surface")
    path = saved(folder, "hemisphere.glb")
    (mesh,) = trimesh.load(path).geometry.values()
    size = mesh.bounds[1] - mesh.bounds[0]
    if millimetres:
        wide = 2 * 0.99 * known_results.RADIUS * 0.5e-3
        assert size[0] == pytest.approx(wide, rel=0.03)
    else:
        assert size.max() == pytest.approx(1)
    assert size[2] / size[0] == pytest.approx(0.86 / 1.98, rel=0.03)
    # The faces look towards the viewer, and so do the normals that are in it.
    assert (mesh.face_normals[:, 2] > 0).all()
    close = np.sum(mesh.vertex_normals * mesh.vertices, -1)
    assert (close > -mesh.scale).all() and len(mesh.vertices) > 3000
    assert mesh.visual.material.baseColorTexture is not None
    path.unlink()


def test_tiles_show_every_pixel(driver, folder):
    """Stripes of one pixel, which the page's own picture cannot have."""
    result = known_results.ripples(size=1500, length=2, slope=0.5)
    count = write_tiled_view(folder / "tiled", result)
    assert count == len(list((folder / "tiled" / "tiles").iterdir())) == 9
    driver.get((folder / "tiled" / "index.html").as_uri())
    opened(driver)
    choose(driver, "left", "normals")
    whole = drawn(driver)
    middle = whole[whole.shape[0] // 2, whole.shape[1] // 2 - 200 :][:400, 0]
    assert np.ptp(middle) < 60  # much of the stripes is lost
    for _ in range(16):
        element(driver, "stage").send_keys("+")
    for _ in range(50):
        row = drawn(driver)
        row = row[row.shape[0] // 2, :, 0]
        if np.ptp(row) > 100:
            break
        time.sleep(0.1)
    tilt = 0.5 / np.hypot(1, 0.5)
    expected = 127.5 + 127.5 * np.array([-tilt, tilt])
    np.testing.assert_allclose([row.min(), row.max()], expected, atol=4)
    # The same places as in the page: the stripes' edges lie where pixels' do.
    changes = np.diff(np.flatnonzero(np.diff(row > 127)))
    scale = 0.96 * 1.25**16 * whole.shape[0] / 1500
    assert np.mean(changes) == pytest.approx(scale, rel=0.03)
    assert messages(driver) == []


def test_the_surface_is_seen_from_in_front_only(page):
    choose(page, "left", "normals")
    press(page, "[data-mode=surface]")
    press(page, "#turning")
    for keys, axis in ((Keys.ARROW_LEFT, 0), (Keys.ARROW_UP, 1)):
        press(page, "#whole")
        element(page, "stage").send_keys(*[keys] * 40)  # 200 degrees
        picture = drawn(page)[9:-9, 9:-9]  # without the focus' line
        shown = (np.abs(picture - 18) > 8).any(-1)
        # At 60 degrees half of the width is left, and the depth comes in.
        where = np.flatnonzero(shown.any(0 if axis == 0 else 1))
        across = np.flatnonzero(shown.any(1 if axis == 0 else 0))
        share = np.ptp(where) / np.ptp(across)
        assert 0.6 < share < 0.85
        seen = picture[shown]
        # Normals are towards the viewer, none from behind; edges are blended.
        assert np.percentile(seen[:, 2], 3) > 120


def test_the_wheel_scrolls_the_page_around_until_a_click(driver, folder, page):
    around = folder / "around.html"
    around.write_text(
        "<!doctype html><body style='height: 3000px; margin: 0'>"
        "<iframe src='hemisphere.html' width=1000 height=700></iframe>"
    )
    driver.get(around.as_uri())
    frame = driver.find_element(By.TAG_NAME, "iframe")
    origin = ScrollOrigin.from_element(frame, -150, 0)

    def scrolled():
        ActionChains(driver).scroll_from_origin(origin, 0, 60).perform()
        time.sleep(0.3)
        return driver.execute_script("return scrollY")

    driver.switch_to.frame(frame)
    opened(driver)
    driver.switch_to.default_content()
    assert scrolled() > 0
    driver.execute_script("scrollTo(0, 0)")
    driver.switch_to.frame(frame)
    assert element(driver, "hint").is_displayed()
    before = drawn(driver)
    point(driver, 0, 0).click().perform()
    driver.switch_to.default_content()
    ActionChains(driver).scroll_from_origin(origin, 0, -200).perform()
    time.sleep(0.3)
    assert driver.execute_script("return scrollY") == 0
    driver.switch_to.frame(frame)
    ground = (np.abs(before - 18) < 3).all(-1).sum()
    assert (np.abs(drawn(driver) - 18) < 3).all(-1).sum() < ground
    assert not element(driver, "hint").is_displayed()
    driver.switch_to.default_content()
