"""A running application and its page in a browser; waits are for what is seen."""

import contextlib
import io
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
from browser import messages
from PIL import Image
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait
from small_networks import SHALLOW_OURS, lively_network

from unips_jax.io.images import read_image, write_image
from unips_jax.weights import save_weights

SAMPLE = Path(__file__).parents[1] / "unips_jax/assets/sample/obj000.data"
SCREENSHOTS = os.environ.get("UNIPS_SCREENSHOTS")
SIDE = 40
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


def reload_at_once(driver, before):
    """Runs JavaScript and leaves the page in the same moment; waits for the next."""
    driver.execute_script(f"window.old = true; {before}; location.reload()")
    until(driver, lambda: driver.execute_script("return window.old !== true"))
    ready = "return document.body?.dataset.ready"
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
    time.sleep(1)
    driver.execute_script("window.scrollTo(0, 0)")
    drawn(driver)
    data = io.BytesIO(driver.get_screenshot_as_png())
    with Image.open(data) as image:
        small = image.convert("RGB").resize((900, 900 * image.height // image.width))
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


@contextlib.contextmanager
def running(results, *options):
    there = Server(results, *options)
    yield there
    there.end()
    assert list(results.glob(".unips-*")) == []  # nothing half made is left


@contextlib.contextmanager
def running_stand_in(place):
    """With a network that compiles in seconds; its normals mean nothing."""
    save_weights(place / "small.safetensors", lively_network(SHALLOW_OURS))
    options = "--weights", str(place / "small.safetensors")
    with running(place / "results", *options) as there:
        yield there
