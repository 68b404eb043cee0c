"""The viewer's page in a browser: what a person sees and does."""

import re

import known_results
import numpy as np
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")

from browser import ABSENT, browser, messages
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait
from viewer_page import (
    choose,
    drawn,
    element,
    opened,
    point,
    press,
    sample,
    slide,
    value,
)

from unips_jax.viewer.page import page as page_of
from unips_jax.viewer.page import write_view

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "view.html"
    write_view(path, known_results.result())
    return path.as_uri()


@pytest.fixture(scope="module")
def driver():
    with browser() as driver:
        yield driver


@pytest.fixture
def page(driver, address):
    driver.get(address)
    opened(driver)
    yield driver
    assert messages(driver) == []


def test_it_opens_from_disk_and_asks_for_nothing(page):
    asked = page.execute_script(
        "return performance.getEntriesByType('resource').map((e) => e.name)"
    )
    assert all(name.startswith("data:") for name in asked)
    assert page.title == "hemisphere · unips_jax"


@pytest.mark.parametrize("x, y", [(0.9, 0), (-0.9, 0), (0, 0.9), (0, -0.9)])
def test_the_light_follows_the_pointer(page, x, y):
    press(page, "#colored")  # plain white
    point(page, x, y).perform()
    picture = drawn(page)
    towards, away = sample(page, picture, x / 2, y / 2), sample(page, picture, -x, -y)
    assert towards.mean() > 180 and away.mean() < 70
    angle = np.rad2deg(np.arctan2(y, x))
    assert abs((value(page, "azimuth") - angle + 180) % 360 - 180) < 3
    # A Lambertian sphere: (0.04 + 0.96 n . l) of an albedo of 0.75, as sRGB.
    slide(page, "gloss", 0)
    normal = np.array([x / 2, y / 2, (1 - (x / 2) ** 2 - (y / 2) ** 2) ** 0.5])
    a, e = np.deg2rad([value(page, "azimuth"), value(page, "elevation")])
    light = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    linear = 0.75 * (0.04 + 0.96 * normal @ light)
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    found = sample(page, drawn(page), x / 2, y / 2)
    np.testing.assert_allclose(found, expected, atol=6)


def test_a_line_divides_two_layers(page):
    choose(page, "left", "normals")
    choose(page, "right", "photograph-0")
    picture = drawn(page)
    for x in (-0.5, -0.2):
        color = 127.5 + 127.5 * np.array([x, 0, np.sqrt(1 - x**2)])
        np.testing.assert_allclose(sample(page, picture, x, 0), color, atol=4)
    red, green, blue = sample(page, picture, 0.6, 0)
    assert red > green > blue and red > 200  # the photograph's own colours
    slider = element(page, "split")
    slider.send_keys(Keys.END)
    color = 127.5 + 127.5 * np.array([0.6, 0, 0.8])
    np.testing.assert_allclose(sample(page, drawn(page), 0.6, 0), color, atol=4)
    slider.send_keys(Keys.HOME)
    dark = sample(page, drawn(page), -0.7, 0)
    assert dark.max() < 10  # of a light from the right
    # The line itself can be dragged, too.
    width = element(page, "stage").size["width"]
    slider.send_keys(Keys.END, *[Keys.ARROW_LEFT] * 20)
    line = element(page, "divider")
    ActionChains(page).drag_and_drop_by_offset(line, -width // 2, 0).perform()
    assert 450 < value(page, "split") < 510


def test_the_surface_turns(page):
    choose(page, "left", "normals")
    press(page, "[data-mode=surface]")
    button = element(page, "turning")
    assert button.get_attribute("aria-pressed") == "true"
    button.click()
    press(page, "#whole")
    front = drawn(page)
    size = min(front.shape[:2])
    middle = front[front.shape[0] // 2, front.shape[1] // 2]
    np.testing.assert_allclose(middle, [127, 127, 255], atol=6)
    there = (np.abs(front - 18) > 8).any(-1)
    assert there.sum() > 0.3 * size**2
    # By keys: the right side comes to the front, colours stay with the surface.
    element(page, "stage").send_keys(*[Keys.ARROW_LEFT] * 6)
    turned = drawn(page)
    middle = turned[front.shape[0] // 2, front.shape[1] // 2]
    np.testing.assert_allclose(middle[0], 156, atol=8)  # x = 0.23 there
    # Lit from the right, it is bright on the right, also when turned.
    choose(page, "left", "lit")
    press(page, "#colored")
    stage = element(page, "stage")
    ActionChains(page).move_to_element_with_offset(stage, 150, 0).perform()
    lit = drawn(page)
    row = lit[lit.shape[0] // 2, :, 1]
    shown = np.flatnonzero(np.abs(row - 18) > 8)
    half = (shown[0] + shown[-1]) // 2
    assert row[half : shown[-1]].mean() > row[shown[0] : half].mean() + 40
    # Dragging turns.
    before = drawn(page)
    ActionChains(page).click_and_hold(stage).move_by_offset(60, 20).release().perform()
    assert np.abs(drawn(page) - before).max() > 50


def measured(page):
    text = element(page, "reading").text
    return [float(x) for x in re.findall(r"-?\d+(?:\.\d+)?", text)], text


def test_an_angle_is_measured(page):
    press(page, "[data-tool=angle]")
    point(page, 0.5, 0).click().perform()
    point(page, -0.5, 0).click().perform()
    numbers, text = measured(page)
    assert text.startswith("Angle between the normals")
    assert numbers[2] == pytest.approx(60, abs=2)
    point(page, 0.9, 0.9).click().perform()
    assert element(page, "reading").text == "There is no surface at this point."


def test_a_profile_is_measured_by_keys_alone(page):
    press(page, "[data-tool=profile]")
    stage = element(page, "stage")
    stage.send_keys(Keys.ARROW_RIGHT, Keys.ENTER)
    for _ in range(3):
        stage.send_keys(Keys.SHIFT + Keys.ARROW_RIGHT)
    stage.send_keys(Keys.ENTER)
    numbers, text = measured(page)
    assert text.startswith("Profile of 30 pixels")
    fall = known_results.RADIUS - np.sqrt(known_results.RADIUS**2 - 31**2)
    assert numbers[1] == pytest.approx(-fall, rel=0.1)
    chart = element(page, "chart")
    assert chart.is_displayed() and "Height along the line" in chart.accessible_name
    stage.send_keys(Keys.ESCAPE)
    assert not chart.is_displayed()


def test_keys_move_the_light_and_zoom(page):
    stage = element(page, "stage")
    before = drawn(page)
    stage.send_keys(*[Keys.ARROW_LEFT] * 20)
    assert abs(value(page, "azimuth")) > 90
    assert "left" in element(page, "azimuth").get_attribute("aria-valuetext")
    stage.send_keys("+", "+")
    assert np.abs(drawn(page) - before).max() > 50
    background = (np.abs(before - 18) < 3).all(-1).sum()
    assert (np.abs(drawn(page) - 18) < 3).all(-1).sum() < background
    stage.send_keys("0")
    assert (np.abs(drawn(page) - 18) < 3).all(-1).sum() == pytest.approx(
        background, rel=0.05
    )


def test_a_magnified_picture_is_moved_by_keys(page):
    stage = element(page, "stage")
    stage.send_keys("+" * 8)
    before = drawn(page)[20:-20, 60:-20]
    stage.send_keys(Keys.SHIFT + Keys.ARROW_RIGHT)
    np.testing.assert_allclose(drawn(page)[20:-20, 20:-60], before, atol=3)
    # The cross of a tool stays in sight.
    press(page, "[data-tool=note]")
    stage.send_keys(*[Keys.SHIFT + Keys.ARROW_RIGHT] * 3, Keys.ENTER)
    drawn(page)
    pin = page.find_element(By.CSS_SELECTOR, "#overlay path").rect
    box = stage.rect
    assert box["x"] < pin["x"] < box["x"] + box["width"]
    # Where a note is removed, the focus is not lost.
    press(page, "#notes-list li button:last-child")
    assert page.switch_to.active_element.get_attribute("id") == "add-view"


def test_fingers_move_the_light_and_zoom(page):
    box = element(page, "stage").rect
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def touch(kind, *places):
        points = [{"x": x + a, "y": y + b, "id": i} for i, (a, b) in enumerate(places)]
        given = {"type": kind, "touchPoints": points}
        page.execute_cdp_cmd("Input.dispatchTouchEvent", given)

    touch("touchStart", (0, 0))
    touch("touchMove", (-100, 0))
    touch("touchEnd")
    assert abs(value(page, "azimuth")) > 175 and value(page, "elevation") < 75
    before = drawn(page)
    touch("touchStart", (-30, 0), (30, 0))
    touch("touchMove", (-60, 0), (60, 0))
    touch("touchMove", (-90, 0), (90, 0))
    touch("touchEnd")
    after = drawn(page)
    assert (np.abs(after - 18) < 3).all(-1).sum() < (np.abs(before - 18) < 3).all(
        -1
    ).sum()


def test_all_controls_have_names_in_both_languages(page):
    choose(page, "right", "depth")
    assert element(page, "legend").is_displayed()
    for language, title in (("en", "3D surface"), ("de", "3D-Fläche")):
        choose(page, "language", language)
        assert page.execute_script("return document.documentElement.lang") == language
        assert page.find_element(By.CSS_SELECTOR, "[data-mode=surface]").text == title
        nodes = page.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
        roles = {"button", "combobox", "slider", "checkbox", "application"}
        controls = [n for n in nodes if n["role"]["value"] in roles]
        assert len(controls) > 12
        for node in controls:
            assert node["name"]["value"].strip(), node


def test_it_fits_a_telephone(page):
    press(page, "#add-view")
    metrics = {"width": 320, "height": 568, "deviceScaleFactor": 1, "mobile": True}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        width = "return document.documentElement.scrollWidth - innerWidth"
        assert page.execute_script(width) <= 0
        settings = element(page, "settings")
        assert settings.get_property("scrollWidth") <= settings.size["width"]
        assert element(page, "stage").size["height"] > 300
    finally:
        page.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_without_webgl_the_normals_are_shown(address):
    with browser(arguments=["--disable-3d-apis"]) as driver:
        driver.get(f"{address}#de")
        failure = driver.find_element(By.ID, "failure")
        WebDriverWait(driver, 300).until(lambda _: failure.is_displayed())
        assert "WebGL 2" in failure.text
        assert driver.find_element(By.CSS_SELECTOR, "#stage img").is_displayed()
        controls = driver.find_elements(By.CSS_SELECTOR, "button, select, input")
        assert not any(control.is_displayed() for control in controls)
        assert driver.find_element(By.TAG_NAME, "summary").text.startswith("Über")


@pytest.mark.parametrize("broken", [2, 3], ids=["three.js", "ours"])
def test_a_browser_that_cannot_read_a_script_says_so(driver, tmp_path, broken):
    """As those of 2021, to which parts of them are no JavaScript."""
    parts = page_of(known_results.result()).split("<script>\n")
    assert len(parts) == 4  # what is before, plain words, and these
    parts[broken] = "class {{ " + parts[broken]
    path = tmp_path / "old.html"
    path.write_text("<script>\n".join(parts), "utf-8")
    driver.get(path.as_uri())
    failure = driver.find_element(By.ID, "failure")
    WebDriverWait(driver, 300).until(lambda _: failure.is_displayed())
    assert driver.find_element(By.CSS_SELECTOR, "#stage img").is_displayed()
    assert "SyntaxError" in messages(driver)[0]


@pytest.mark.parametrize(("kept", "stays"), [(120, True), (90, False), (None, True)])
def test_a_kept_scale_is_that_of_its_camera(driver, tmp_path, kept, stays):
    """One without a focal length is of an earlier version's page."""
    depth = known_results.hemisphere()[1] + 400
    seen = {"depth": depth, "unit": "mean distances", "focal": 120.0}
    scale = {"mm": 2.0, "unit": "mean distances"}
    notes = {"scale": scale if kept is None else {**scale, "focal": kept}}
    path = tmp_path / "a.html"
    path.write_text(page_of(known_results.result(**seen), notes=notes))
    driver.get(path.as_uri())
    opened(driver)
    drawn(driver)
    assert bool(driver.find_elements(By.ID, "scale-bar")) == stays
    assert messages(driver) == []


@pytest.mark.parametrize(
    ("kept", "scale", "same"),
    [(None, 1.0, True), ("48 x 48", 2.0, True), ("48 x 40", 2.0, False)],
)
def test_what_was_kept_goes_with_the_size(driver, tmp_path, kept, scale, same):
    """Of half the size a pixel is twice as long; of another shape it is not known."""

    def shown(mm, places, **size):
        notes = [{"place": place, "text": "a dent"} for place in places]
        view = {"name": "a view", "state": {"mode": "picture", "center": places[0]}}
        known = {"mm": mm, "unit": "pixels", "focal": None}
        notes = {**size, "scale": known, "notes": notes, "views": [view]}
        path = tmp_path / "a.html"
        path.write_text(page_of(known_results.result(), notes=notes))
        driver.get(path.as_uri())
        opened(driver)
        drawn(driver)
        assert messages(driver) == []
        text = element(driver, "other-shape").text
        return element(driver, "overlay").get_attribute("innerHTML"), text

    expected, said = shown(1.0, [[60, 24]], size="96 x 96")
    assert "scale-bar" in expected and said == ""
    across, down = map(int, (kept or "96 x 96").split(" x "))
    place = [60 * across / 96, 24 * down / 96]
    found, said = shown(scale, [place], **({"size": kept} if kept else {}))
    assert (found == expected and said == "") == same
    if not same:  # notes stay in the picture
        assert "a dent" in found and "scale-bar" not in found
        assert said.startswith("What was kept is of a result of 48 x 40 pixels")


def test_a_profile_begins_and_ends_on_the_depth(driver, tmp_path):
    """At its rim a surface may have normals without a depth."""
    normals, depth = known_results.hemisphere()
    depth[:, known_results.SIZE // 2 + known_results.RADIUS // 2 :] = np.nan
    path = tmp_path / "a.html"
    path.write_text(page_of(known_results.result(depth=depth)))
    driver.get(path.as_uri())
    opened(driver)
    press(driver, "[data-tool=profile]")
    point(driver, 0, 0).click().perform()
    point(driver, 0.7, 0).click().perform()
    assert element(driver, "reading").text == "There is no surface at this point."
    point(driver, 0.3, 0).click().perform()
    numbers, text = measured(driver)
    assert "NaN" not in text
    assert numbers[0] == pytest.approx(0.3 * known_results.RADIUS, abs=1)
    assert messages(driver) == []


def test_both_sides_are_lit(driver, tmp_path):
    """A bowl: turned by 35 degrees, its near wall is seen from behind."""
    normals, depth = known_results.hemisphere()
    bowl = known_results.result(normals=normals * [-1, -1, 1], depth=-depth)
    write_view(tmp_path / "bowl.html", bowl)
    driver.get((tmp_path / "bowl.html").as_uri())
    opened(driver)
    press(driver, "[data-mode=surface]")
    press(driver, "#turning")
    press(driver, "#whole")
    press(driver, "#colored")
    slide(driver, "gloss", 0)
    element(driver, "stage").send_keys(*[Keys.ARROW_DOWN] * 20)
    slide(driver, "azimuth", -90)
    slide(driver, "elevation", 60)
    picture = drawn(driver)[9:-9, 9:-9, 1]
    column = picture[:, picture.shape[1] // 2]
    last = np.flatnonzero(np.abs(column - 18) > 8)[-1]
    rim, inner = column[last - 4 : last - 1], column[last - 40 : last - 30]
    assert rim.min() > 90 and inner.max() < 60  # lit from below, as its back is
    assert messages(driver) == []
