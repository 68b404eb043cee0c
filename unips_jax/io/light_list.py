"""Lists of lights, as programs for RTI write them (`.lp`).

A line is a photograph's name and its light: a direction, three numbers, or the place of
a highlight, two, in pixels. The first line may be how many follow. Numbers have decimal
points or commas and blanks, tabs, commas or semicolons between them; names may be
quoted, with folders, and have blanks. Text is UTF-8, with or without a mark, or UTF-16.
"""

import codecs
import dataclasses
import re
from pathlib import Path

import numpy as np

from unips_jax.errors import InputError

_LIMIT = 1 << 20  # bytes
_LONGEST = 4096  # characters of a name and its folders
_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)

_TAIL = r"(?:[eE][-+]?\d+)?"
_COMMA = re.compile(rf"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+){_TAIL}")
_POINT = re.compile(rf"[-+]?(?:\d+\.?\d*|\.\d+){_TAIL}")
_STYLES = (  # with commas between numbers, those in numbers need blanks too
    (re.compile(r"\s*;\s*|,?\s+"), _COMMA),
    (re.compile(r"\s*[,;]\s*"), _POINT),
)
# A blank after a file's name, commas alone between three numbers.
_NUMBERS = r"\s*,\s*".join([_POINT.pattern] * 3)
_AFTER_BLANK = re.compile(rf"(\.\w+[\"']?)\s+(?={_NUMBERS}$)")


@dataclasses.dataclass(frozen=True)
class LightList:
    """What a list of lights holds.

    `names` are without folders; `lights [N, 3]`, directions, or `[N, 2]`, pixels, as
    written; `problems` what could not be used, a line each.
    """

    names: tuple[str, ...]
    lights: np.ndarray
    problems: tuple[str, ...]


def read_light_list(path: Path) -> LightList:
    """Reads a list of lights; lines that are none become problems."""
    try:
        with path.open("rb") as opened:
            data = opened.read(_LIMIT)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    found: dict[str, tuple[float, ...]] = {}
    problems, stated = [], None
    for number, line in enumerate(_decoded(data).splitlines(), 1):
        text = line.strip().strip("\ufeff")
        if not text or text.startswith(("#", "//")):
            continue
        if stated is None and not found and re.fullmatch(r"\d+[,;]?", text):
            stated = int(text.rstrip(",;")[:9])
            continue
        where = f"{path.name}, line {number}"
        name, values = _read(text)
        if not values:
            problems.append(f"{where}: no name and light, {text[:60]!r}")
        elif not name:
            problems.append(f"{where}: a light without a name, {text[:60]!r}")
        elif name in found:
            problems.append(f"{where}: {name} is there twice")
        elif found and len(values) != len(next(iter(found.values()))):
            problems.append(f"{where}: {len(values)} numbers, other than before")
        else:
            found[name] = values
    if stated is not None and stated != len(found) + len(problems):
        count = len(found) + len(problems)
        problems.append(
            f"{path.name}: {stated} lights by its first line, {count} there"
        )
    lights = np.array(list(found.values())) if found else np.zeros((0, 3))
    return LightList(tuple(found), lights, tuple(problems))


def _decoded(data: bytes) -> str:
    for mark, coding in _MARKS:
        if data.startswith(mark):
            return data[len(mark) :].decode(coding, errors="replace")
    if data[:200].count(b"\0") > len(data[:200]) // 4:  # UTF-16 without a mark
        coding = "utf-16-be" if data[:1] == b"\0" else "utf-16-le"
        return data.decode(coding, errors="replace")
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _read(text: str) -> tuple[str, tuple[float, ...]]:
    """The name and the numbers of a line; none where it cannot be read."""
    text = _AFTER_BLANK.sub(r"\1,", text.rstrip(" \t,;"))
    for count in (3, 2):
        for between, number in _STYLES:
            breaks = [match.span() for match in between.finditer(text)][-count:]
            if len(breaks) < count:
                continue
            ends = [start for start, _ in breaks[1:]] + [len(text)]
            parts = [text[b:e] for (_, b), e in zip(breaks, ends, strict=True)]
            if all(number.fullmatch(part) for part in parts):
                name = text[: breaks[0][0]]
                values = tuple(float(part.replace(",", ".")) for part in parts)
                return _named(name, values)
    return "", ()


def _named(name: str, values: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    if len(name) > _LONGEST:
        return "", ()
    quoted = re.fullmatch(r"""(["'])(.*)\1""", name)
    if quoted:
        name = quoted[2]
    elif re.search(r",[-+\d.]+$", name) or not np.isfinite(values).all():
        return "", ()  # commas both between numbers and in them
    elif _COMMA.fullmatch(name) and not name.isdigit():
        return "", (float(name.replace(",", ".")), *values)
    return re.split(r"[/\\]", name.strip())[-1], values
