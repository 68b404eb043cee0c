"""Lines of text on pictures, in fonts that have their letters."""

import functools
import importlib.util
import re
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
_NO_LETTERS = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u2028\u2029]"
)  # nor spaces: no font takes them
_NO_CHARACTER = "\U0010ffff"  # what fonts draw for it, they draw for all that they lack
# Looked for by name in the system's folders, when the first of all lacks a letter.
_OTHERS = (
    "NotoSans-Regular.ttf NotoSansCJK-Regular.ttc NotoEmoji-Regular.ttf "
    "DroidSansFallbackFull.ttf wqy-zenhei.ttc Symbola.ttf seguisym.ttf msyh.ttc "
    "malgun.ttf YuGothM.ttc PingFang.ttc AppleSDGothicNeo.ttc Arial Unicode.ttf"
).split()


def write_line(
    picture: np.ndarray,
    place: tuple[float, float],
    text: str,
    *,
    size: float,
    colour: str,
) -> None:
    """Writes a line of text into a picture `[H, W, 3]`; letters of no font are boxes.

    `place` is its left end, and the middle of its height: x, y in pixels, as is the
    size.
    """
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    x, y = place
    y += 0.36 * size  # from the middle of the letters to the line that they stand on
    for font, run in _runs(_NO_LETTERS.sub(" ", text), size):
        draw.text((x, y), run, colour, font, anchor="ls")
        x += font.getlength(run)
    picture[:] = np.asarray(image)


def _runs(text: str, size: float) -> list[tuple[_Font, str]]:
    """The text in pieces, each with the first font that has its letters."""
    runs: list[tuple[_Font, str]] = []
    for character in text:
        font = _font_for(character, size)
        if runs and runs[-1][0] is font:
            runs[-1] = (font, runs[-1][1] + character)
        else:
            runs.append((font, character))
    return runs


def _font_for(character: str, size: float) -> _Font:
    first = _first_font(size)
    if _has(first, character):
        return first
    for name in _OTHERS:
        font = _font(name, size)
        if font is not None and _has(font, character):
            return font
    return first


def _has(font: _Font, character: str) -> bool:
    if character.isspace():
        return True
    drawn, absent = font.getmask(character), font.getmask(_NO_CHARACTER)
    return drawn.size != absent.size or bytes(drawn) != bytes(absent)


@functools.cache
def _first_font(size: float) -> _Font:
    return _font(_dejavu(), size) or ImageFont.load_default(size)


@functools.cache
def _font(name: str, size: float) -> _Font | None:
    try:
        return ImageFont.truetype(name, size)
    except OSError:
        return None


def _dejavu() -> str:
    """DejaVu Sans as it comes with matplotlib, which is not imported for it."""
    name = "DejaVuSans.ttf"
    found = importlib.util.find_spec("matplotlib")
    for folder in (found.submodule_search_locations or ()) if found else ():
        path = Path(folder) / "mpl-data" / "fonts" / "ttf" / name
        if path.is_file():
            return str(path)
    return name
