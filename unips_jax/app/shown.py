"""What the page knows of an object, as JSON."""

from pathlib import Path
from typing import Any

from unips_jax.app.desk import Desk
from unips_jax.app.objects import Object

_SHOWN = (
    "version found problem mask mask_version options error findings seconds".split()
)
_SHOWN_OF_PHOTOGRAPHS = "file name state why detail".split()


def short(item: Object) -> dict[str, Any]:
    """For the list of objects."""
    used = item.of_state("used")
    return {
        "id": item.id,
        "name": item.name,
        "state": item.state,
        "time": item.asked or item.created,
        "count": len(used),
        "thumbnail": f"{used[0].file}.jpg" if used and used[0].facts else None,
    }


def whole(item: Object, desk: Desk, *, owner: bool) -> dict[str, Any]:
    """For its own page; the folder on disk is for the owner only."""
    shown = short(item) | {name: getattr(item, name) for name in _SHOWN}
    shown["photographs"] = [
        {name: getattr(photo, name) for name in _SHOWN_OF_PHOTOGRAPHS}
        | {"picture": bool(photo.facts)}
        for photo in item.photographs
    ]
    shown["ready"] = item.found_version == item.version and not item.of_state("new")
    if item.state == "waiting":
        shown["ahead"] = desk.queue.index(item)
    if item.state == "running":
        progress = desk.progress
        shown |= {"phase": progress.phase, "share": progress.share}
        shown["left"] = progress.seconds_left
        shown["preview"] = (item.pictures / "preview.png").exists()
    if item.state == "done":
        shown["results"] = _results(item)
        if owner:
            shown["folder"] = item.target
    return shown


def _results(item: Object) -> list[dict[str, Any]]:
    """The files of the result, by name; empty if they are gone."""
    target = Path(item.target)
    try:
        return [
            {"name": file.name, "bytes": file.stat().st_size}
            for file in sorted(target.iterdir())
            if file.is_file() and not file.name.startswith(".")
        ]
    except OSError:
        return []
