"""The viewer's page in a browser: opened, its controls used, its pixels read."""

import known_results
from browser import pixels
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import Select, WebDriverWait


def opened(driver):
    ready = "return document.body.dataset.ready === 'true'"
    WebDriverWait(driver, 300).until(lambda d: d.execute_script(ready))


def element(page, name):
    return page.find_element(By.ID, name)


def press(page, selector):
    page.find_element(By.CSS_SELECTOR, selector).click()


def choose(page, name, value):
    Select(element(page, name)).select_by_value(value)


def slide(page, name, value):
    page.execute_script(
        "arguments[0].value = arguments[1];"
        "arguments[0].dispatchEvent(new Event('input'))",
        element(page, name),
        value,
    )


def drawn(page):
    """The stage's pixels, after what was asked for is drawn."""
    wait = "requestAnimationFrame(() => requestAnimationFrame(arguments[0]))"
    page.execute_async_script(wait)
    return pixels(element(page, "stage")).astype(int)


def point(page, x, y):
    """The pointer at a place from the stage's middle, in units of the hemisphere."""
    return ActionChains(page).move_to_element_with_offset(
        element(page, "stage"), round(x * radius(page)), round(-y * radius(page))
    )


def drag(page, start, end):
    """From one place to another, in units of the hemisphere."""
    x, y = ((b - a) * radius(page) for a, b in zip(start, end, strict=True))
    point(page, *start).click_and_hold().move_by_offset(
        round(x / 2), round(-y / 2)
    ).move_by_offset(
        round(x) - round(x / 2), -round(y) + round(y / 2)
    ).release().perform()


def radius(page):
    """Of the hemisphere, in pixels of the screen."""
    size = element(page, "stage").size
    shown = 2 * 35.5 + 2 + 2 * int(2 + 0.03 * 71)
    return 0.96 * min(size["width"], size["height"]) / shown * known_results.RADIUS


def sample(page, picture, x, y):
    """Mean colour of a few pixels around a place, in units of the hemisphere."""
    row = round(picture.shape[0] / 2 - y * radius(page))
    column = round(picture.shape[1] / 2 + x * radius(page))
    return picture[row - 3 : row + 4, column - 3 : column + 4].mean((0, 1))


def value(page, name):
    return float(element(page, name).get_attribute("value"))
