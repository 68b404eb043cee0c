"""The application in a browser: from photographs to a lit surface, and nothing lost.

`UNIPS_SCREENSHOTS=docs pytest tests/use/test_app_browser.py` also writes the pictures
of `docs/app.md`, from the sample that ships.
"""

import io
import json
import os
import select
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")
pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from browser import ABSENT, browser, messages, pixels
from PIL import Image
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import Select, WebDriverWait
from small_networks import SMALL_OURS, lively_network

from unips_jax.io.images import read_image, write_image
from unips_jax.weights import save_weights

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")

SAMPLE = Path(__file__).parents[2] / "unips_jax/assets/sample/obj000.data"
SCREENSHOTS = os.environ.get("UNIPS_SCREENSHOTS")
SIDE = 192 if SCREENSHOTS else 40
PATIENCE_S = 500  # several processes may share two cores


class Server:
    """A running application."""

    def __init__(self, results, *options):
        self.results = results
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "unips_jax",
                "app",
                "--no-show",
                "--results",
                str(results),
                *options,
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        ready, _, _ = select.select([self.process.stdout], [], [], PATIENCE_S)
        assert ready, "the server does not start"
        self.with_key = self.process.stdout.readline().split()[0]
        self.address = self.with_key.partition("/?")[0]

    def end(self, how=signal.SIGTERM):
        self.process.send_signal(how)
        self.process.wait(60)
        self.process.stdout.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """With the weights that ship."""
    there = Server(tmp_path_factory.mktemp("results"))
    yield there
    there.end()
    assert list(there.results.glob(".unips-*")) == []  # nothing half made is left


@pytest.fixture(scope="module")
def stand_in(tmp_path_factory):
    """With a network that compiles in seconds; its normals mean nothing."""
    place = tmp_path_factory.mktemp("stand-in")
    save_weights(place / "small.safetensors", lively_network(SMALL_OURS))
    there = Server(place / "results", "--weights", str(place / "small.safetensors"))
    yield there
    there.end()


@pytest.fixture
def photographs(tmp_path):
    return written(tmp_path, SIDE)


def written(folder, side, indices=(0, 2, 4, 6)):
    paths = []
    for index in indices:
        image = read_image(SAMPLE / f"L_0{index}.png")
        small = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
        paths.append(folder / f"photo_{index}.png")
        write_image(paths[-1], small)
    return paths


def until(driver, true):
    return WebDriverWait(driver, PATIENCE_S, 0.2).until(lambda _: true())


def open_page(driver, address):
    driver.get(address)
    ready = "return document.body.dataset.ready"
    until(driver, lambda: driver.execute_script(ready) == "true")


def shown(driver, name):
    return driver.find_element(By.ID, name).is_displayed()


def text(driver, name="object"):
    return driver.find_element(By.ID, name).text


def upload(driver, paths):
    names = ("more-drop", "first-drop")
    place = next(name for name in names if shown(driver, name))
    chooser = driver.find_element(By.CSS_SELECTOR, f"#{place} input[type=file]")
    chooser.send_keys("\n".join(map(str, paths)))


def press(driver, name):
    button = driver.find_element(By.ID, name)
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
    button.click()


def press_visible(driver, selector):
    found = driver.find_elements(By.CSS_SELECTOR, selector)
    button = next(b for b in found if b.is_displayed())
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
    button.click()


def can_estimate(driver):
    button = driver.find_element(By.ID, "estimate")
    return button.is_displayed() and button.is_enabled()


def fits(driver):
    """Whether nothing is wider than the screen."""
    return driver.execute_script(
        "return document.scrollingElement.scrollWidth <= innerWidth"
    )


def screenshot(driver, name):
    if SCREENSHOTS:
        time.sleep(1)
        data = io.BytesIO(driver.get_screenshot_as_png())
        with Image.open(data) as image:
            small = image.convert("RGB").resize(
                (900, 900 * image.height // image.width)
            )
            small.save(Path(SCREENSHOTS) / name, quality=85)


def complaints(driver, *expected):
    """What the page said in the console, less that we read its picture."""
    known = ("willReadFrequently", *expected)
    return [m for m in messages(driver) if not any(text in m for text in known)]


def drawn(driver):
    """Waits until what has changed is on the screen."""
    wait = "requestAnimationFrame(() => requestAnimationFrame(arguments[0]))"
    driver.execute_async_script(wait)


def object_share(driver):
    """Share of the picture that the mask takes."""
    editor = driver.find_element(By.ID, "mask-editor")
    return float(editor.get_attribute("data-share"))


def dark_share(driver):
    """Share of the mask's picture that is veiled."""
    canvas = driver.find_element(By.ID, "mask-canvas")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    drawn(driver)
    return driver.execute_script(
        """const [canvas] = arguments, {width, height} = canvas;
        const {data} = canvas.getContext("2d").getImageData(0, 0, width, height);
        let dark = 0;
        for (let at = 0; at < data.length; at += 4)
            dark += Math.max(data[at], data[at + 1], data[at + 2]) < 110;
        return dark / (width * height);""",
        canvas,
    )


def test_from_photographs_to_a_lit_surface(server, photographs, tmp_path):
    note = tmp_path / "notes.txt"
    note.write_text("no photograph")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"0" * 100)
    with browser(1200, 1100) as driver:
        open_page(driver, server.with_key)
        assert "key=" not in driver.current_url
        upload(driver, [*photographs, note, tmp_path / "broken.png"])
        until(driver, lambda: can_estimate(driver))
        assert f"4 photographs of {SIDE} x {SIDE} pixels" in text(driver)
        aside = text(driver, "aside")
        assert "notes.txt: not an image" in aside
        assert "broken.png: damaged" in aside and "/tmp" not in text(driver)
        assert "The object was found by itself" in text(driver)
        thumbnails = driver.find_elements(By.CSS_SELECTOR, "#thumbnails li span")
        assert [t.text for t in thumbnails] == [p.name for p in photographs]
        suggested = dark_share(driver)
        assert 0.2 < suggested < 0.7
        screenshot(driver, "app-photographs.jpg")
        edit_the_mask(driver, suggested)
        press(driver, "estimate")
        until(driver, lambda: shown(driver, "done"))
        check_downloads(driver, server)
        check_viewer(driver)
        screenshot(driver, "app-result.jpg")
        assert complaints(driver, "415") == []


def edit_the_mask(driver, suggested):
    canvas = driver.find_element(By.ID, "mask-canvas")
    press_visible(driver, "[data-mask-tool=erase]")
    ActionChains(driver).click_and_hold(canvas).move_by_offset(
        100, 0
    ).release().perform()
    painted = dark_share(driver)
    assert painted > suggested + 0.005
    press(driver, "mask-undo")
    assert dark_share(driver) == pytest.approx(suggested, abs=1e-3)
    press(driver, "mask-clear")
    assert not can_estimate(driver)
    assert "Show where the object is first" in text(driver)
    press_visible(driver, "[data-mask-tool=box]")
    dark_share(driver)  # scrolls there
    inset = canvas.size["width"] // 20
    width, height = (canvas.size[side] - 2 * inset for side in ("width", "height"))
    ActionChains(driver).move_to_element_with_offset(
        canvas, -width // 2, -height // 2
    ).click_and_hold().move_by_offset(width, height).release().perform()
    until(driver, lambda: "as found in the box" in text(driver, "mask-status"))
    assert dark_share(driver) == pytest.approx(suggested, abs=0.12)
    assert can_estimate(driver)


def check_downloads(driver, server):
    links = {
        link.text: link.get_attribute("href")
        for link in driver.find_elements(By.CSS_SELECTOR, "#done a")
    }
    with urllib.request.urlopen(links["Save everything (zip)"]) as answer:
        packed = zipfile.ZipFile(io.BytesIO(answer.read()))
    names = {Path(name).name for name in packed.namelist()}
    assert names >= {"normals.png", "depth.exr", "mesh.glb", "view.html"}
    with urllib.request.urlopen(links["normals.json"]) as answer:
        record = json.load(answer)
    assert len(record["images"]) == 4 and record["mask_pixels"] > 0.2 * SIDE**2
    folder = next(f for f in server.results.iterdir() if f.name.startswith("object-"))
    assert str(folder) in text(driver, "folder")
    normals = np.load(folder / "normals.npy")
    # The left faces left, the right right.
    columns = normals[..., 0].sum(0)
    assert columns[: SIDE // 3].sum() < 0 < columns[-SIDE // 3 :].sum()


def check_viewer(driver):
    frame = driver.find_element(By.TAG_NAME, "iframe")
    driver.execute_script("arguments[0].scrollIntoView()", frame)
    driver.switch_to.frame(frame)
    ready = "return document.body.dataset.ready"
    until(driver, lambda: driver.execute_script(ready) == "true")
    stage = driver.find_element(By.ID, "stage")

    def light_follows_the_pointer():
        lit = []
        for side in (-200, 200):
            ActionChains(driver).move_to_element_with_offset(stage, side, 0).perform()
            drawn(driver)
            lit.append(pixels(stage).mean(-1))
        width = lit[0].shape[1]
        change = lit[1] - lit[0]  # light from the right less light from the left
        left, right = change[:, : width // 6], change[:, -width // 6 :]
        return left.mean() < -2 < 2 < right.mean()

    until(driver, light_follows_the_pointer)  # a busy machine draws late
    driver.switch_to.default_content()


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
        time.sleep(1.5)  # it is sent half a second later; until then leaving warns
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
        time.sleep(1)
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


@pytest.mark.slow
def test_an_estimate_is_cancelled_and_changed(server, photographs):
    with browser(1200, 1100) as driver:
        open_page(driver, server.address)
        upload(driver, photographs)
        until(driver, lambda: can_estimate(driver))
        press(driver, "estimate")
        until(driver, lambda: shown(driver, "running"))
        press(driver, "cancel")
        until(driver, lambda: shown(driver, "ended"))
        assert "cancelled" in text(driver)
        press_visible(driver, "#ended [data-do=again]")
        until(driver, lambda: can_estimate(driver))
        assert "4 photographs" in text(driver)


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


def test_other_sites_cannot_reach_it(stand_in):
    for headers in (
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"},
    ):
        request = urllib.request.Request(stand_in.address, headers=headers)
        with pytest.raises(urllib.error.HTTPError, match="40[03]"):
            urllib.request.urlopen(request)
