"""Estimates, one at a time, in the order in which they were asked for."""

import asyncio
import dataclasses
import time
from pathlib import Path

from unips_jax.app.child import Child, Stopped
from unips_jax.errors import InputError


@dataclasses.dataclass
class Job:
    """An estimate that was asked for.

    Attributes:
        name: of the object.
        target: folder of the results.
        child: does the work.
        state: "waiting", "running", "done", "failed" or "cancelled".
        phase: what is being done.
        share: of the phase, done.
        error: why it failed, one line.
        warnings: about the photographs.
    """

    name: str
    target: Path
    child: Child
    state: str = "waiting"
    phase: str = ""
    share: float = 0.0
    error: str = ""
    warnings: list[str] = dataclasses.field(default_factory=list)
    _since: float = 0.0

    def progress(self, phase: str, share: float) -> None:
        """Takes a report of the work."""
        if phase != self.phase:
            self._since = time.monotonic()
        self.phase, self.share = phase, share

    @property
    def seconds_left(self) -> float | None:
        """Of this phase; None while it cannot be told."""
        passed = time.monotonic() - self._since
        if self.phase != "normals" or self.share < 0.02 or passed < 1:
            return None
        return passed * (1 - self.share) / self.share

    @property
    def over(self) -> bool:
        """Whether nothing more happens."""
        return self.state in ("done", "failed", "cancelled")

    def cancel(self) -> None:
        """Takes it out of the queue, or ends it."""
        if not self.over:
            self.state = "cancelled"
            self.child.stop()


class Queue:
    """All visitors' jobs."""

    def __init__(self) -> None:
        """Nothing waits."""
        self._jobs: list[Job] = []
        self._task: asyncio.Task | None = None

    def add(self, job: Job) -> None:
        """Puts a job at the end."""
        self._jobs.append(job)
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._run())

    def ahead_of(self, job: Job) -> int:
        """How many are done before it."""
        return self._jobs.index(job) if job in self._jobs else 0

    async def _run(self) -> None:
        while self._jobs:
            job = self._jobs[0]
            try:
                await _do(job)
            finally:
                self._jobs.pop(0)

    def stop(self) -> None:
        """Ends all."""
        for job in self._jobs:
            job.cancel()


async def _do(job: Job) -> None:
    if job.over:
        return
    job.state = "running"
    try:
        job.warnings = await job.child.run(job.progress)
        job.state = "done"
    except Stopped:
        job.state = "cancelled"
    except InputError as error:
        if job.state != "cancelled":
            job.state, job.error = "failed", str(error)
