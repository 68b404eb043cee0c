"""What a training run reports: lines, JSON lines, and sinks such as TensorBoard."""

import contextlib
import json
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from unips_jax.io.door import append_line, write_whole
from unips_jax.training.tracking import Sink, TensorBoard

# The order of metrics in printed lines, which are to fit 100 columns.
_FIRST = ("loss", "mae_deg")
_UNPRINTED = ("grad_norm", "untrained")


def say(text: str) -> None:
    """Prints a line, in the first process only."""
    if jax.process_index() == 0:
        print(text, file=sys.stderr, flush=True)


class TrainLog:
    """Writes `metrics.jsonl` and prints, in the first process only."""

    def __init__(
        self,
        workdir: Path,
        first: int,
        steps: int,
        *,
        every: int = 1,
        pending: list[dict[str, float]] | None = None,
        sink: Sink | None = None,
    ) -> None:
        """Opens the log; lines of steps after `first` are dropped, they come again.

        Lines of metrics are means of `every` steps; `pending` are those before `first`
        that no line holds yet. `sink` also takes metrics and pictures, as TensorBoard
        does where it is installed.
        """
        self._active = jax.process_index() == 0
        self._path = workdir / "metrics.jsonl"
        self._first, self._steps, self._every = first, steps, every
        self._pending: list[Any] = jax.tree.map(np.float32, pending or [])
        self._start, self._untimed = time.monotonic(), 0.0
        self._sinks: list[Sink] = []
        if self._active:
            self._sinks = [] if sink is None else [sink]
            with contextlib.suppress(ImportError):
                self._sinks.append(TensorBoard(workdir, first))
        if self._active and self._path.exists():
            lines = self._path.read_text().splitlines()
            kept = [line for line in lines if _step_of(line) <= first]
            write_whole(self._path, "".join(f"{line}\n" for line in kept).encode())

    @contextlib.contextmanager
    def compiling(self, what: str) -> Iterator[None]:
        """Reports how long `what` compiles; the pace leaves that out."""
        say(f"compiling {what}; it takes a minute or so")
        start = time.monotonic()
        with self.untimed():
            yield
        say(f"compiled in {duration(time.monotonic() - start)}")

    @contextlib.contextmanager
    def untimed(self) -> Iterator[None]:
        """Leaves the time of what is no training step out of the pace."""
        start = time.monotonic()
        yield
        self._untimed += time.monotonic() - start

    def step(self, step: int, metrics: Mapping[str, Any]) -> None:
        """Takes a step's metrics, on the device until needed, and prints means."""
        self._pending.append(metrics)
        if step % self._every == 0:
            means = _means(jax.device_get(self._pending))
            self._pending.clear()
            self.record(step, means)
            self._print(step, means)
        elif step == self._first + 1:
            self._print(step, jax.device_get(metrics))

    def pending(self) -> list[dict[str, float]]:
        """The metrics that no line holds yet, for a checkpoint."""
        return jax.tree.map(float, self._pending)

    def record(self, step: int, values: Mapping[str, Any]) -> None:
        """Writes numbers to `metrics.jsonl` and the sinks."""
        if not self._active:
            return
        numbers = {name: float(value) for name, value in values.items()}
        append_line(self._path, json.dumps({"step": step, **numbers}))
        for sink in self._sinks:
            sink.write_scalars(step, numbers)

    @property
    def shows_pictures(self) -> bool:
        """Whether pictures go anywhere."""
        return bool(self._sinks)

    def pictures(self, step: int, named: Mapping[str, np.ndarray]) -> None:
        """Sends pictures, `[H, W, 3]` uint8, to the sinks."""
        for sink in self._sinks:
            sink.write_images(step, {name: named[name][None] for name in named})

    def _print(self, step: int, values: Mapping[str, Any]) -> None:
        elapsed = time.monotonic() - self._start - self._untimed
        pace = elapsed / (step - self._first)
        left = duration(pace * (self._steps - step))
        names = [name for name in _FIRST if name in values]
        names += sorted(values.keys() - {*_FIRST, *_UNPRINTED})
        shown = "  ".join(f"{name} {values[name]:.3g}" for name in names)
        place = f"step {step:{len(str(self._steps))}}/{self._steps}"
        say(f"{place}  {shown}  {pace:.2g} s/step, {left} left")


def duration(seconds: float) -> str:
    """A duration for people: "40 s", "12 min", "3.5 h", "2.1 days"."""
    for unit, size, digits in (("days", 86400, 1), ("h", 3600, 1), ("min", 60, 0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.{digits}f} {unit}"
    return f"{seconds:.0f} s"


def _means(values: list[dict[str, Any]]) -> dict[str, Any]:
    # Steps on folders have no "lights".
    names = dict.fromkeys(name for value in values for name in value)
    return {
        name: np.mean([value[name] for value in values if name in value])
        for name in names
    }


def _step_of(line: str) -> float:
    """The step of a line; infinite for one whose writing was cut off."""
    try:
        return json.loads(line)["step"]
    except json.JSONDecodeError:
        return float("inf")
