"""Which of an object's files are photographs, which the mask, which set aside."""

import re
from collections import Counter
from pathlib import Path

from unips_jax.app.objects import Object, Photograph
from unips_jax.app.work import Chosen
from unips_jax.io.selection import is_map, series_of

# Reasons that follow from the other photographs.
_TOGETHER = "map size type encoding same unusable black".split()


def use(item: Object, photo: Photograph, wanted: bool) -> None:
    """Uses a file, or sets it aside, as the visitor wants."""
    if not wanted:
        photo.state, photo.why, photo.detail = "aside", "you", ""
    elif photo.why in ("you", "second_mask"):
        for other in item.of_state("mask") if is_mask(photo.name) else []:
            other.state, other.why = "aside", "second_mask"
        photo.state, photo.why = "new", ""
        if photo.facts:
            take(item, photo)
    elif photo.why == "map":
        photo.state = "used"  # and remains a map, by its name
    item.changed()


def take(item: Object, photo: Photograph) -> None:
    """Uses a file: as the mask if it is one by its name and the first."""
    if not is_mask(photo.name):
        photo.state = "used"
    elif item.of_state("mask"):
        photo.state, photo.why = "aside", "second_mask"
    else:
        photo.state = "mask"


def is_mask(name: str) -> bool:
    """Whether a file is a mask by its name: `mask.png`, `cat.mask.png`."""
    return bool(re.fullmatch(r"(.*\.)?mask", Path(name).stem, re.IGNORECASE))


def sort_out(item: Object) -> None:
    """Sets aside what differs from most photographs, which may change with each one."""
    for photo in item.photographs:
        if photo.state == "aside" and photo.why in _TOGETHER:
            if is_mask(photo.name):
                photo.state, photo.why = "aside", "second_mask"
                take(item, photo)
            else:
                photo.state, photo.why = "used", ""
    used = item.of_state("used")
    maps = [photo for photo in used if is_map(photo.name) and photo.why != "map"]
    series: list[Path] = []
    if len(maps) == len(used):  # names decide only between files
        series = series_of([Path(photo.name) for photo in maps])
    for photo in maps:
        if Path(photo.name) not in series:
            photo.state, photo.why = "aside", "map"
    for why, of in (
        ("size", lambda facts: f"{facts['width']} x {facts['height']}"),
        ("type", lambda facts: facts["type"]),
        ("encoding", lambda facts: facts["transfer"]),
    ):
        if why == "encoding" and item.options.get("transfer", "auto") != "auto":
            continue
        used = item.of_state("used")
        counts = Counter(of(photo.facts) for photo in used)
        for photo in used if len(counts) > 1 else []:
            if of(photo.facts) != counts.most_common(1)[0][0]:
                photo.state, photo.why = "aside", why
                photo.detail = of(photo.facts)


def chosen(item: Object) -> Chosen:
    """The files that are used."""
    masks = item.of_state("mask")
    return Chosen(
        item.inbox,
        tuple(photo.file for photo in item.of_state("used")),
        masks[0].file if masks else None,
        tuple(photo.file for photo in item.of_state("aside")),
    )
