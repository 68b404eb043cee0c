"""Visitors' files: each has a private folder, which is removed when the page closes."""

import asyncio
import re
import secrets
import shutil
import tempfile
from pathlib import Path
from typing import Any

from unips_jax.app.child import Child
from unips_jax.app.jobs import Job
from unips_jax.app.limits import Limits
from unips_jax.errors import InputError
from unips_jax.io.selection import SUFFIXES


class Visitor:
    """One open page: the object at hand and the list of those before.

    Attributes:
        key: unguessable; part of the addresses of the visitor's files.
        object: number of the object at hand.
        jobs: the list, by the object's number.
    """

    def __init__(self, folder: Path, limits: Limits) -> None:
        """Begins with an object without photographs.

        Args:
            folder: for all files; made here.
            limits: bounds.
        """
        folder.mkdir(mode=0o700)
        self.key = folder.name
        self.jobs: dict[int, Job] = {}
        self._folder = folder
        self._limits = limits
        self.object = 0
        self._lock = asyncio.Lock()
        self.begin()

    @property
    def photographs(self) -> Path:
        """Folder of the photographs at hand."""
        return self._folder / str(self.object) / "photographs"

    @property
    def about(self) -> Path:
        """Folder of thumbnails and masks."""
        return self._folder / str(self.object) / "about"

    def begin(self) -> None:
        """Begins another object.

        Raises:
            InputError: if there are too many.
        """
        if self.object >= self._limits.objects:
            raise InputError(
                f"expected at most {self._limits.objects} objects, got one more; save "
                "what you need and open the page anew"
            )
        self.object += 1
        self.photographs.mkdir(parents=True)
        self.about.mkdir()

    def target(self, name: str) -> Path:
        """Folder for the results of the object at hand."""
        return self._folder / str(self.object) / "results" / name

    async def alone(self, child: Child) -> Any:
        """Runs a child; the visitor's children run one after the other.

        Args:
            child: not started.

        Raises:
            InputError: as it does.
            Stopped: likewise.
        """
        async with self._lock:
            return await child.run()

    def place_for(self, name: str, size: int) -> Path:
        """Where an uploaded photograph is stored.

        Args:
            name: what the visitor calls it; only letters, digits and -_. are kept.
            size: in bytes.

        Raises:
            InputError: if it is no image by its name, too large or one too many.
        """
        limits = self._limits
        safe = re.sub(r"[^\w.-]+", "_", Path(name).name)[-100:].lstrip(".")
        if Path(safe).suffix.lower() not in SUFFIXES:
            raise InputError(
                f"{name[:80]}: expected an image, got another kind of file"
            )
        if size > limits.file_bytes:
            raise InputError(
                f"{name[:80]}: expected at most {limits.file_bytes // 10**6} MB, got "
                f"{size // 10**6}; make it smaller"
            )
        place = self.photographs / safe
        there = [path for path in self.photographs.iterdir() if path != place]
        if len(there) >= limits.files:
            raise InputError(
                f"{name[:80]}: expected at most {limits.files} files, got one more"
            )
        total = sum(path.stat().st_size for path in there) + size
        if total > limits.object_bytes:
            raise InputError(
                f"{name[:80]}: expected at most {limits.object_bytes // 10**6} MB in "
                "all photographs, got more; leave some out"
            )
        return place

    def result(self, number: int, name: str) -> Path | None:
        """A file of finished results; None if there is none of that name."""
        job = self.jobs.get(number)
        if job is None or job.state != "done":
            return None
        return next((p for p in job.target.iterdir() if p.name == name), None)

    def close(self) -> None:
        """Ends the visitor's work, and removes all files."""
        for job in self.jobs.values():
            job.cancel()
        shutil.rmtree(self._folder, ignore_errors=True)


class Visitors:
    """All visitors, in one temporary folder."""

    def __init__(self, limits: Limits) -> None:
        """Makes the folder.

        Args:
            limits: bounds.
        """
        self.folder = Path(tempfile.mkdtemp(prefix="unips-app-"))
        self._limits = limits
        self._there: dict[str, Visitor] = {}

    def open(self) -> Visitor:
        """Lets one in.

        Raises:
            InputError: if too many are there.
        """
        if len(self._there) >= self._limits.visitors:
            raise InputError(
                f"{len(self._there)} pages are open, which is as many as may be; close "
                "one, and load this one again"
            )
        visitor = Visitor(self.folder / secrets.token_urlsafe(24), self._limits)
        self._there[visitor.key] = visitor
        return visitor

    def get(self, key: str) -> Visitor | None:
        """The visitor of a key."""
        return self._there.get(key)

    def close(self, visitor: Visitor) -> None:
        """Lets one go; nothing of theirs is left."""
        self._there.pop(visitor.key, None)
        visitor.close()

    def close_all(self) -> None:
        """Removes everything."""
        for visitor in list(self._there.values()):
            self.close(visitor)
        shutil.rmtree(self.folder, ignore_errors=True)
