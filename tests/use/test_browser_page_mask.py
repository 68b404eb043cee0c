"""The mask's editor in the browser's page: large photographs, several fingers."""

import numpy as np
import pytest

from unips_jax.io.images import write_image

pytest.importorskip("selenium", reason="selenium is not installed")
from browser import browser, messages  # noqa: E402
from browser_page import (  # noqa: E402
    ALONE,
    NEEDED,
    build_small,
    drag,
    drop_and_wait,
    mask_of,
    opened,
)

pytestmark = NEEDED


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = build_small(tmp_path_factory.mktemp("page"))[0]
    with browser(arguments=(ALONE,)) as driver, opened(driver, folder):
        yield driver
        assert not [text for text in messages(driver) if "Error" in text]


def taken(page, folder, **images):
    """Photographs and a mask of all of them, taken by the page."""
    paths = [folder / f"{name}.png" for name in images]
    for path, image in zip(paths, images.values(), strict=True):
        write_image(path, image)
    size = next(iter(images.values())).shape[:2]
    write_image(folder / "mask.png", np.full(size, 255, np.uint8))
    drop_and_wait(page, [*paths, folder / "mask.png"])


FINGERS = """
const canvas = document.getElementById("photograph");
canvas.setPointerCapture = () => {};
const box = canvas.getBoundingClientRect();
const send = (kind, x, pointerId = 1) => canvas.dispatchEvent(new PointerEvent(kind, {
  pointerId, isPrimary: pointerId === 1, bubbles: true, cancelable: true,
  clientX: box.left + x * box.width, clientY: box.top + box.height / 2 }));
document.querySelector("[data-tool=erase]").click();
send("pointerdown", 0.1);
send("pointerdown", 0.5, 2);
send(arguments[0], 0.5, 2);
send("pointermove", 0.9);
send("pointerup", 0.9);
document.querySelector("[data-tool=erase]").click();
"""


@pytest.mark.parametrize("ends", ["pointerup", "pointercancel"])
def test_a_second_finger_ends_no_stroke(page, tmp_path, ends):
    taken(page, tmp_path, a=np.full((60, 80, 3), 99, np.uint8))
    page.execute_script(FINGERS, ends)
    assert not mask_of(page, (60, 80))[30, 9:71].any()


COUNTED = """
const { prototype } = CanvasRenderingContext2D;
const put = prototype.putImageData;
window.most = 0; // pixels that are drawn at once
prototype.putImageData = function (image, ...place) {
  window.most = Math.max(window.most, image.width * image.height);
  return put.call(this, image, ...place);
};
"""
COLORS = """
const canvas = document.getElementById("photograph");
const [context, scale] = [canvas.getContext("2d"), canvas.width / 3001];
return [[600, 600], [600, 1200], [2400, 600], [2400, 1200]].map(([x, y]) =>
  context.getImageData(x * scale, y * scale, 1, 1).data[0]);
"""
ERASED = """
let [top, bottom, left, right] = [1e9, 0, 1e9, 0];
unips.state.mask.forEach((there, i) => {
  if (there) return;
  const [row, column] = [Math.floor(i / 3001), i % 3001];
  [top, bottom] = [Math.min(top, row), Math.max(bottom, row)];
  [left, right] = [Math.min(left, column), Math.max(right, column)];
});
return [top, bottom, left, right];
"""


def test_a_large_photograph_is_drawn_in_less_and_masked_in_full(page, tmp_path):
    size = 2250, 3001
    image = np.zeros(size, np.uint8)
    image[:, 1800:] = 200
    taken(page, tmp_path, a=image)
    page.execute_script(COUNTED)
    page.execute_script("unips.editor.brush = 0.01")
    drag(page, "erase", (900, 600), (2400, 600))
    drag(page, "box", (30, 30), (40, 2000), (34, 34))  # too small to be looked in
    assert 0 < page.execute_script("return window.most") < 2**21
    shown = page.execute_script(COLORS)
    assert shown == [0, 0, 75, 200]
    # The mask is that of the photograph, and the stroke where it was drawn.
    erased = page.execute_script(ERASED)
    np.testing.assert_allclose(erased, [570, 630, 870, 2430], atol=4)


def test_of_grey_and_coloured_photographs_the_brightest_is_shown(page, tmp_path):
    generator = np.random.default_rng(0)
    grey = generator.integers(0, 255, (40, 50)).astype(np.uint8)
    color = generator.integers(0, 255, (40, 50, 3)).astype(np.uint8)
    taken(page, tmp_path, a=grey, b=color)
    shown = page.execute_script("return [...unips.editor.picture]")
    expected = np.maximum(grey[..., None], color)
    np.testing.assert_allclose(np.reshape(shown, (40, 50, 3)), expected, atol=1)
