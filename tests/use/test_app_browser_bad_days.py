"""The application in a browser on a bad day: nothing is lost, nothing goes astray."""

import json
import signal
import time

import numpy as np
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")
pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from app_page import (
    SIDE,
    Server,
    can_estimate,
    complaints,
    dark_share,
    fits,
    object_share,
    open_page,
    press,
    press_visible,
    reload_at_once,
    shown,
    text,
    until,
    upload,
    written,
)
from browser import ABSENT, browser
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from unips_jax.io.images import read_image, write_image

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")


@pytest.fixture
def photographs(tmp_path):
    return written(tmp_path, SIDE)


def test_a_reload_costs_nothing_and_results_are_run_again(stand_in, tmp_path):
    """On a phone, in German."""
    with browser(500, 850) as driver:
        metrics = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        open_page(driver, stand_in.address)
        Select(driver.find_element(By.ID, "language")).select_by_value("de")
        assert "So wird fotografiert" in text(driver, "home") and fits(driver)
        press(driver, "example")
        until(driver, lambda: can_estimate(driver))
        assert "8 Fotos mit 192 x 192 Pixeln" in text(driver) and fits(driver)
        press(driver, "mask-all")
        press_visible(driver, "#thumbnails .x")
        until(driver, lambda: "von dir weggelassen" in text(driver, "aside"))
        until(driver, lambda: can_estimate(driver))
        address = driver.current_url
        driver.refresh()
        until(driver, lambda: can_estimate(driver))
        assert "7 Fotos" in text(driver) and object_share(driver) == 1 and fits(driver)
        upload(driver, written(tmp_path, 192, (1,)))
        until(driver, lambda: "8 Fotos" in text(driver) and can_estimate(driver))
        assert object_share(driver) == 1  # the mask is kept
        press(driver, "estimate")
        until(driver, lambda: shown(driver, "running") or shown(driver, "done"))
        assert fits(driver)
        driver.get("about:blank")
        driver.get(address)
        until(driver, lambda: shown(driver, "done"))
        assert fits(driver) and "Ändern und neu berechnen" in text(driver)
        press_visible(driver, "#done-buttons [data-do=again]")
        until(driver, lambda: can_estimate(driver))
        assert driver.current_url != address and object_share(driver) == 1
        assert "8 Fotos" in text(driver)
        press_visible(driver, "#object p a")
        until(
            driver, lambda: len(driver.find_elements(By.CSS_SELECTOR, "#list li")) == 2
        )
        assert "fertig" in text(driver, "list") and fits(driver)
        assert complaints(driver) == []


STROKE = """
const canvas = document.getElementById("mask-canvas");
const box = canvas.getBoundingClientRect();
canvas.setPointerCapture = () => {};
for (const [kind, x] of [["down", 0.1], ["move", 0.9], ["up", 0.9]])
  canvas.dispatchEvent(new PointerEvent(`pointer${kind}`, {
    pointerId: 1, isPrimary: true, bubbles: true,
    clientX: box.left + x * box.width, clientY: box.top + 0.5 * box.height }))
"""


DROP = """
const file = new File(["no photograph"], "notes.txt");
const pages = [[{ isFile: true, file: (done) => done(file) }], []];
const reader = { readEntries: (done) => done(pages.shift()) };
const entry = { isDirectory: true, name: "vase", createReader: () => reader };
const dropped = new Event("drop", { bubbles: true, cancelable: true });
dropped.dataTransfer = { items: [{ webkitGetAsEntry: () => entry }] };
document.getElementById(arguments[0]).dispatchEvent(dropped)
"""


def test_a_dropped_folder_gives_the_object_its_name(stand_in):
    """Also after a draft was looked at and left, and into a draft."""
    folders = DROP.replace("isFile: true", "isDirectory: true")

    def name():
        return driver.find_element(By.ID, "name").get_property("value")

    with browser(1200, 1100) as driver:
        for _ in range(2):
            open_page(driver, stand_in.address)
            driver.execute_script("location.hash = ''")
            until(driver, lambda: shown(driver, "first-drop"))
            driver.execute_script(folders, "first-drop")
            until(driver, lambda: "no files in vase itself" in text(driver, "message"))
            ActionChains(driver).send_keys(Keys.ESCAPE).perform()
            driver.execute_script(DROP, "first-drop")
            until(driver, lambda: name() == "vase" and "notes" in text(driver, "aside"))
            driver.execute_script("location.hash = ''")
            until(driver, lambda: shown(driver, "first-drop"))
            press(driver, "example")
            until(driver, lambda: name() == "example")
        driver.execute_script(
            "const name = document.getElementById('name'); name.value = 'object';"
            "name.dispatchEvent(new Event('change'))"
        )
        driver.execute_script(DROP, "more-drop")
        until(driver, lambda: name() == "vase" and "notes" in text(driver, "aside"))
        assert complaints(driver, "notes.txt") == [] and not shown(driver, "message")


def test_what_was_drawn_just_before_a_reload_is_kept(stand_in, photographs):
    with browser(1200, 1100) as driver:
        open_page(driver, stand_in.address)
        upload(driver, photographs)
        until(driver, lambda: can_estimate(driver))
        reload_at_once(driver, "document.getElementById('mask-clear').click()")
        until(driver, lambda: "Show where the object" in text(driver, "missing"))
        assert object_share(driver) == 0
        press_visible(driver, "[data-mask-tool=add]")
        reload_at_once(driver, STROKE)
        until(driver, lambda: can_estimate(driver))
        assert 0.02 < object_share(driver) < 0.2  # a band across the picture
        before = object_share(driver)
        canvas = driver.find_element(By.ID, "mask-canvas")
        canvas.send_keys(Keys.DOWN * 5)
        canvas.send_keys(Keys.SHIFT, Keys.RIGHT)
        assert object_share(driver) > before
        canvas.send_keys("z")
        assert object_share(driver) == before
        assert complaints(driver) == []


@pytest.mark.slow
def test_a_minute_of_sleep_during_an_estimate(stand_in, tmp_path):
    with browser(1200, 1100) as driver:
        open_page(driver, stand_in.address)
        upload(driver, written(tmp_path, 320, range(8)))
        until(driver, lambda: can_estimate(driver))
        press(driver, "estimate")
        until(driver, lambda: shown(driver, "running"))
        driver.execute_cdp_cmd("Page.setWebLifecycleState", {"state": "frozen"})
        time.sleep(60)
        driver.execute_cdp_cmd("Page.setWebLifecycleState", {"state": "active"})
        until(driver, lambda: shown(driver, "done"))
        until(driver, lambda: driver.find_elements(By.TAG_NAME, "iframe"))


@pytest.mark.slow
def test_a_killed_server_loses_no_work(tmp_path, photographs):
    first = Server(tmp_path / "results")
    with browser(1200, 1100) as driver:
        open_page(driver, first.with_key)
        upload(driver, photographs)
        until(driver, lambda: can_estimate(driver))
        press(driver, "estimate")
        until(driver, lambda: shown(driver, "running"))
        first.end(signal.SIGKILL)
        until(driver, lambda: shown(driver, "connection"))
        second = Server(tmp_path / "results")
        try:
            open_page(driver, second.with_key)
            press_visible(driver, "#list a")
            until(driver, lambda: shown(driver, "ended"))
            assert "ended during this estimate" in text(driver)
            press_visible(driver, "#ended [data-do=again]")
            until(driver, lambda: can_estimate(driver))
        finally:
            second.end()


@pytest.mark.slow
def test_250_megabytes_in_one_choice(stand_in, tmp_path):
    import tifffile

    generator = np.random.default_rng(0)
    for index in range(8):
        noise = generator.integers(0, 65535, (2200, 2400, 3), np.uint16)
        tifffile.imwrite(tmp_path / f"{index}.tif", noise, photometric="rgb")
    assert sum(p.stat().st_size for p in tmp_path.glob("*.tif")) > 250e6
    with browser(1200, 1100) as driver:
        open_page(driver, stand_in.address)
        upload(driver, sorted(tmp_path.glob("*.tif")))
        until(driver, lambda: "8 photographs of 2400 x 2200 pixels" in text(driver))
        assert text(driver, "aside") == ""


def written_tall(folder):
    """Photographs of 9 x 16, with an object in the middle."""
    paths = []
    for index in range(3):
        image = np.full((640, 360, 3), 10, np.uint8)
        image[200:440, 90:270] = 120 + 40 * index
        paths.append(folder / f"tall_{index}.png")
        write_image(paths[-1], image)
    return paths


def test_the_brush_paints_where_the_pointer_is(stand_in, tmp_path):
    """Also where the picture is narrower than its place; one finger paints, not two."""
    with browser(1366, 780) as driver:
        open_page(driver, stand_in.address)
        upload(driver, written_tall(tmp_path))
        until(driver, lambda: can_estimate(driver))
        press(driver, "mask-clear")
        press_visible(driver, "[data-mask-tool=add]")
        driver.execute_script("document.getElementById('mask-brush').value = 2")
        canvas = driver.find_element(By.ID, "mask-canvas")
        dark_share(driver)  # scrolls there
        box = canvas.rect
        shown_width = min(box["width"], box["height"] * 9 / 16)
        assert shown_width < 0.9 * box["width"]
        aim = ActionChains(driver)
        aim.move_to_element_with_offset(canvas, round(-0.4 * shown_width), 0)
        aim.click().perform()
        key = driver.current_url.partition("#")[2]
        drawn = stand_in.results / ".app" / key / "drawn.png"

        def painted():
            mask = read_image(drawn)[..., 0] if drawn.exists() else np.zeros((1, 1))
            return mask.any(axis=0).nonzero()[0] / mask.shape[1]

        until(driver, lambda: painted().size)
        assert painted().mean() == pytest.approx(0.1, abs=0.01)
        before = object_share(driver)
        driver.execute_script(STROKE.replace("isPrimary: true", "isPrimary: false"))
        assert object_share(driver) == before


SLOW = """
const [which, decode] = [arguments[0], HTMLImageElement.prototype.decode];
HTMLImageElement.prototype.decode = async function () {
  if (this.src.includes(which)) await new Promise((done) => setTimeout(done, 3000));
  return decode.call(this);
}"""


@pytest.mark.parametrize("slow", ["picture.jpg", "mask.png"])
def test_what_is_drawn_while_pictures_load_is_shown(stand_in, tmp_path, slow):
    paths = written(tmp_path, SIDE)
    with browser(1200, 1100) as driver:
        open_page(driver, stand_in.address)
        upload(driver, paths[:-1])
        until(driver, lambda: can_estimate(driver))
        before = object_share(driver)
        driver.execute_script(SLOW, slow)
        upload(driver, paths[-1:])
        asked = f"return performance.getEntriesByType('resource').some((e) => /{slow}/"
        driver.execute_script("performance.clearResourceTimings()")
        until(driver, lambda: driver.execute_script(f"{asked}.test(e.name))"))
        press_visible(driver, "[data-mask-tool=erase]")
        driver.execute_script(STROKE)
        drawn = object_share(driver)
        assert drawn < before - 0.02
        time.sleep(4)  # the server has it, and the picture is there
        until(driver, lambda: can_estimate(driver))
        assert object_share(driver) == drawn


def test_a_mask_that_another_tab_changed_is_shown(stand_in, tmp_path):
    with browser(1200, 1100) as driver:
        open_page(driver, stand_in.address)
        upload(driver, written(tmp_path, SIDE))
        until(driver, lambda: can_estimate(driver))
        found = object_share(driver)
        address, first = driver.current_url, driver.current_window_handle
        driver.switch_to.new_window("tab")
        driver.get(address)
        until(driver, lambda: can_estimate(driver))
        assert object_share(driver) == found < 0.9
        press(driver, "mask-all")
        second = driver.current_window_handle
        driver.switch_to.window(first)
        until(driver, lambda: object_share(driver) == 1)
        press_visible(driver, "[data-mask-tool=erase]")
        driver.execute_script(STROKE)
        drawn = object_share(driver)
        assert 0.5 < drawn < 1
        driver.switch_to.window(second)
        until(driver, lambda: abs(object_share(driver) - drawn) < 0.01)


def test_a_slow_picture_of_another_object_comes_too_late(stand_in, tmp_path):
    def mask_of(key):
        file = stand_in.results / ".app" / key / "object.json"
        return json.loads(file.read_text())["mask"]

    with browser(1200, 1100) as driver:
        addresses = []
        for index in range(2):
            open_page(driver, stand_in.address)
            driver.execute_script("location.hash = ''")
            until(driver, lambda: shown(driver, "first-drop"))
            folder = tmp_path / str(index)
            folder.mkdir()
            upload(driver, written(folder, SIDE))
            until(driver, lambda: can_estimate(driver))
            addresses.append(driver.current_url.partition("#")[2])
        driver.execute_script("location.hash = ''")
        until(driver, lambda: shown(driver, "first-drop"))
        driver.execute_script(SLOW, addresses[0])
        driver.execute_script(f"location.hash = '{addresses[0]}'")
        until(driver, lambda: shown(driver, "object"))
        time.sleep(1)
        driver.execute_script(f"location.hash = '{addresses[1]}'")
        until(driver, lambda: can_estimate(driver))
        time.sleep(4)
        press(driver, "mask-all")
        until(driver, lambda: "whole" in map(mask_of, addresses))
        assert [mask_of(key) for key in addresses] == ["auto", "whole"]
