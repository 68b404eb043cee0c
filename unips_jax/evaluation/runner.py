"""Runs every method on every object, once, in the order of the tables.

Processes that share a work folder pass over each other's tasks and wait for them at the
end.
"""

import copy
import dataclasses
import math
import re
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.baselines.method import Estimated, Unsupported
from unips_jax.errors import InputError
from unips_jax.evaluation.axes import errors_if_turned
from unips_jax.evaluation.benchmarks import Item
from unips_jax.evaluation.plan import Plan, Task, subsets_of
from unips_jax.evaluation.protocols import Case, show, shown_normals, unit_length
from unips_jax.evaluation.scores import NAMES, Score, best_signs, from_json, score
from unips_jax.evaluation.store import Store
from unips_jax.evaluation.variants import Variant
from unips_jax.io.door import NotWritten
from unips_jax.io.normal_axes import integrability

_POLL_S = 0.2


@dataclasses.dataclass(frozen=True)
class Result:
    """A finished task."""

    entry: str  # the object's name
    tags: Mapping[str, str]
    notes: Sequence[str]  # quirks of its data
    label: str
    count: int | None  # of images asked for; None for all
    images: int  # how many were used
    score: Score | None  # None where the truth is withheld or the method could not run
    measures: Mapping[str, float]  # the method's own figures, by name
    unsupported: str  # why the method could not run, empty where it did
    name: str  # of the result in the store
    seed: int | None = None  # of the subset; None where all images are used
    # of methods that are not ours: mean errors with their axes turned
    turned: Mapping[str, float] = dataclasses.field(default_factory=dict)
    # of these where the truth is withheld; see `io.normal_axes`
    integrability: float = 0.0
    failed: bool = False  # with what is then in `unsupported`; nothing is stored

    @property
    def reason(self) -> str:
        """Why the method could not run, without the method's name before it."""
        return re.sub(r"^\w+: ", "", self.unsupported)


def execute(
    plan: Plan, tasks: Sequence[Task], store: Store, failed: dict[str, str]
) -> Iterator[Task]:
    """Finishes all tasks, here or in other processes; yields each when it is done.

    Where a method that is not ours raises anything but `Unsupported`, the reason stands
    in `failed`, by the task's name; nothing of it is stored.
    """
    waiting = list(tasks)
    while waiting:
        left: list[Task] = []
        shown: _Shown | None = None
        for task in waiting:
            with store.claim(task.name) as ours:
                if ours and not store.done(task.name):
                    shown = _show(plan, task, shown)
                    try:
                        _finish(plan, task, shown, store)
                    except Exception as error:
                        if not task.variant.foreign or isinstance(error, NotWritten):
                            raise
                        failed[task.name] = _reason(error)
                finished = ours
            if finished:
                yield task
            else:
                left.append(task)
        waiting = left
        if waiting:
            time.sleep(_POLL_S)


def _reason(error: Exception) -> str:
    """An exception of a method that is not ours, with its place, as one line."""
    text = " ".join(str(error).split())
    if isinstance(error, InputError):
        return text
    place = traceback.extract_tb(error.__traceback__)[-1]
    named = f"{type(error).__name__}: {text}" if text else type(error).__name__
    return f"{named} ({Path(place.filename).name}, line {place.lineno})"


@dataclasses.dataclass(frozen=True)
class _Shown:
    """The object being worked on, as read and as shown to the methods."""

    task: Task
    item: Item
    case: Case

    def serves(self, task: Task) -> bool:
        return (self.task.index, self.task.subset) == (task.index, task.subset)


def _show(plan: Plan, task: Task, last: _Shown | None) -> _Shown:
    """Prepares the task's object, unless the last task had the same."""
    if last and last.serves(task):
        return last
    same = last is not None and last.task.index == task.index
    item = last.item if last and same else plan.benchmark[task.index]
    case = show(
        item,
        plan.protocol,
        _images(plan, task),
        crop_focal_ratio=plan.benchmark.crop_focal_ratio,
    )
    return _Shown(task, item, case)


def _images(plan: Plan, task: Task) -> np.ndarray:
    """Places of the task's images."""
    subsets = subsets_of(plan, task.index)
    return next(chosen for subset, chosen in subsets if subset == task.subset)


def _finish(plan: Plan, task: Task, shown: _Shown, store: Store) -> None:
    item, case = shown.item, shown.case
    mask = case.observed.mask
    photographs = plan.benchmark.entries[task.index].images
    record: dict[str, Any] = {
        "fields": task.fields,
        "entry": item.name,
        "tags": dict(item.tags),
        "notes": list(item.notes),
        "images": [photographs[i].name for i in _images(plan, task)],
        "score": None,
        "measures": {},
        "unsupported": "",
    }
    variant = task.variant
    if variant.files:

        def crop(normals: np.ndarray) -> np.ndarray:
            return shown_normals(normals, item.mask, plan.protocol)

        variant = variant._replace(
            run=variant.files.method(item.name, task.subset, item.mask, crop)
        )
    try:
        normals, measures = estimate(variant, case)
    except Unsupported as error:
        reason = " ".join(str(error).split())
        record["unsupported"] = reason or "the method gave no reason"
        store.commit(task.name, record, None)
        return
    record["measures"] = _numbers(variant, measures)
    if case.normals is not None:
        record["score"] = score(normals, case.normals, mask)._asdict()
        if variant.foreign and not variant.oracle:
            files = variant.files
            stated = [(files.signs, files.order)] if files else []
            record["turned"] = errors_if_turned(normals, case.normals, mask, *stated)
    elif variant.foreign:
        surface = np.where(mask[..., None], normals, 0)
        record["integrability"] = integrability(surface)
    store.commit(task.name, record, unit_length(np.where(mask[..., None], normals, 0)))


def _numbers(variant: Variant, measures: Mapping[str, Any]) -> dict[str, float]:
    """A method's figures as JSON has them, without those that are not finite."""
    try:
        found = {str(name): float(value) for name, value in dict(measures).items()}
    except (TypeError, ValueError):
        if not variant.foreign:
            raise
        raise InputError(
            f"method {variant.label!r}: expected figures that are numbers, got "
            f"{measures!r:.100}"
        ) from None
    taken = [name for name in found if name in NAMES]
    if taken:
        raise InputError(
            f"method {variant.label!r}: expected figures of other names than the "
            f"scores', got {taken[0]}; rename it"
        )
    return {name: value for name, value in found.items() if math.isfinite(value)}


def estimate(variant: Variant, case: Case) -> Estimated:
    """Runs a method: normals `[h, w, 3]`, float32, and its figures."""
    if variant.oracle and case.normals is None:
        raise Unsupported("sign=oracle: needs the true normals, which are withheld")
    observed = case.observed
    if variant.foreign and not variant.files:  # which may write into what it is given
        observed = copy.deepcopy(observed)
    found = variant.run(observed)
    estimated = found if isinstance(found, Estimated) else Estimated(found, {})
    try:
        normals = np.asarray(estimated.normals, np.float32)
    except (TypeError, ValueError):
        if not variant.foreign:
            raise
        raise InputError(
            f"method {variant.label!r}: expected normals, an array of numbers, got "
            f"{type(estimated.normals).__name__}"
        ) from None
    mask = case.observed.mask
    if normals.shape != (*mask.shape, 3):
        kind = InputError if variant.foreign else ValueError  # which is a bug of ours
        raise kind(
            f"method {variant.label!r}: expected normals of shape "
            f"{(*mask.shape, 3)}, got {normals.shape}"
        )
    if variant.oracle and case.normals is not None:
        normals = best_signs(normals, case.normals, mask)
    return estimated._replace(normals=normals)


def collect(
    plan: Plan, tasks: Sequence[Task], store: Store, failed: Mapping[str, str]
) -> list[Result]:
    """Reads the results of finished tasks, in their order."""
    results = []
    for task in tasks:
        if task.name in failed:
            results.append(_failure(plan, task, failed[task.name]))
            continue
        record = store.load(task.name)
        results.append(
            Result(
                record["entry"],
                record["tags"],
                record["notes"],
                task.variant.label,
                task.subset.count,
                len(record["images"]),
                None if record["score"] is None else from_json(record["score"]),
                record["measures"],
                record["unsupported"],
                task.name,
                task.subset.seed,
                record.get("turned", {}),
                record.get("integrability", 0.0),
            )
        )
    return results


def _failure(plan: Plan, task: Task, reason: str) -> Result:
    """What stands in the tables for a result that is missing."""
    entry = plan.benchmark.entries[task.index]
    return Result(
        entry.name,
        entry.tags,
        entry.notes,
        task.variant.label,
        task.subset.count,
        len(_images(plan, task)),
        None,
        {},
        f"failed: {reason}",
        task.name,
        task.subset.seed,
        failed=True,
    )
