"""Who does what when: photographs are looked at, estimates run one after the other."""

import asyncio
import contextlib
import dataclasses
import time
from collections import Counter
from pathlib import Path
from typing import Any

from unips_jax.app import exports, work
from unips_jax.app.answers import problem_of, reason_of, without_folder
from unips_jax.app.limits import Limits
from unips_jax.app.objects import Object, Objects, Photograph, clean
from unips_jax.app.sorting import chosen, sort_out, take
from unips_jax.app.worker import Worker
from unips_jax.errors import InputError

_SETTLED_S = 0.7  # after an upload, before all photographs are read together
_QUICK = frozenset(".png .jpg .jpeg .bmp .webp .heic .heif .hif .avif".split())


class Progress:
    """Of the estimate that runs."""

    def __init__(self) -> None:
        self.phase, self.share, self._since = "starting", 0.0, time.monotonic()

    def report(self, phase: str, share: float) -> None:
        """Is a `Report`."""
        if phase != self.phase:
            self._since = time.monotonic()
        self.phase, self.share = phase, share

    @property
    def seconds_left(self) -> float | None:
        """Of this phase; None while it isn't known."""
        passed = time.monotonic() - self._since
        if self.phase != "normals" or self.share < 0.02 or passed < 1:
            return None
        return passed * (1 - self.share) / self.share


class Desk:
    """Does what the objects on disk wait for."""

    def __init__(self, objects: Objects, limits: Limits, weights: str) -> None:
        """Estimates that waited when the last server ended go on."""
        self.objects, self.limits, self.weights = objects, limits, weights
        self._looking = Worker(limits.looking_bytes)
        self._gathering = Worker(limits.gathering_bytes)
        self._estimating = Worker(limits.estimating_bytes)
        self._seen: dict[str, float] = {}
        self._received: dict[str, float] = {}
        self.receiving: Counter[str] = Counter()
        self._readings: dict[str, asyncio.Task] = {}
        self.progress = Progress()
        waiting = [item for item in objects.all() if item.state == "waiting"]
        self.queue = sorted(waiting, key=lambda item: item.asked)
        self._estimates: asyncio.Task | None = None
        self._current: asyncio.Task | None = None
        self._warmed: set[asyncio.Task] = set()

    def start(self) -> None:
        """Goes on with what waits."""
        if self.queue and (self._estimates is None or self._estimates.done()):
            self._estimates = asyncio.create_task(self._estimate_all())

    def warm(self, count: int) -> None:
        """Readies the network for a number of photographs, unless it is at work."""
        if self.queue or self._warmed:
            return
        call = self._estimating.call(work.warm, self.weights, count)
        task = asyncio.create_task(call)
        self._warmed.add(task)
        task.add_done_callback(self._warmed.discard)
        task.add_done_callback(lambda t: t.cancelled() or t.exception())

    # Photographs.

    def attend(self, item: Object) -> None:
        """Reads an object's photographs on; its page asks for this again and again."""
        self._seen[item.id] = time.monotonic()
        task = self._readings.get(item.id)
        if item.state == "draft" and (task is None or task.done()) and _unread(item):
            self._readings[item.id] = asyncio.create_task(self._read(item))

    def received(self, item: Object) -> None:
        """Another photograph is there."""
        self._received[item.id] = time.monotonic()
        item.changed()
        self.attend(item)

    async def _read(self, item: Object) -> None:
        while not item.removed and _unread(item):
            if time.monotonic() - self._seen[item.id] > self.limits.left_s:
                return
            new = item.of_state("new")
            since = time.monotonic() - self._received.get(item.id, 0)
            if new:
                await self._look(item, new[0])
            elif self.receiving[item.id] or since < _SETTLED_S:
                await asyncio.sleep(0.1)
            else:
                await self._gather(item)

    async def _look(self, item: Object, photo: Photograph) -> None:
        path = item.inbox / photo.file
        thumbnail = item.pictures / f"{photo.file}.jpg"
        slow = 10 if path.suffix.lower() not in _QUICK else 1
        try:
            facts = await self._looking.call(
                work.look,
                path,
                thumbnail,
                self.limits.pixels,
                seconds=slow * self.limits.looking_s,
            )
        except InputError as error:
            photo.state = "aside"
            photo.why, photo.detail = reason_of(without_folder(str(error), path))
        else:
            wanted = photo.state == "new"  # it may have been left out meanwhile
            if "frames" not in facts:
                photo.facts = facts
                if wanted:
                    take(item, photo)
            elif wanted:
                item.photographs.remove(photo)
                item.photographs += [
                    Photograph(name, name, (item.inbox / name).stat().st_size)
                    for name in facts["frames"]
                ]
                path.unlink(missing_ok=True)
            else:
                for name in facts["frames"]:
                    (item.inbox / name).unlink(missing_ok=True)
        item.changed()

    async def _gather(self, item: Object) -> None:
        sort_out(item)
        version = item.version
        if not item.of_state("used"):
            item.found, item.found_version = None, version
            item.save()
            return
        try:
            found = await self._gathering.call(
                work.gather,
                chosen(item),
                item.pictures,
                {"transfer": item.options.get("transfer", "auto")},
                self.limits.pixels,
                seconds=self.limits.gathering_s,
            )
        except InputError as error:
            if item.version == version:
                item.found, item.found_version = None, version
                text = without_folder(str(error), item.inbox)
                item.problem = problem_of(text)
                item.save()
            return
        if item.version != version:
            return  # others came meanwhile
        for photo in item.photographs:
            if photo.file in found["refused"]:
                photo.state = "aside"
                text = found["refused"][photo.file]
                photo.why, photo.detail = reason_of(text, "unusable")
            elif photo.file in found["same"]:
                photo.state, photo.why = "aside", "same"
        item.found, item.found_version = found, version
        item.save()
        self.warm(len(found["names"]))

    async def cut(self, item: Object, box: tuple[float, ...]) -> None:
        """Puts what is found in a box of the picture into `pictures/cut.png`."""
        await self._gathering.call(
            work.cut,
            item.pictures / "picture.jpg",
            box,
            item.pictures / "cut.png",
            seconds=self.limits.looking_s,
        )

    async def piece(self, item: Object, point: tuple[float, float]) -> None:
        """Puts the drawn mask, changed at a point, into `pictures/cut.png`."""
        try:
            await self._gathering.call(
                work.piece,
                item.pictures / "picture.jpg",
                item.drawn,
                point,
                item.pictures / "cut.png",
                seconds=self.limits.looking_s,
            )
        except InputError as error:
            raise InputError(without_folder(str(error), item.pictures)) from None

    # Estimates.

    def estimate(self, item: Object, name: str, options: work.Choices) -> None:
        """Puts an object at the end of the list, if nothing is missing."""
        if item.state == "draft" and _unread(item):
            raise InputError("the photographs are still being read")
        if item.state != "draft" or item.found is None:
            raise InputError("expected photographs that can be used, got none")
        if item.mask == "empty":
            raise InputError("the mask is empty: draw over the object, or take it all")
        item.name, item.options = name[:100] or "object", dataclasses.asdict(options)
        item.target = str(self.objects.target_for(item.name))
        item.state, item.error, item.asked = "waiting", "", time.time()
        try:
            item.save()
        except InputError:  # of a full disk
            item.state = "draft"
            raise
        self.queue.append(item)
        self.start()

    def cancel(self, item: Object) -> None:
        """Takes an object out of the list, or ends its estimate."""
        if item.state == "waiting":
            self.queue.remove(item)
            item.state = "cancelled"
            item.save()
        elif item.state == "running" and self._current is not None:
            item.state = "cancelled"
            self._current.cancel()

    async def _estimate_all(self) -> None:
        this = asyncio.current_task()
        assert this is not None
        while self.queue:
            item = self.queue[0]
            self._current = asyncio.create_task(self._estimate(item))
            try:
                await self._current
            except asyncio.CancelledError:
                if this.cancelling():  # the server ends, not this estimate alone
                    raise
            with contextlib.suppress(ValueError):
                self.queue.remove(item)

    async def _estimate(self, item: Object) -> None:
        item.state = "running"
        self.progress = Progress()
        began = time.monotonic()
        preview = item.pictures / "preview.png"
        try:
            preview.unlink(missing_ok=True)
            item.save()
            mask: Path | str = {"auto": "auto", "whole": "none"}.get(item.mask, "")
            item.findings = await self._estimating.call(
                work.estimate,
                chosen(item),
                Path(item.target),
                mask or item.drawn,
                preview,
                work.Choices(**item.options),
                self.weights,
                self.limits.pixels,
                report=self.progress.report,
            )
            item.state = "done"
        except asyncio.CancelledError:
            if item.state == "running":  # nobody cancelled it: the server ends
                item.state = "waiting"
            raise
        except InputError as error:
            item.state = "failed"
            item.error = without_folder(str(error), item.inbox)
        finally:
            item.seconds = time.monotonic() - began
            with contextlib.suppress(InputError):  # a full disk: memory has it
                item.save()

    async def make_export(self, item: Object, wanted: exports.Wanted) -> dict[str, Any]:
        """Makes a file for a purpose; see `exports.export`."""
        results = Path(item.target)
        name = clean(item.name, longest=60) or "object"
        try:
            return await self._gathering.call(
                exports.export,
                chosen(item),
                results,
                item.exports,
                name,
                wanted,
                self.limits.pixels,
                seconds=self.limits.gathering_s,
            )
        except InputError as error:
            raise InputError(without_folder(str(error), results)) from None

    async def close(self) -> None:
        """Ends all; what was not done goes on with the next server."""
        tasks = [*self._readings.values(), self._current, self._estimates]
        for task in (*tasks, *self._warmed):
            if task is not None:
                task.cancel()
        for worker in (self._looking, self._gathering, self._estimating):
            worker.close()
        await asyncio.sleep(0)


def _unread(item: Object) -> bool:
    return item.found_version != item.version or bool(item.of_state("new"))
