"""Headless Chromium for tests, driven through its own driver."""

import contextlib
import io
import os
import shutil

import numpy as np
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

_NAMES = ("google-chrome", "chromium", "chromium-browser")
CHROMIUM = next(filter(None, map(shutil.which, _NAMES)), None)
DRIVER = shutil.which("chromedriver")
# The CI installs both: there a test that cannot run fails.
ABSENT = (CHROMIUM is None or DRIVER is None) and "CI" not in os.environ


@contextlib.contextmanager
def browser(width=1200, height=800, *, arguments=(), preferences=None):
    """A browser that draws WebGL on the processor."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-background-networking",
        "--disable-component-update",
        "--no-first-run",
        "--force-device-scale-factor=1",
        "--lang=en-US",
        f"--window-size={width},{height}",
        "--hide-scrollbars",
        *arguments,
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    options.add_experimental_option("prefs", preferences or {})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    try:
        yield driver
    finally:
        driver.quit()


def messages(driver):
    """What the page said in the console since the last call."""
    return [entry["message"] for entry in driver.get_log("browser")]


def pixels(element):
    """An element as it is on the screen: `[H, W, 3]`, uint8."""
    with Image.open(io.BytesIO(element.screenshot_as_png)) as image:
        return np.asarray(image.convert("RGB"))
