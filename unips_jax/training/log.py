"""What a training run tells: lines, JSON lines, and TensorBoard if installed."""

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from unips_jax.io.claims import write_whole


def say(text: str) -> None:
    """Prints a line, in the first process only."""
    if jax.process_index() == 0:
        print(text, file=sys.stderr, flush=True)


class TrainLog:
    """Writes `metrics.jsonl` and prints, in the first process only."""

    def __init__(self, workdir: Path, first: int, steps: int) -> None:
        """Opens the log; lines of steps after `first` are dropped, they come again.

        Args:
            workdir: of the run.
            first: steps already done.
            steps: length of the run.
        """
        self._active = jax.process_index() == 0
        self._path = workdir / "metrics.jsonl"
        self._steps, self._last, self._per_step = steps, (first, time.monotonic()), 0.0
        self._tensorboard: Any = _tensorboard(workdir, first) if self._active else None
        if self._active and self._path.exists():
            lines = self._path.read_text().splitlines()
            kept = [line for line in lines if _step_of(line) <= first]
            write_whole(self._path, "".join(f"{line}\n" for line in kept).encode())

    def metrics(self, step: int, values: Mapping[str, Any]) -> None:
        """Records the metrics of a step."""
        if not self._active:
            return
        numbers = {name: float(value) for name, value in values.items()}
        with self._path.open("a") as file:
            file.write(json.dumps({"step": step, **numbers}) + "\n")
        if self._tensorboard is not None:
            for name, value in numbers.items():
                self._tensorboard.add_scalar(name, value, step)
        before, start = self._last
        if step > before:  # the pace since then: early compilations do not count
            self._last = step, time.monotonic()
            self._per_step = (self._last[1] - start) / (step - before)
        minutes = self._per_step * (self._steps - step) / 60
        shown = " ".join(f"{name} {value:.3g}" for name, value in numbers.items())
        say(f"step {step}/{self._steps} ({minutes:.0f} min left) {shown}")

    @property
    def shows_pictures(self) -> bool:
        """Whether pictures go anywhere: to TensorBoard, if installed."""
        return self._tensorboard is not None

    def pictures(self, step: int, named: Mapping[str, np.ndarray]) -> None:
        """Records pictures, `[H, W, 3]` uint8, in TensorBoard."""
        for name, picture in named.items():
            self._tensorboard.add_image(name, picture, step, dataformats="HWC")


def _step_of(line: str) -> float:
    """The step of a line; infinite for one whose writing was cut off."""
    try:
        return json.loads(line)["step"]
    except json.JSONDecodeError:
        return float("inf")


def _tensorboard(workdir: Path, first: int) -> Any:
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(workdir / "tensorboard"), purge_step=first + 1)
