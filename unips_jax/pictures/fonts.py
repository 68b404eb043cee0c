"""Names in any script on matplotlib's sheets: fonts that have them, lengths that fit.

`lettering` is for pictures without matplotlib.
"""

import functools
import unicodedata

from matplotlib import font_manager

# In order of preference; matplotlib cannot draw colour fonts of bitmaps.
_FAMILIES = (
    "DejaVu Sans, Noto Sans, Noto Sans CJK JP, Noto Sans CJK SC, Noto Emoji, Symbola, "
    "WenQuanYi Zen Hei, Droid Sans Fallback, Hiragino Sans, PingFang SC, "
    "Apple SD Gothic Neo, Arial Unicode MS, Yu Gothic, Microsoft YaHei, "
    "Malgun Gothic, Segoe UI Symbol"
).split(", ")
_MISSING = "\N{WHITE SQUARE}"


def drawable(text: str) -> tuple[str, list[str]]:
    """A text that can be drawn, and the families of fonts to draw it with.

    Characters that no font has become white squares; marks without width, as in emoji,
    go.
    """
    fonts = _fonts()
    shown = []
    for character in text:
        if any(ord(character) in characters for _, characters in fonts):
            shown.append(character)
        elif unicodedata.category(character) not in ("Cf", "Mn", "Me", "Cc"):
            shown.append(_MISSING)
    needed = [
        family
        for family, characters in fonts
        if any(ord(c) in characters for c in shown)
    ]
    return "".join(shown), needed or [fonts[0][0]]


def shorten(text: str, most: int) -> str:
    """The text without its middle if wider than `most` letters; an ideograph is two."""
    if text_width(text) <= most:
        return text
    head, tail = text[: len(text) // 2], text[len(text) // 2 :]
    while text_width(head + tail) > most - 1:
        if text_width(head) > text_width(tail):
            head = head[:-1]
        else:
            tail = tail[1:]
    return f"{head}…{tail}"


def text_width(text: str) -> int:
    """The width of a text in letters; an ideograph counts as two."""
    return sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text)


@functools.cache
def _fonts() -> tuple[tuple[str, frozenset[int]], ...]:
    """The installed families of `_FAMILIES`, with the characters that they have."""
    installed = set(font_manager.fontManager.get_font_names())
    found = []
    for family in _FAMILIES:
        if family in installed:
            path = font_manager.findfont(family)
            characters = font_manager.get_font(path).get_charmap()
            found.append((family, frozenset(characters)))
    return tuple(found)
