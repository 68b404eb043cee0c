"""Training checkpoints: orbax writes the arrays, checksums guard the files.

A checkpoint is written as `N.partial`. Once all its files are there, its step and their
checksums are added, and one renaming puts it in place, so that a kill at any moment
leaves the earlier ones. The checksums are those of files, not of arrays: nothing
damaged is then parsed, and they do not depend on how devices share the arrays.
"""

import concurrent.futures
import contextlib
import dataclasses
import json
import logging
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import jax
import numpy as np
from jax.experimental import multihost_utils
from orbax.checkpoint import multihost
from orbax.checkpoint import v1 as ocp

from unips_jax.errors import InputError
from unips_jax.io.door import move, write_whole
from unips_jax.models.config_json import to_json
from unips_jax.training.checksums import damage, write_checksums
from unips_jax.training.config import LAST_STEP, Config
from unips_jax.training.log import say
from unips_jax.training.optimizer import make_schedule
from unips_jax.training.safety import any_process

# What may change between the runs of one training: where and how, not what.
_FREE = {
    "model": {"remat"},
    "optim": {"fall_steps"},
    "data": {"root", "workers"},
    "scenes": {"mesh_file"},
    "train": {
        "steps",
        "log_every",
        "checkpoint_every",
        "keep",
        "validate_every",
        "validation_scenes",
        "validation_images",
    },
}
# The file that names a checkpoint's step: its folder's name is not in the checksums.
_STEP = "STEP"
# The system's code, within an error of the library that writes the arrays.
_SYSTEM_ERROR = re.compile(r"os_error_code='(\d+)'")


def changed_fields(saved: dict[str, Any], config: Config) -> dict[str, Any]:
    """What makes a run another than the saved one: saved and given values."""
    # Fields that `saved`, a `Config` as read from JSON, lacks came with a later
    # version: they had their defaults. Fields that only it knows are gone and do not
    # count.
    changed = {}
    for part, free in _FREE.items():
        section = getattr(config, part)
        ours = json.loads(json.dumps(dataclasses.asdict(section)))
        defaults = json.loads(
            json.dumps({f.name: f.default for f in dataclasses.fields(section)})
        )
        before = defaults | saved[part]
        for name in ours.keys() - free:
            if before[name] != ours[name]:
                changed[f"{part}.{name}"] = before[name], ours[name]
    return changed


def _jump(saved: dict[str, Any], config: Config, step: int) -> str:
    """A line where a run of another length has another learning rate at this step."""
    names = {field.name for field in dataclasses.fields(config.optim)}
    known = {k: v for k, v in saved["optim"].items() if k in names}
    before = dataclasses.replace(config.optim, **known)
    rates = [
        float(make_schedule(optim, steps)(step))
        for optim, steps in (
            (before, saved["train"]["steps"]),
            (config.optim, config.train.steps),
        )
    ]
    if abs(rates[0] - rates[1]) <= 0.01 * config.optim.learning_rate:
        return ""
    return (
        f"warning: the learning rate goes from {rates[0]:.2g} to {rates[1]:.2g} here, "
        "as the run's length or its fall was changed; to train finished weights on, "
        "begin a run of its own with --init-weights"
    )


class Checkpoints:
    """The checkpoints of one run."""

    def __init__(self, workdir: Path, config: Config) -> None:
        """Opens a run's folder, made if absent; no other run may be in it.

        Damaged checkpoints newer than the newest intact one are set aside, as
        `checkpoints/N.damaged`, with a line for each; `InputError` if all are damaged.
        """
        self._config = config
        self._path = workdir / "checkpoints"
        self._path.mkdir(parents=True, exist_ok=True)
        self._quiet = contextlib.ExitStack()
        self._writer = concurrent.futures.ThreadPoolExecutor(1)
        self._writing: concurrent.futures.Future[None] | None = None
        step, problem = None, None
        if jax.process_index() == 0:
            try:
                step = self._sort_out()
            except InputError as error:
                problem = error
        # The others wait here, for longer than a collective may last.
        barrier = multihost.unique_barrier_key("checkpoints sorted out")
        multihost.sync_global_processes(barrier, timeout=3600)
        if any_process(problem is not None):
            raise problem or InputError(
                f"{self._path}: process 0 reports what is wrong"
            )
        shared = np.int64(-1 if step is None else step)
        self._latest = int(multihost_utils.broadcast_one_to_all(shared))

    def __enter__(self) -> Self:
        """Silences what the library prints of errors that it also raises."""
        self._quiet.enter_context(_reported_once())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Waits for the write under way; raises its failure, unless one is raised."""
        try:
            with contextlib.suppress(*() if kind is None else (Exception,)):
                self._wait()
        finally:
            self._writer.shutdown()
            self._quiet.close()

    def latest_step(self) -> int | None:
        """The step of the newest intact checkpoint found; None if there was none."""
        return None if self._latest < 0 else self._latest

    def check(self) -> None:
        """Raises what `save` would, if the write under way has already failed."""
        if self._writing is not None and self._writing.done():
            self._wait()

    def save(self, step: int, state: Any, record: dict[str, Any]) -> None:
        """Starts to write a checkpoint; training goes on meanwhile.

        `record` is what else must survive, anything JSON can hold. `InputError` if the
        one before could not be written, as on a full disk.
        """
        self._wait()
        at_once = ocp.Context()  # a folder that cannot be made then fails at once
        at_once.asynchronous.create_directories_asynchronously = False
        with self._failure_named(step), at_once:
            response = ocp.save_checkpointables_async(
                self._path.resolve() / f"{step}.partial",
                {"state": state},
                custom_metadata={
                    "config": to_json(self._config),
                    "record": json.dumps(record),
                },
            )
        self._writing = self._writer.submit(self._complete, step, response)

    def restore(self, abstract_state: Any) -> tuple[Any, dict[str, Any]]:
        """Reads the newest intact checkpoint: the state and the record.

        `abstract_state` has the shapes, types and shardings to read it into.
        `InputError` if the run that wrote it differs in more than its length, rhythm,
        place of the data or memory.
        """
        folder = self._path.resolve() / str(self._latest)
        metadata = ocp.checkpointables_metadata(folder).custom_metadata
        saved = json.loads(metadata["config"])
        changed = changed_fields(saved, self._config)
        if changed:
            raise InputError(
                f"{folder}: this checkpoint was written with another "
                f"configuration (field: saved, given): {changed}; continue with the "
                "saved one, or choose another --workdir and --init-weights"
            )
        try:
            state = ocp.load_checkpointables(folder, {"state": abstract_state})
        except (KeyError, ValueError) as error:  # intact, by its checksums
            raise InputError(
                f"{folder}: expected the parameters of this version's network, got "
                f"others ({str(error):.80}); go on with the version that wrote them, "
                "or choose another --workdir and --init-weights"
            ) from error
        if jump := _jump(saved, self._config, self._latest):
            say(jump)
        return state["state"], json.loads(metadata["record"])

    def _steps(self) -> list[int]:
        names = [path.name for path in self._path.iterdir()]
        return sorted(
            int(name) for name in names if re.fullmatch("0|[1-9][0-9]*", name)
        )

    def _problem(self, step: int) -> str | None:
        """What is wrong with a checkpoint; None if it is as it was written."""
        folder = self._path / str(step)
        if step > LAST_STEP:
            return f"expected a step of at most {LAST_STEP} as its name"
        problem = damage(folder)
        if problem is None and (folder / _STEP).exists():  # versions to 0.3: none
            written = (folder / _STEP).read_text("utf-8").strip()
            if written != str(step):
                return f"it was written at step {written:.20}"
        return problem

    def _sort_out(self) -> int | None:
        """Removes what was not completed, sets aside damage; the step that is left."""
        self._remove_partial()
        damaged: dict[int, str] = {}
        for step in reversed(self._steps()):
            problem = self._problem(step)
            if problem is None:
                break
            damaged[step] = problem
        else:
            if damaged:  # left where they are: training anew must be the user's wish
                found = "; ".join(f"{step}: {damaged[step]}" for step in damaged)
                raise InputError(
                    f"{self._path}: expected an intact checkpoint, got none ({found}); "
                    "put a copy back, or choose another --workdir"
                )
            return None
        for number, problem in damaged.items():
            aside = self._path / f"{number}.damaged"
            shutil.rmtree(aside, ignore_errors=True)
            move(self._path / str(number), aside)
            say(
                f"checkpoint {number} is damaged ({problem}): set aside as {aside}, "
                f"going on from checkpoint {step}"
            )
        return step

    def _complete(self, step: int, response: ocp.AsyncResponse[None]) -> None:
        """Awaits the files, adds checksums, puts all in place, removes old ones."""
        with self._failure_named(step):
            response.result()
            if jax.process_index() > 0:
                return
            partial = self._path / f"{step}.partial"
            write_whole(partial / _STEP, f"{step}\n".encode())
            write_checksums(partial)
            move(partial, self._path / str(step))
            for old in self._steps()[: -self._config.train.keep]:
                shutil.rmtree(self._path / str(old))

    @contextlib.contextmanager
    def _failure_named(self, step: int) -> Iterator[None]:
        """Names the checkpoint where the system refuses to write it."""
        try:
            yield
        except Exception as error:
            time.sleep(0.5)  # other writes may be failing still
            if jax.process_index() == 0:
                self._remove_partial()
            code = getattr(error, "errno", None)
            if found := _SYSTEM_ERROR.search(str(error)):
                code = int(found[1])
            if code is None:
                raise
            raise InputError(
                f"{self._path / str(step)}: expected a place where the checkpoint can "
                f"be written, got: {os.strerror(code)}; mend that, the same command "
                "then goes on from the checkpoint before"
            ) from None

    def _remove_partial(self) -> None:
        for path in self._path.glob("*.partial*"):
            shutil.rmtree(path, ignore_errors=True)

    def _wait(self) -> None:
        writing, self._writing = self._writing, None
        if writing is not None:
            writing.result()


@contextlib.contextmanager
def _reported_once() -> Iterator[None]:
    """Silences what orbax prints of errors that it also raises: pages of tracebacks."""

    def is_news(record: logging.LogRecord) -> bool:
        return not (record.exc_info and record.levelno >= logging.ERROR)

    def hook(what: Any) -> None:
        if "Event loop is closed" not in str(what.exc_value):  # nobody waits any more
            before(what)

    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    before = sys.unraisablehook
    sys.unraisablehook = hook
    for logger in loggers:
        logger.addFilter(is_news)
    try:
        yield
    finally:
        sys.unraisablehook = before
        for logger in loggers:
            logger.removeFilter(is_news)
