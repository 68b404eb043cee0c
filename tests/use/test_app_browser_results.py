"""Results in the application: looked at, left and found again, saved."""

import time
import urllib.request

import known_results
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")
pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from app_page import open_page, press, press_visible, running, shown, until
from browser import ABSENT, browser
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By

from unips_jax.app.objects import opened
from unips_jax.viewer.page import write_view

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")


def finished(results, name):
    """An object with a result, as an estimate leaves it."""
    folder = results / f"{name}-2026-01-01"
    known_results.write_folder(folder, results / f"{name}-photographs")
    write_view(folder / "view.html", known_results.result(title=name))
    with opened(results, days=30) as objects:
        item = objects.begin(name)
        item.state, item.target, item.asked = "done", str(folder), time.time()
        item.save()
    return item.id


def write_note(driver):
    driver.switch_to.frame("viewer")
    ready = "return document.body?.dataset.ready"
    until(driver, lambda: driver.execute_script(ready) == "true")
    driver.find_element(By.CSS_SELECTOR, "[data-tool=note]").click()
    stage = driver.find_element(By.ID, "stage")
    ActionChains(driver).move_to_element(stage).click().perform()
    driver.switch_to.default_content()


def test_saving_everything_leaves_the_page(tmp_path):
    """Whether it can be packed or not, with notes that are not saved."""
    results, saved = tmp_path / "results", tmp_path / "saved"
    results.mkdir()
    saved.mkdir()
    key = finished(results, "cat")
    folder, away = results / "cat-2026-01-01", results / "away"
    into = {"download.default_directory": str(saved)}
    with running(results) as server, browser(1200, 1000, preferences=into) as driver:
        open_page(driver, f"{server.address}#{key}")
        until(driver, lambda: shown(driver, "done"))
        write_note(driver)
        press(driver, "zip")
        until(
            driver, lambda: [f.name for f in saved.iterdir()] == ["cat-2026-01-01.zip"]
        )
        folder.rename(away)
        press(driver, "zip")
        time.sleep(1)
        assert driver.find_element(By.ID, "object-name").text == "cat"
        away.rename(folder)


def test_a_result_is_left_and_found_again(tmp_path):
    """Notes are still there, and "back" leads where one was."""
    results = tmp_path / "results"
    results.mkdir()
    keys = [finished(results, name) for name in ("cat", "dog")]

    def notes():
        driver.switch_to.frame("viewer")
        count = len(driver.find_elements(By.CSS_SELECTOR, "#notes-list li"))
        driver.switch_to.default_content()
        return count

    def of_viewer(name):
        return driver.find_element(By.ID, "viewer").get_attribute(name) or ""

    def part():
        return driver.current_url.partition("#")[2]

    with running(results) as server, browser(1200, 1000) as driver:
        open_page(driver, server.with_key)
        until(driver, lambda: shown(driver, "first-drop"))
        driver.execute_script(f"location.hash = '{keys[0]}'")
        until(driver, lambda: shown(driver, "done"))
        announced = driver.find_element(By.ID, "announced")
        assert announced.aria_role == "status" and announced.text == "cat: done"
        write_note(driver)
        assert notes() == 1
        press_visible(driver, "#object p a")
        until(driver, lambda: shown(driver, "first-drop"))
        driver.back()
        until(driver, lambda: shown(driver, "done"))
        assert part() == keys[0] and notes() == 1
        for key, count in ((keys[1], 0), (keys[0], 1)):  # also behind another result
            driver.execute_script(f"location.hash = '{key}'")
            until(driver, lambda key=key: key in of_viewer("src"))
            assert notes() == count and len(of_viewer("title")) == 3
            frames = driver.find_elements(By.TAG_NAME, "iframe")
            assert len([f for f in frames if f.is_displayed()]) == 1
        assert of_viewer("title") == "cat"
        for _ in range(3):
            driver.back()
        until(driver, lambda: shown(driver, "first-drop"))
        # An object that was removed elsewhere does not hold on to the page.
        driver.execute_script(f"location.hash = '{keys[1]}'")
        until(driver, lambda: shown(driver, "done"))
        removed = f"{server.address}/api/objects/{keys[1]}/remove"
        urllib.request.urlopen(urllib.request.Request(removed, b"{}", method="POST"))
        until(driver, lambda: shown(driver, "first-drop"))
        assert part() == ""
        driver.back()
        time.sleep(2)
        assert part() == "" and shown(driver, "first-drop")
