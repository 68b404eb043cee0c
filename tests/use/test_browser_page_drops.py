"""Files dropped on the browser's page over others; what is asked of it meanwhile."""

import contextlib
import time

import numpy as np
import pytest
from plain_objects import photographs

from unips_jax.io.formats.raster import marked_srgb
from unips_jax.io.images import write_image

pytest.importorskip("selenium", reason="selenium is not installed")
from browser import browser, messages  # noqa: E402
from browser_page import (  # noqa: E402
    ALONE,
    NEEDED,
    PATIENCE_S,
    SETTLED,
    STATUS,
    build_small,
    drag,
    drop,
    drop_and_wait,
    finding_objects,
    mask_of,
    opened,
    overlap,
    until,
)
from selenium.webdriver.support.ui import Select  # noqa: E402

pytestmark = NEEDED
SIZE = 120, 240
KEPT = """
const [key, done] = arguments;
import("./keep.js").then(async ({ recall }) => {
  const value = await recall(key);
  done(key === "files" ? value?.map((file) => file.name) : value && [...value]);
});
"""


@pytest.fixture(scope="module")
def driver():
    with browser(arguments=(ALONE,)) as driver:
        yield driver


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return build_small(tmp_path_factory.mktemp("page"))[0]


@pytest.fixture
def page(small, driver):
    with opened(driver, small):
        yield driver
        assert not [text for text in messages(driver) if "Error" in text]


@pytest.fixture
def long_search(small):
    with finding_objects(small):
        yield


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """Photographs of an object on the left, on the right, and of both: files, masks."""
    images, mask = photographs(3, count=3, size=SIZE)
    left, right = (np.roll(images, by, axis=2) for by in (-60, 60))
    masks = [np.roll(mask, by, axis=1) for by in (-60, 60)]
    folder = tmp_path_factory.mktemp("sets")
    made = {}
    for name, shown, truth in (
        ("left", left, masks[0]),
        ("right", right, masks[1]),
        ("both", np.maximum(left, right), masks),
    ):
        paths = [folder / f"{name}{i}.png" for i in range(3)]
        for path, image in zip(paths, shown, strict=True):
            write_image(path, image)
        made[name] = paths, truth
    return made


def reload(page):
    page.get(page.current_url)
    until(page, f"return !!window.unips && {SETTLED}")


def kept(page, key):
    return page.execute_async_script(KEPT, key)


def until_kept(page, paths):
    end = time.monotonic() + PATIENCE_S
    while kept(page, "files") != [path.name for path in paths]:
        assert time.monotonic() < end, kept(page, "files")


def compute(page, *, whole=True):
    """Begins; the whole image takes longer."""
    if whole:
        page.find_element("id", "whole").click()
    page.execute_script("document.getElementById('side').value = '0'")
    page.find_element("id", "estimate").click()


def test_photographs_dropped_over_others_leave_nothing_of_them(page, sets):
    (first, _), (second, truth) = sets["left"], sets["right"]
    drop_and_wait(page, first)
    compute(page, whole=False)
    until(page, f"return /^done/.test({STATUS})")
    drop_and_wait(page, second)
    assert page.execute_script("return unips.state.result") is None
    until_kept(page, second)
    reload(page)
    assert overlap(mask_of(page, SIZE), truth) > 0.9
    assert page.execute_script("return unips.state.result") is None
    assert kept(page, "result") is None and kept(page, "running") is None


def test_photographs_dropped_while_others_are_computed_end_that(page, sets, tmp_path):
    (first, _), (second, truth) = sets["left"], sets["right"]
    write_image(tmp_path / "mask.png", truth.astype(np.uint8) * 255)
    drop_and_wait(page, first)
    compute(page)
    until(page, f"return /%|^done/.test({STATUS})")
    drop_and_wait(page, [*second, tmp_path / "mask.png"])
    assert page.find_element("id", "estimate").is_displayed()
    until_kept(page, [tmp_path / "mask.png", *second])
    assert kept(page, "running") is None
    reload(page)
    np.testing.assert_array_equal(mask_of(page, SIZE), truth)
    assert page.execute_script("return unips.state.result") is None


def test_photographs_dropped_while_an_object_is_looked_for(page, sets, long_search):
    (first, _), (second, truth) = sets["left"], sets["right"]
    drop(page, first)
    until(page, f"return /looking|found/.test({STATUS})")
    # Until it is known where it is, nothing is computed.
    disabled = "document.getElementById('estimate').disabled"
    assert page.execute_script(f"return {disabled} || {SETTLED}")
    drop_and_wait(page, second)
    assert overlap(mask_of(page, SIZE), truth) > 0.9
    assert not page.execute_script(f"return {disabled}")


def test_a_mask_that_is_dropped_stays(page, sets, tmp_path):
    mask = np.zeros(SIZE, np.uint8)
    mask[20:70, 30:90] = 255
    write_image(tmp_path / "mask.png", mask)
    drop_and_wait(page, sets["left"][0])
    for _ in range(2):  # also over itself
        drop_and_wait(page, [tmp_path / "mask.png"])
    until_kept(page, [*sets["left"][0], tmp_path / "mask.png"])
    np.testing.assert_array_equal(mask_of(page, SIZE), mask > 0)
    reload(page)
    np.testing.assert_array_equal(mask_of(page, SIZE), mask > 0)


def test_other_files_leave_the_mask(page, sets, tmp_path):
    drop_and_wait(page, sets["left"][0])
    drag(page, "paint", (200, 10), (230, 10))
    painted = mask_of(page, SIZE)
    for name in ("notes.txt", "IMG_1.CR3"):
        (tmp_path / name).write_bytes(b"no photograph")
        drop(page, [tmp_path / name])
        until(page, f"return /expected photographs/.test({STATUS})")
        np.testing.assert_array_equal(mask_of(page, SIZE), painted)


def test_maps_are_no_photographs_and_masks_have_names(page, sets, tmp_path):
    mask = np.zeros(SIZE, np.uint8)
    mask[20:70, 30:90] = 255
    normals = np.full((*SIZE, 3), 128, np.uint8)
    for name, image in (("cat.mask", mask), ("normal_gt", normals), ("objMask", mask)):
        write_image(tmp_path / f"{name}.png", image)
    drop_and_wait(page, [*sets["left"][0], *sorted(tmp_path.glob("*.png"))])
    assert page.execute_script("return unips.state.photographs.length") == 3
    np.testing.assert_array_equal(mask_of(page, SIZE), mask > 0)
    said = page.execute_script(f"return {STATUS}")
    assert "3 photographs" in said and "without normal_gt.png, objMask.png" in said


def test_photographs_of_other_tags_are_refused(page, sets, tmp_path):
    deep = [tmp_path / f"{i}.png" for i in range(2)]
    for path in deep:
        write_image(path, np.full((*SIZE, 3), 9000, np.uint16))
    deep[1].write_bytes(marked_srgb(deep[1].read_bytes()))
    drop(page, deep)
    until(
        page,
        f"return /1.png: expected values that encode light as in 0.png/.test({STATUS})",
    )
    # What the message advises is there, and is done.
    Select(page.find_element("id", "transfer")).select_by_value("srgb")
    drop_and_wait(page, deep)
    assert page.execute_script("return unips.state.photographs.length") == 2


def test_two_masks_or_maps_alone_replace_nothing(page, sets, tmp_path):
    drop_and_wait(page, sets["left"][0])
    drag(page, "paint", (200, 10), (230, 10))
    painted = mask_of(page, SIZE)
    masks = [tmp_path / f"{name}.mask.png" for name in ("cat", "dog")]
    normals = tmp_path / "normal_gt.png"
    for path in (*masks, normals):
        write_image(path, np.full(SIZE, 255, np.uint8))
    for paths, said in ((masks, "expected one mask"), ([normals], "a map by its name")):
        drop(page, paths)
        until(page, f"return /{said}/.test({STATUS})")
        np.testing.assert_array_equal(mask_of(page, SIZE), painted)
        assert page.execute_script("return unips.state.photographs.length") == 3


FIND = """
new MutationObserver((_, observer) => {
  if (!document.getElementById("status").textContent.includes("%")) return;
  observer.disconnect();
  document.getElementById("find").click();
}).observe(document.getElementById("status"), { childList: true });
"""


@pytest.mark.parametrize("found", [True, False])
def test_an_object_looked_for_meanwhile_leaves_the_run(page, small, sets, found):
    drop_and_wait(page, sets["both"][0])
    network = small / "network" / "mask.onnx"
    if not found:  # the network is fetched anew, in vain
        until_kept(page, sets["both"][0])
        reload(page)
        network.rename(network.with_suffix(".away"))
    try:
        page.execute_script(FIND)
        compute(page)
        ended = "!document.getElementById('estimate').hidden"
        until(page, f"return !!unips.state.result && {ended}")
        if found:
            until(page, "return unips.state.mask.includes(0)")
    finally:
        if not found:
            network.with_suffix(".away").rename(network)
            messages(page)
    squares, pixels = page.execute_script(
        "const { normals, mask } = unips.state.result;"
        "const sum = (values) => values.reduce((a, b) => a + b, 0);"
        "return [sum(normals.map((n) => n * n)), sum(mask)]"
    )
    assert squares == pytest.approx(pixels, rel=1e-3) and pixels > 0


@contextlib.contextmanager
def away(page, *files):
    for file in files:
        file.rename(file.with_suffix(".away"))
    yield
    for file in files:
        file.with_suffix(".away").rename(file)
    messages(page)  # the browser says what it did not find


def test_normals_are_saved_where_the_viewer_cannot_be_loaded(page, small, sets):
    drop_and_wait(page, sets["left"][0])
    with away(page, small / "viewer.html"):
        compute(page, whole=False)
        for _ in range(2):  # and after a reload
            until(page, f"return /normals can be saved/.test({STATUS})")
            assert page.find_element("id", "download").is_displayed()
            assert not page.find_element("id", "save").is_displayed()
            page.refresh()
    page.refresh()
    until(page, f"return /as it was left/.test({STATUS})")
    assert page.find_element("id", "save").is_displayed()


def test_a_runtime_that_was_not_loaded_is_asked_for_again(page, small, sets):
    runtime = [*(small / "vendor" / "onnxruntime-web").glob("*.wasm")]
    assert runtime
    with away(page, *runtime):
        drop(page, sets["left"][0])
        until(page, f"return /the object was not looked for/.test({STATUS})")
        compute(page)
        until(page, f"return /^the network could not be run/.test({STATUS})")
    compute(page)
    until(page, f"return /^done/.test({STATUS})")


def test_of_two_boxes_the_second_gives_the_mask(page, sets):
    paths, (left, right) = sets["both"]
    drop_and_wait(page, paths)
    page.execute_script("document.getElementById('status').textContent = ''")
    for truth in (left, right):
        rows, columns = (np.flatnonzero(truth.any(axis=axis)) for axis in (1, 0))
        start = columns[0] - 4, rows[0] - 4
        drag(page, "box", start, (columns[-1] + 5, rows[-1] + 5))
    until(
        page,
        f"return {SETTLED} && !unips.state.mask.some((v, i) => v && i % 240 < 115)",
    )
    assert overlap(mask_of(page, SIZE), right) > 0.9


NO_LOCKS = "Object.defineProperty(Navigator.prototype, 'locks', {value: undefined})"


def before_pages(page, source):
    """Runs a script in this tab before any page's own."""
    name = "Page.addScriptToEvaluateOnNewDocument"
    return page.execute_cdp_cmd(name, {"source": source})


@pytest.mark.parametrize("script", ["", NO_LOCKS], ids=["locks", "plain http"])
def test_of_two_tabs_the_first_keeps_its_work(page, sets, script):
    """By plain http from another machine browsers have no locks."""
    first, url = page.current_window_handle, page.current_url
    made = before_pages(page, script)
    page.get(url)
    until(page, "return !!window.unips")
    drop_and_wait(page, sets["left"][0])
    until_kept(page, sets["left"][0])
    page.switch_to.new_window("tab")
    try:
        before_pages(page, script)
        page.get(url)
        until(page, "return crossOriginIsolated && !!window.unips")
        assert kept(page, "files") is None
        drop_and_wait(page, sets["right"][0])
        assert page.execute_script("return unips.state.photographs.length") == 3
        page.find_element("id", "restart").click()
    finally:
        page.close()
        page.switch_to.window(first)
    assert kept(page, "files") == [path.name for path in sets["left"][0]]
    reload(page)
    names = page.execute_script("return unips.state.photographs.map((p) => p.name)")
    assert names == [path.name for path in sets["left"][0]]
    page.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", made)


def choose_linear(page):
    page.execute_script("document.getElementById('choices').open = true")
    Select(page.find_element("id", "transfer")).select_by_value("linear")


def test_how_values_encode_light_is_said_of_one_object(page, sets):
    drop_and_wait(page, sets["left"][0])
    choose_linear(page)
    page.find_element("id", "restart").click()
    until(page, "return !document.getElementById('drop').hidden")
    drop_and_wait(page, sets["right"][0])
    assert page.find_element("id", "transfer").get_property("value") == "auto"


def test_photographs_are_kept_before_their_object_is_found(page, sets):
    """On a slow link the network takes long."""
    never = "window.Worker = class { postMessage() {} terminate() {} }"
    page.execute_script(never)
    drop(page, sets["left"][0])
    until_kept(page, sets["left"][0])
    assert page.execute_script("return document.getElementById('estimate').disabled")
    reload(page)
    assert page.execute_script("return unips.state.photographs.length") == 3


def test_a_file_that_cannot_be_opened_is_named(page, sets):
    drop_and_wait(page, sets["left"][0])
    page.execute_script(
        """
        const { arrayBuffer } = File.prototype;
        File.prototype.arrayBuffer = function () {
          const lost = new DOMException("it lies in a cloud", "NotReadableError");
          const there = this.name !== "right1.png";
          return there ? arrayBuffer.call(this) : Promise.reject(lost);
        };
        """
    )
    drop(page, sets["right"][0])
    until(page, f"return /^right1.png: expected a file that can be/.test({STATUS})")
    names = page.execute_script("return unips.state.photographs.map((p) => p.name)")
    assert names == [path.name for path in sets["left"][0]]


def test_options_survive_a_reload(page, sets):
    drop_and_wait(page, sets["left"][0])
    until_kept(page, sets["left"][0])
    page.execute_script("document.getElementById('choices').open = true")
    for name, value in (("transfer", "linear"), ("side", "320")):
        choice = Select(page.find_element("id", name))
        next(o for o in choice.options if o.get_property("value") == value).click()
    reload(page)
    for name, value in (("transfer", "linear"), ("side", "320")):
        assert page.find_element("id", name).get_property("value") == value
    drop_and_wait(page, sets["right"][0])
    until_kept(page, sets["right"][0])
    reload(page)
    assert page.find_element("id", "transfer").get_property("value") == "linear"
