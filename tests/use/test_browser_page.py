"""The page that estimates normals in a browser alone gives those of the package."""

import base64
import json
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from picture_files import png
from PIL import Image
from plain_objects import HARD, photographs

from unips_jax import estimate_photographs, load_weights, read_photographs
from unips_jax.capture.masks import suggest_mask
from unips_jax.io.images import read_image, write_image
from unips_jax.io.normals import read_normals
from unips_jax.metrics import angular_error_deg

pytest.importorskip("selenium", reason="selenium is not installed")
from browser import browser, messages  # noqa: E402
from browser_page import (  # noqa: E402
    ALONE,
    NEEDED,
    STATUS,
    build,
    build_small,
    drag,
    finding_objects,
    mask_of,
    opened,
    overlap,
    until,
)
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import Select  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "unips_jax" / "assets" / "sample" / "obj000.data"
SOURCE = ROOT / "tools" / "browser"
pytestmark = NEEDED
BYTES = """
const bytes = unips.normalsPng();
let text = "";
for (let i = 0; i < bytes.length; i += 8192)
  text += String.fromCharCode(...bytes.subarray(i, i + 8192));
return btoa(text);
"""


@pytest.fixture(scope="module")
def driver():
    with browser(arguments=(ALONE,)) as driver:
        yield driver


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    page, weights = build_small(tmp_path_factory.mktemp("page"))
    return page, load_weights(weights)


def choose(driver, files):
    driver.execute_script("document.getElementById('status').textContent = ''")
    driver.find_element("id", "files").send_keys("\n".join(map(str, files)))
    said = "document.getElementById('status')"
    until(
        driver,
        f"return /^\\d+ photographs? of|expected/.test({said}.textContent)",
    )
    return driver.execute_script(f"return {said}.textContent")


def normals_by_page(driver, folder):
    assert "photographs of" in choose(driver, sorted(folder.iterdir()))
    if not (folder / "mask.png").exists():
        driver.find_element("id", "whole").click()
    driver.execute_script("document.getElementById('side').value = '0'")
    driver.find_element("id", "estimate").click()
    until(driver, "return !document.getElementById('download').hidden")
    path = folder.parent / f"{folder.name}.png"
    path.write_bytes(base64.b64decode(driver.execute_script(BYTES)))
    return read_normals(path)


def require_same(found, folder, network):
    """As `unips estimate --fast`; of small objects that is the whole of it."""
    images, mask, transfer = read_photographs(folder)
    expected = estimate_photographs(network, images, mask, transfer=transfer, fast=True)
    # Zero is stored as the integer above it.
    assert np.array_equal(np.linalg.norm(found, axis=-1) > 0.5, mask)
    assert np.max(angular_error_deg(found[mask], expected[mask])) < 0.1


def write_set(folder, dtype):
    """Photographs with black corners; of 8 bits, as sRGB with a mask."""
    generator = np.random.default_rng(5)
    top = np.iinfo(dtype).max
    for i in range(3):
        values = generator.uniform(0.2, 1, (21, 26, 3))
        values[:6, :7] = 0
        write_image(folder / f"p{i}.png", (values * top).astype(dtype))
    if dtype == np.uint8:
        mask = np.zeros((21, 26), np.uint8)
        mask[2:19, 3:24] = 200
        write_image(folder / "mask.png", mask)


def write_ring(folder):
    """An object so large that its second view is decoded at few pixels, yet of few."""
    y, x = np.mgrid[:205, :230]
    distance = np.hypot(x - 115, y - 102)
    mask = np.abs(distance - 97) < 4
    for i in range(3):
        waves = 0.5 + 0.4 * np.sin(0.1 * (x + 2 * y) + 2 * i)
        colors = np.stack([waves, waves**2, 1 - waves], -1) * 255
        write_image(folder / f"p{i}.png", colors.astype(np.uint8))
    write_image(folder / "mask.png", mask.astype(np.uint8) * 255)


def write_linear(folder):
    """Photographs that say to be linear: next to black are 1.2 % of light, and 4 %."""
    generator = np.random.default_rng(6)
    for i in range(3):
        values = generator.integers(60, 255, (21, 26, 3)).astype(np.uint8)
        for level, width in ((10, 12), (3, 9), (0, 7)):
            values[:6, :width] = level
        linear = {b"gAMA": struct.pack(">I", 100000)}
        folder.mkdir(exist_ok=True)
        (folder / f"p{i}.png").write_bytes(png(values, 2, 8, linear))
    write_image(folder / "mask.png", np.full((21, 26), 255, np.uint8))


def test_page(small, driver, tmp_path):
    page, network = small
    for name, dtype in (("eight", np.uint8), ("sixteen", np.uint16)):
        write_set(tmp_path / name, dtype)
    write_ring(tmp_path / "ring")
    write_linear(tmp_path / "linear")
    pixels = np.random.default_rng(1).integers(0, 255, (16, 24, 3)).astype(np.uint8)
    write_image(tmp_path / "one.jpg", np.kron(pixels, np.ones((4, 4, 1), np.uint8)))
    with opened(driver, page):
        for name in ("eight", "sixteen", "ring", "linear"):
            found = normals_by_page(driver, tmp_path / name)
            require_same(found, tmp_path / name, network)
        # Browsers decode JPEGs nearly as we do.
        choose(driver, [tmp_path / "one.jpg"])
        values = driver.execute_script("return [...unips.state.photographs[0].values]")
        expected = read_image(tmp_path / "one.jpg").reshape(-1).astype(int)
        assert np.abs(np.array(values) - expected).max() <= 2
        refused = choose(driver, [tmp_path / "one.jpg", tmp_path / "eight" / "p0.png"])
        assert "one.jpg: expected" in refused or "p0.png: expected" in refused
        check_languages(driver)
        assert not [text for text in messages(driver) if "Error" in text]


def check_languages(driver):
    """All is said in German too, and again in English."""
    english = driver.execute_script("return document.body.innerText")
    menu = Select(driver.find_element("id", "language"))
    assert [option.text for option in menu.options] == ["English", "Deutsch"]
    menu.select_by_value("de")
    german = driver.execute_script("return document.body.innerText")
    assert "Fotos auswählen" in german and "photograph" not in german
    assert ": erwartet wurden" in german  # what was refused is said again
    said = driver.execute_script(
        "return [...document.querySelectorAll('[data-t]')].map((e) => e.textContent)"
    )
    assert len(said) > 20 and all(said)
    driver.get(driver.current_url)  # chosen once
    until(driver, "return !!window.unips")
    assert driver.execute_script("return document.documentElement.lang") == "de"
    Select(driver.find_element("id", "language")).select_by_value("en")
    until(driver, "return document.body.innerText.includes('Choose photographs')")
    assert "Largest side" not in english  # in Options, which are closed


def test_both_languages_say_all_of_it():
    table = json.loads((SOURCE / "strings.json").read_text("utf-8"))
    english, german = table["en"], table["de"]
    assert english.keys() == german.keys()
    for key, text in english.items():
        gaps = [set(re.findall(r"\{\w+\}", words)) for words in (text, german[key])]
        assert gaps[0] == gaps[1], key
    page = (SOURCE / "index.html").read_text("utf-8")
    code = "".join(path.read_text("utf-8") for path in SOURCE.glob("*.js"))
    used = set(re.findall(r'data-t(?:-label)?="(\w+)"', page))
    used |= set(re.findall(r'\b(?:t|tell|after)\("(\w+)"', code))
    used |= {f"refused_{key}" for key in re.findall(r'Refusal\("(\w+)"', code)}
    used |= {f"stage_{key}" for key in re.findall(r'stage: "(\w+)"', code)}
    assert len(used) > 40 and used <= english.keys()
    # Nothing is said past the table.
    assert not re.findall(r">[^<>{}]*[A-Za-z]{3}[^<>{}]*</(?:p|h1|button|span)>", page)


VIEWER = "document.getElementById('viewer').contentDocument"
READY = f"{VIEWER}?.body?.dataset.ready === 'true'"
SAVED = """
const [done] = arguments;
for (const there of [window, document.getElementById("viewer").contentWindow]) {
  there.HTMLAnchorElement.prototype.click = () => {};
  there.URL.createObjectURL = (blob) => (blob.text().then(done), "");
}
document.getElementById("save").click();
"""


def by_keys(driver, tool, *keys):
    """Chooses a tool, and presses keys on the photograph."""
    button = driver.find_element("css selector", f"[data-tool={tool}]")
    if button.get_attribute("aria-pressed") != "true":
        button.send_keys(Keys.ENTER)
    driver.find_element("id", "photograph").send_keys(*keys)


def test_mask_viewer_and_reload(small, driver, tmp_path):
    page, _ = small
    images, truth = photographs(3, **HARD["wood"], count=3)
    for index, image in enumerate(images):
        write_image(tmp_path / f"{index}.png", image)
    with finding_objects(page), opened(driver, page):
        said = choose(driver, sorted(tmp_path.glob("*.png")))
        assert "the object was found" in said
        found = mask_of(driver, truth.shape)
        assert overlap(found, truth) > 0.95
        assert overlap(found, suggest_mask(images).mask) > 0.98
        drag(driver, "paint", (10, 10), (40, 10))
        painted = mask_of(driver, truth.shape)
        assert painted[8:12, 10:40].all() and (painted != found).sum() < 1000
        driver.find_element("id", "undo").click()
        np.testing.assert_array_equal(mask_of(driver, truth.shape), found)
        by_keys(driver, "erase", Keys.RIGHT, " ", Keys.SHIFT, Keys.DOWN * 4)
        erased = found & ~mask_of(driver, truth.shape)
        rows, columns = (np.ptp(np.flatnonzero(erased.any(axis=x))) for x in (1, 0))
        assert rows > 1.5 * columns > 0
        by_keys(driver, "erase", "zzzzz")
        np.testing.assert_array_equal(mask_of(driver, truth.shape), found)
        # A box: nothing outside it.
        rows, columns = (np.flatnonzero(truth.any(axis=axis)) for axis in (1, 0))
        driver.execute_script("document.getElementById('status').textContent = ''")
        corner = columns[-1] + 7, rows[-1] + 7
        drag(driver, "box", (columns[0] - 6, rows[0] - 6), corner)
        until(driver, f"return /object was found|stands out/.test({STATUS})")
        assert overlap(mask_of(driver, truth.shape), truth) > 0.9
        driver.execute_script("document.getElementById('status').textContent = ''")
        by_keys(driver, "box", *(Keys.LEFT + Keys.UP) * 12, " ")
        by_keys(driver, "box", *(Keys.RIGHT + Keys.DOWN) * 24, " ")
        until(driver, f"return /object was found|stands out/.test({STATUS})")
        assert overlap(mask_of(driver, truth.shape), truth) > 0.9
        # The viewer at the end, with a surface that turns.
        driver.execute_script("document.getElementById('side').value = '0'")
        driver.find_element("id", "estimate").click()
        until(driver, f"return {READY} && /^done/.test({STATUS})")
        assert driver.switch_to.active_element.get_attribute("id") == "work"
        driver.switch_to.frame("viewer")
        driver.find_element("css selector", "[data-mode=surface]").click()
        until(driver, "return !document.getElementById('turning').hidden")
        driver.find_element("id", "add-view").click()
        driver.switch_to.default_content()
        # It is saved with what was kept.
        assert '"name":"View 1"' in driver.execute_async_script(SAVED)
        # A reload takes it up again, with its viewer in the page's language.
        kept = mask_of(driver, truth.shape)
        driver.execute_script("localStorage.setItem('unips-language', 'de')")
        driver.get(driver.current_url)
        until(driver, f"return {STATUS} === 'wie es verlassen wurde' && {READY}")
        assert driver.execute_script(f"return {VIEWER}.documentElement.lang") == "de"
        assert '"language":"de"' not in driver.execute_async_script(SAVED)
        np.testing.assert_array_equal(mask_of(driver, truth.shape), kept)
        assert not [text for text in messages(driver) if "Error" in text]


def test_a_run_that_was_cut_off_goes_on(small, driver, tmp_path):
    page, _ = small
    write_set(tmp_path / "set", np.uint8)
    with opened(driver, page):
        choose(driver, sorted((tmp_path / "set").iterdir()))
        # As if the screen had gone off with half of the pixels done.
        driver.execute_async_script(
            """
            const done = arguments[arguments.length - 1];
            import("./keep.js").then(async ({ keep }) => {
              const normals = new Float32Array(21 * 26 * 3);
              for (let i = 0; i < 10 * 26; i++) normals[3 * i] = 1;
              const options = { side: "0", transfer: "auto" };
              await keep("running", { options, normals });
              done();
            });
            """
        )
        driver.get(driver.current_url)
        until(driver, "return !!window.unips?.state.result")
        normals = driver.execute_script("return [...unips.state.result.normals]")
        normals = np.reshape(normals, (21, 26, 3))
        assert (normals[6:10, 7:24] == (1, 0, 0)).all()  # kept, not computed anew
        assert not (normals[10:19, 7:24] == (1, 0, 0)).all(axis=-1).any()
        lengths = np.linalg.norm(normals[10:19, 7:24], axis=-1)
        np.testing.assert_allclose(lengths, 1, atol=1e-3)


def test_turned_and_unreadable_photographs(small, driver, tmp_path):
    page, _ = small
    pixels = np.zeros((24, 36, 3), np.uint8)
    pixels[:8, :12] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter to the right
    Image.fromarray(pixels).save(tmp_path / "turned.jpg", exif=exif, quality=95)
    unreadable = tmp_path / f"{'my' * 50}phone.heic"
    unreadable.write_bytes(b"\0\0\0\x18ftypheic" + bytes(200))
    with opened(driver, page):
        choose(driver, [tmp_path / "turned.jpg"])
        width, height, *values = driver.execute_script(
            "const [f] = unips.state.photographs;"
            "return [f.width, f.height, ...f.values]"
        )
        assert (width, height) == (24, 36)
        values = np.reshape(values, (36, 24, 3))
        assert values[:10, 17:].min() > 200 and values[:, :14].max() < 50
        said = choose(driver, [unreadable])
        assert "phone.heic: expected an image that this browser reads" in said
        assert "Safari" in said
        metrics = {"width": 320, "height": 568, "deviceScaleFactor": 1, "mobile": True}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        wide = driver.execute_script("return document.scrollingElement.scrollWidth")
        driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        assert wide == 320


def test_the_page_is_small(small):
    page, _ = small
    files = [file for file in page.rglob("*") if file.is_file()]
    size = sum(file.stat().st_size for file in files if file.parent.name != "network")
    # The shipped networks are 14.1 MB, the mask's 2.3.
    assert size + 16.4e6 < 40e6


def test_another_site_is_left_alone(tmp_path, capsys):
    (tmp_path / "index.html").write_text("mine")
    (tmp_path / "about.html").write_text("mine")
    given = [str(tmp_path), "--weights", str(tmp_path / "none.safetensors")]
    assert build(given) == 2
    assert "(network/export.json), got one with other" in capsys.readouterr().err
    assert [file.read_text() for file in tmp_path.iterdir()] == ["mine", "mine"]
    (tmp_path / "network").mkdir()
    (tmp_path / "network" / "export.json").write_text("{}")
    assert build(given) == 2  # one of ours: the next thing that is wrong
    assert "none.safetensors: expected" in capsys.readouterr().err


@pytest.mark.slow
def test_page_with_the_shipped_weights(driver, tmp_path):
    assert build([str(tmp_path / "out")]) == 0
    folder = tmp_path / "sample"
    folder.mkdir()
    for file in SAMPLE.glob("*.png"):
        shutil.copy(file, folder)
    with opened(driver, tmp_path / "out"):
        found = normals_by_page(driver, folder)
    require_same(found, folder, load_weights("tiny"))
