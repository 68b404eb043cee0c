"""The application in a browser: from photographs to a lit surface, and nothing lost.

`UNIPS_SCREENSHOTS=docs pytest tests/use/test_app_browser.py -k pictures` writes those
of `docs/app.md`, from the sample that ships.
"""

import io
import json
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("selenium", reason="selenium is not installed")
pytest.importorskip("starlette", reason="starlette is not installed")
pytest.importorskip("uvicorn", reason="uvicorn is not installed")

import trimesh
from app_page import (
    SCREENSHOTS,
    SIDE,
    can_estimate,
    complaints,
    dark_share,
    drawn,
    open_page,
    press,
    press_visible,
    running,
    screenshot,
    shown,
    text,
    until,
    upload,
    written,
)
from browser import ABSENT, browser, pixels
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = pytest.mark.skipif(ABSENT, reason="chromium or its driver is absent")
STATUS = "export-status"


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """With the weights that ship."""
    with running(tmp_path_factory.mktemp("results")) as there:
        yield there


@pytest.fixture
def photographs(tmp_path):
    return written(tmp_path, SIDE)


@pytest.mark.parametrize(
    "name", ["stand_in", pytest.param("shipped", marks=pytest.mark.slow)]
)
def test_from_photographs_to_a_lit_surface(name, request, photographs, tmp_path):
    server = request.getfixturevalue(name)
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
        edit_the_mask(driver, suggested)
        press(driver, "estimate")
        until(driver, lambda: shown(driver, "done"))
        normals = check_downloads(driver, server)
        if name == "shipped":  # the left faces left, the right right
            columns = normals[..., 0].sum(0)
            assert columns[: SIDE // 3].sum() < 0 < columns[-SIDE // 3 :].sum()
        check_exports(driver, server)
        check_viewer(driver)
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
    shown = text(driver, "folder")
    folder = next(f for f in server.results.glob("object-*") if str(f) in shown)
    normals = np.load(folder / "normals.npy")
    length = np.linalg.norm(normals, axis=-1)
    assert np.count_nonzero(length > 0.99) == record["mask_pixels"]
    return normals


def check_exports(driver, server):
    """Each is made by its button, and opened by a library."""
    key = driver.execute_script("return location.hash.slice(1)")
    files = {}
    for purpose, name in (
        ("blender", "object.glb"),
        ("print", "object.stl"),
        ("archive", "object.zip"),
    ):
        press_visible(driver, f"[data-export={purpose}]")
        until(driver, lambda name=name: f"Saved: {name}" in text(driver, STATUS))
        said = text(driver, STATUS)
        assert ("its size is not known" in said.lower()) == (purpose != "archive")
        address = f"{server.address}/api/objects/{key}/exports/{name}"
        with urllib.request.urlopen(address) as answer:
            files[purpose] = io.BytesIO(answer.read())
    model = trimesh.load(files["blender"], file_type="glb", force="mesh")
    assert model.extents.max() == pytest.approx(1)
    assert model.visual.material.normalTexture.size == (SIDE, SIDE)
    assert trimesh.load(files["print"], file_type="stl").is_watertight
    packed = zipfile.ZipFile(files["archive"]).namelist()
    assert {"object/object-normals.png", "object/object.glb"} <= {*packed}
    driver.find_element(By.ID, "longest").send_keys("-5")
    press_visible(driver, "[data-export=print]")
    until(driver, lambda: "Expected a length above 0" in text(driver, STATUS))


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


def test_by_keys_alone(stand_in, photographs):
    """The focus stays where one was, and a box has keys."""

    def at():
        return driver.switch_to.active_element

    def on(selector, *keys):
        focus = "document.querySelector(arguments[0]).focus()"
        driver.execute_script(focus, selector)
        ActionChains(driver).send_keys(*keys).perform()

    with browser(1200, 1100) as driver:
        open_page(driver, stand_in.with_key)
        upload(driver, photographs)
        until(driver, lambda: can_estimate(driver))
        assert at().get_attribute("id") == "object-name"  # the home page is gone
        on("#thumbnails .x", Keys.ENTER)
        until(driver, lambda: "left out by you" in text(driver, "aside"))
        assert at().accessible_name == f"Leave out {photographs[1].name}"
        until(driver, lambda: can_estimate(driver))
        on("[data-mask-tool=box]", " ")
        on("#mask-canvas", Keys.LEFT * 18 + Keys.UP * 18, " ")
        on("#mask-canvas", Keys.RIGHT * 36 + Keys.DOWN * 36, " ")
        until(driver, lambda: "as found in the box" in text(driver, "mask-status"))
        on("#object p a", Keys.ENTER)
        until(driver, lambda: shown(driver, "list"))
        assert complaints(driver) == []  # later ones may be of what is gone
        on("#list .x", Keys.ENTER)
        until(driver, lambda: "Removed" in text(driver, "message"))
        ActionChains(driver).send_keys(Keys.ESCAPE).perform()
        assert not shown(driver, "message")


@pytest.mark.skipif(not SCREENSHOTS, reason="no pictures for docs/app.md are asked for")
def test_pictures(shipped, tmp_path):
    (tmp_path / "notes.txt").write_text("no photograph")
    (tmp_path / "photo_7.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"0" * 100)
    files = [*written(tmp_path, 192, range(7)), *sorted(tmp_path.glob("*s.txt"))]
    with browser(1200, 1650) as driver:
        open_page(driver, shipped.with_key)
        upload(driver, [*files, tmp_path / "photo_7.png"])
        until(driver, lambda: can_estimate(driver))
        screenshot(driver, "app-photographs.jpg")
        press(driver, "estimate")
        until(driver, lambda: shown(driver, "done"))
        driver.set_window_size(1200, 1350)
        check_viewer(driver)
        screenshot(driver, "app-result.jpg")


@pytest.mark.slow
def test_an_estimate_is_cancelled_and_changed(shipped, photographs):
    with browser(1200, 1100) as driver:
        open_page(driver, shipped.address)
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


def test_other_sites_cannot_reach_it(stand_in):
    for headers in (
        {"Host": "evil.example"},
        {"Origin": "http://evil.example"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"},
    ):
        request = urllib.request.Request(stand_in.address, headers=headers)
        with pytest.raises(urllib.error.HTTPError, match="40[03]"):
            urllib.request.urlopen(request)
