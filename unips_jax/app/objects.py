"""Objects: each is a folder on disk, which says all that is known of it.

    RESULTS/NAME-DATE/      what `unips estimate` writes
    RESULTS/.app/ID/        object.json, photographs/, pictures/, exports/, drawn.png
    RESULTS/.app/lock       held while a server uses RESULTS

IDs are unguessable: who does not know an object's can't reach it.
"""

import contextlib
import dataclasses
import datetime
import json
import re
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from unips_jax.errors import InputError
from unips_jax.io.claims import claim
from unips_jax.io.door import clear_parts, write_whole
from unips_jax.io.naming import composed, natural_key
from unips_jax.io.results import appearing_at_once, link_or_copy

_FILE = "object.json"
_DEVICE = re.compile("con|prn|aux|nul|(com|lpt)[0-9]", re.IGNORECASE)  # in Windows
OVER = ("done", "failed", "cancelled", "interrupted")


@dataclasses.dataclass
class Photograph:
    """A file of an object."""

    file: str  # its name in `photographs/`
    name: str  # what the visitor calls it
    bytes: int = 0
    state: str = "new"  # or "used", "mask", "aside"
    why: str = ""  # it is set aside, a code; see `strings.json`
    detail: str = ""  # more of that, in a few words
    # size, type and transfer
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class Object:
    """Photographs, and what became of them."""

    id: str  # unguessable; the folder's name
    folder: Path
    name: str = "object"
    state: str = "draft"  # "waiting", "running", or one of `OVER`
    photographs: list[Photograph] = dataclasses.field(default_factory=list)
    mask: str = "auto"  # or "drawn", "whole" (all of the image), "empty"
    mask_version: int = 0  # changes with it
    # in the photographs that are used; see `work.gather`
    found: dict[str, Any] | None = None
    version: int = 0  # changes with the photographs; `found_version` is that of `found`
    found_version: int = -1
    # why the photographs can't be used together: a code of `strings.json`, or one line
    problem: str = ""
    # see `work.Choices`
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    target: str = ""  # the results' folder
    error: str = ""  # why the estimate failed, one line
    findings: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    created: float = 0.0
    asked: float = 0.0
    seconds: float = 0.0
    removed: float = 0.0  # when the visitor did that

    @property
    def inbox(self) -> Path:
        """Folder of the photographs, as they were sent."""
        return self.folder / "photographs"

    @property
    def pictures(self) -> Path:
        """Folder of thumbnails and of the mask that was found."""
        return self.folder / "pictures"

    @property
    def exports(self) -> Path:
        """Folder of files for a purpose, made from the results."""
        return self.folder / "exports"

    @property
    def drawn(self) -> Path:
        """The mask that the visitor drew."""
        return self.folder / "drawn.png"

    def of_state(self, state: str) -> list[Photograph]:
        """The files of a state, in the order of their names."""
        chosen = [photo for photo in self.photographs if photo.state == state]
        return sorted(chosen, key=lambda photo: natural_key(photo.file))

    def named(self, file: str) -> Photograph | None:
        """The file of this name."""
        return next((p for p in self.photographs if p.file == file), None)

    def changed(self) -> None:
        """Notes that other photographs are used now."""
        self.version += 1
        self.problem = ""
        self.save()

    def save(self) -> None:
        record = dataclasses.asdict(self)
        del record["folder"]
        text = json.dumps(record, ensure_ascii=False)
        data = text.encode(errors="backslashreplace")
        write_whole(self.folder / _FILE, data)


class Objects:
    """All objects below a folder of results."""

    def __init__(self, results: Path) -> None:
        """Reads what is there; see `opened`."""
        self.results = results
        self.place = results / ".app"
        self._there: dict[str, Object] = {}
        for folder in sorted(self.place.iterdir()):
            known = _read(folder)
            if known is not None:
                self._there[known.id] = known
                for place in (folder, known.inbox, known.pictures):
                    clear_parts(place)

    def get(self, key: str) -> Object | None:
        """The object of an ID, unless it was removed."""
        found = self._there.get(key)
        return None if found is None or found.removed else found

    def get_removed(self, key: str) -> Object | None:
        """The object of an ID that was removed."""
        found = self._there.get(key)
        return found if found is not None and found.removed else None

    def all(self) -> list[Object]:
        """Those that were not removed, the newest first."""
        there = [item for item in self._there.values() if not item.removed]
        return sorted(there, key=lambda item: -(item.asked or item.created))

    def begin(
        self, name: str = "object", photographs: Mapping[str, bytes] | None = None
    ) -> Object:
        """A new object: all of it is stored, or nothing."""
        with self._new() as item:
            item.name = name
            for file, data in (photographs or {}).items():
                write_whole(item.inbox / file, data, sync=False)
                item.photographs.append(Photograph(file, file, len(data)))
        return item

    def again(self, earlier: Object) -> Object:
        """A new object with an earlier one's photographs, mask and options."""
        kept = "name mask found version found_version problem".split()
        with self._new() as item:
            for part in (earlier.inbox, earlier.pictures):
                shutil.copytree(
                    part,
                    item.folder / part.name,
                    copy_function=link_or_copy,
                    dirs_exist_ok=True,
                )
            if earlier.drawn.exists():
                write_whole(item.drawn, earlier.drawn.read_bytes(), sync=False)
            for name in kept:
                setattr(item, name, getattr(earlier, name))
            item.photographs = [dataclasses.replace(p) for p in earlier.photographs]
            item.options = {**earlier.options}
        return item

    @contextlib.contextmanager
    def _new(self) -> Iterator[Object]:
        """An object that is listed, and in its place, when the block is through."""
        key = secrets.token_urlsafe(18)
        with appearing_at_once(self.place / key, record=_FILE) as folder:
            item = Object(key, folder, created=time.time())
            item.inbox.mkdir()
            item.pictures.mkdir()
            yield item
            item.save()
        item.folder = self.place / key
        self._there[key] = item

    def target_for(self, name: str) -> Path:
        """A new folder of results, NAME-DATE."""
        taken = {item.target for item in self._there.values()}
        today = datetime.date.today().isoformat()
        base = f"{clean(name, longest=60) or 'object'}-{today}"
        for number in range(1, 10_000):
            path = self.results / (base if number == 1 else f"{base}-{number}")
            if str(path) not in taken and not path.exists():
                return path
        raise InputError(f"{base}: expected another name, got one used 10,000 times")

    def clear(self, days: float) -> None:
        """Deletes for good what was removed, or has no estimate, and is that old."""
        limit = time.time() - days * 86_400
        for item in [*self._there.values()]:
            old_draft = item.state == "draft" and _touched(item) < limit
            if 0 < item.removed < limit or old_draft:
                del self._there[item.id]
                shutil.rmtree(item.folder, ignore_errors=True)
        for folder in self.place.iterdir():  # what a killed server left half made
            # Another version's objects, which are not read here, stay.
            half = folder.is_dir() and not (folder / _FILE).exists()
            if half and folder.stat().st_mtime < limit:
                shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def opened(results: Path, *, days: float) -> Iterator[Objects]:
    """The objects below a folder, for as long as the block runs and for us alone.

    Estimates that a killed server had begun are "interrupted". `InputError` if another
    server uses the folder, or it can't be written.
    """
    place = results / ".app"
    try:
        place.mkdir(parents=True, exist_ok=True)
        place.chmod(0o700)
        lock = place / "lock"
        lock.touch()
    except OSError as error:
        raise InputError(
            f"--results {results}: cannot be a folder of results: {error.strerror}; "
            "choose another"
        ) from None
    with claim(lock) as ours:
        if not ours:
            raise InputError(
                f"--results {results}: another `unips app` uses this folder; open its "
                "page, end it, or choose another folder"
            )
        objects = Objects(results)
        objects.clear(days)
        for item in objects.all():
            if item.state == "running":
                item.state = "interrupted"
                item.save()
        yield objects


def clean(name: str, *, longest: int = 100) -> str:
    """A name of letters, digits and `-_.` that any file system takes."""
    name = composed(name.replace("\\", "/").rsplit("/", 1)[-1])
    text = re.sub(r"[^\w.-]+", "_", name).rstrip("._")
    stem, dot, suffix = text.rpartition(".")
    # Of symbols alone nothing would be left; a dot alone before the suffix is no name.
    stem = stem and (stem.strip("._") or "photograph")
    text = f"{stem}{dot}{suffix}" if stem else suffix.strip("._")
    if _DEVICE.fullmatch(text.partition(".")[0]):
        text = f"{text[:3]}_{text[3:]}"
    stem, dot, suffix = text.rpartition(".")
    if not dot or len(suffix) > 8:
        stem, suffix = text, ""
    stem = stem.encode()[: longest - len(suffix) - 1].decode(errors="ignore")
    return f"{stem}{dot}{suffix}" if suffix else stem


def unused(name: str, taken: set[str]) -> str:
    """The name, with a number where others have it already, in whatever case."""
    taken = {other.lower() for other in taken}
    stem, dot, suffix = name.rpartition(".")
    for number in range(2, 10_000):
        if name.lower() not in taken:
            break
        name = f"{stem}-{number}{dot}{suffix}"
    return name


def _read(folder: Path) -> Object | None:
    """An object that was saved; None where none was, or it is damaged."""
    try:
        record = json.loads((folder / _FILE).read_bytes())
        photographs = [
            Photograph(**entry)
            for entry in record.pop("photographs")
            if entry.get("state") != "receiving"  # it never came
        ]
        item = Object(folder=folder, photographs=photographs, **record)
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return item if item.id == folder.name else None


def _touched(item: Object) -> float:
    with contextlib.suppress(OSError):
        return (item.folder / _FILE).stat().st_mtime
    return item.created
