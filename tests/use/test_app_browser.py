"""The application in a browser: from photographs to a lit surface.

`UNIPS_SCREENSHOTS=docs pytest tests/use/test_app_browser.py` also writes the pictures
of `docs/app.md`, from the sample that ships.
"""

import contextlib
import io
import json
import os
import signal
import socket
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
pytest.importorskip("nicegui", reason="nicegui is not installed")

from browser import ABSENT, browser, messages, pixels
from PIL import Image
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from unips_jax.io.images import read_image, write_image

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")

SAMPLE = Path(__file__).parents[2] / "unips_jax/assets/sample/obj000.data"
SCREENSHOTS = os.environ.get("UNIPS_SCREENSHOTS")
SIDE = 192 if SCREENSHOTS else 40
PATIENCE_S = 500  # several processes may share two cores


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A running application: its address, and the folder of its temporary files."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    work = tmp_path_factory.mktemp("temporary")
    # The library does other things where it sees pytest.
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    process = subprocess.Popen(
        [sys.executable, "-m", "unips_jax", "app", "--no-show", "--port", str(port)],
        env=inherited | {"TMPDIR": str(work)},
    )
    address = f"http://127.0.0.1:{port}"
    try:
        wait_for(address, process)
        yield address, work
        process.send_signal(signal.SIGTERM)
        process.wait(60)
        assert list(work.glob("unips-app-*")) == []  # nothing is left
    finally:
        process.kill()
        process.wait()


def wait_for(address, process):
    for _ in range(PATIENCE_S):
        with contextlib.suppress(OSError):
            urllib.request.urlopen(address, timeout=10).read()
            return
        assert process.poll() is None, "the server ended"
        time.sleep(1)
    raise AssertionError("the server does not answer")


@pytest.fixture
def photographs(tmp_path):
    paths = []
    for index in (0, 2, 4, 6):
        image = read_image(SAMPLE / f"L_0{index}.png")
        small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        paths.append(tmp_path / f"photo_{index}.png")
        write_image(paths[-1], small)
    return paths


def until(driver, true):
    return WebDriverWait(driver, PATIENCE_S).until(lambda _: true())


def main_text(driver):
    return driver.find_element(By.TAG_NAME, "main").text


def upload(driver, paths):
    chooser = driver.find_element(By.CSS_SELECTOR, "input[type=file]")
    chooser.send_keys("\n".join(map(str, paths)))


def mask_is_there(driver):
    script = "return document.getElementById('mask-editor')?.dataset.ready"
    return driver.execute_script(script) == "true"


def button(driver, text):
    found = [
        b for b in driver.find_elements(By.TAG_NAME, "button") if b.text.strip() == text
    ]
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", found[0])
    return found[0]


def screenshot(driver, name):
    if SCREENSHOTS:
        time.sleep(1)
        data = io.BytesIO(driver.get_screenshot_as_png())
        with Image.open(data) as image:
            small = image.convert("RGB").resize(
                (900, 900 * image.height // image.width)
            )
            small.save(Path(SCREENSHOTS) / name, quality=85)


def dark_share(driver):
    """Share of the mask's picture that is veiled."""
    picture = pixels(driver.find_element(By.ID, "mask-canvas")).astype(int)
    return (picture.max(-1) < 110).mean()


def test_from_photographs_to_a_lit_surface(server, photographs, tmp_path):
    address, work = server
    note = tmp_path / "notes.txt"
    note.write_text("no photograph")
    with browser(1200, 1100) as driver:
        driver.get(address)
        upload(driver, [*photographs, note])
        until(driver, lambda: mask_is_there(driver))
        text = main_text(driver)
        assert f"4 photographs of {SIDE} x {SIDE} pixels" in text
        assert "notes.txt: expected an image" in text
        assert "Suggested, as the background is plain" in text
        assert "Because: 16-bit values" in text
        thumbnails = driver.find_elements(By.CSS_SELECTOR, ".thumbnails li")
        assert [t.text for t in thumbnails] == [p.name for p in photographs]
        loaded = "return [...document.querySelectorAll('.thumbnails img')]"
        sizes = f"{loaded}.map((image) => image.naturalWidth)"
        until(driver, lambda: min(driver.execute_script(sizes)) > 0)
        suggested = dark_share(driver)
        assert 0.2 < suggested < 0.7
        screenshot(driver, "app-photographs.jpg")
        edit_the_mask(driver, suggested)
        button(driver, "Estimate normals").click()
        until(driver, lambda: "Results" in main_text(driver))
        until(driver, lambda: driver.find_elements(By.TAG_NAME, "iframe"))
        check_downloads(driver)
        check_viewer(driver)
        screenshot(driver, "app-result.jpg")
        assert [m for m in messages(driver) if "favicon" not in m] == []
        folders = list(work.glob("unips-app-*/*"))  # of others too, for a while
        assert folders and all(f.stat().st_mode & 0o77 == 0 for f in folders)


def edit_the_mask(driver, suggested):
    canvas = driver.find_element(By.ID, "mask-canvas")
    button(driver, "Remove").click()
    ActionChains(driver).click_and_hold(canvas).move_by_offset(
        100, 0
    ).release().perform()
    painted = dark_share(driver)
    assert painted > suggested + 0.005
    button(driver, "Undo").click()
    assert dark_share(driver) == pytest.approx(suggested, abs=1e-3)
    button(driver, "Nothing").click()
    assert dark_share(driver) > 0.95
    button(driver, "Box").click()
    width, height = canvas.size["width"], canvas.size["height"]
    ActionChains(driver).move_to_element_with_offset(
        canvas, 4 - width // 2, 4 - height // 2
    ).click_and_hold().move_by_offset(width - 8, height - 8).release().perform()
    status = driver.find_element(By.ID, "mask-status")
    until(driver, lambda: "as found in the box" in status.text)
    assert dark_share(driver) == pytest.approx(suggested, abs=0.12)


def check_downloads(driver):
    links = {
        link.text: link.get_attribute("href")
        for link in driver.find_elements(By.CSS_SELECTOR, "main a")
    }
    with urllib.request.urlopen(links["Everything (zip)"]) as answer:
        packed = zipfile.ZipFile(io.BytesIO(answer.read()))
    names = {Path(name).name for name in packed.namelist()}
    assert names >= {"normals.png", "depth.exr", "mesh.glb", "view.html"}
    with urllib.request.urlopen(links["normals.json"]) as answer:
        record = json.load(answer)
    assert len(record["images"]) == 4 and record["mask_pixels"] > 0.2 * SIDE**2
    with urllib.request.urlopen(links["normals.npy"]) as answer:
        normals = np.load(io.BytesIO(answer.read()))
    # The left faces left, the right right.
    columns = normals[..., 0].sum(0)
    assert columns[: SIDE // 3].sum() < 0 < columns[-SIDE // 3 :].sum()
    stranger = links["normals.json"].split("/files/")[0] + "/files/" + "A" * 32
    for other in (f"{stranger}/1/results/normals.json", f"{stranger}/1/about/mask.png"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(other)


def check_viewer(driver):
    frame = driver.find_element(By.TAG_NAME, "iframe")
    driver.execute_script("arguments[0].scrollIntoView()", frame)
    driver.switch_to.frame(frame)
    ready = "return document.body.dataset.ready"
    until(driver, lambda: driver.execute_script(ready) == "true")
    stage = driver.find_element(By.ID, "stage")
    lit = []
    for side in (-200, 200):
        ActionChains(driver).move_to_element_with_offset(stage, side, 0).perform()
        wait = "requestAnimationFrame(() => requestAnimationFrame(arguments[0]))"
        driver.execute_async_script(wait)
        lit.append(pixels(stage).mean(-1))
    driver.switch_to.default_content()
    width = lit[0].shape[1]
    change = lit[1] - lit[0]  # light from the right less light from the left
    left, right = (
        change[:, : width // 6].mean(),
        change[:, -width // 6 :].mean(),
    )
    assert left < -2 < 2 < right


@pytest.mark.slow
def test_an_estimate_is_cancelled(server, photographs):
    address, _ = server
    with browser(1200, 1100) as driver:
        driver.get(address)
        upload(driver, photographs)
        until(driver, lambda: mask_is_there(driver))
        button(driver, "Estimate normals").click()
        until(driver, lambda: "Cancel" in main_text(driver).title())
        button(driver, "CANCEL").click()
        until(driver, lambda: "cancelled" in main_text(driver))
        assert not driver.find_elements(By.TAG_NAME, "iframe")


def test_damaged_photographs_are_one_line(server, tmp_path):
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"0" * 100)
    with browser(1200, 1100) as driver:
        driver.get(server[0])
        upload(driver, [tmp_path / "broken.png"])
        until(driver, lambda: "broken.png:" in main_text(driver))
        assert "/tmp" not in main_text(driver)


def test_other_sites_cannot_reach_it(server):
    request = urllib.request.Request(server[0], headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="400"):
        urllib.request.urlopen(request)
