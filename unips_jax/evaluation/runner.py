"""Runs every method on every object, once.

A task is a method, an object and a number of images. Its result's key holds the
method with options, the hash of its weights, the protocol, the images chosen, the
object's data, this program's version and the source of what computed it, so a result
of anything else is never taken for it. The order of work is that of the tables;
processes that share a work folder pass over each other's tasks and wait for them at
the end.
"""

import dataclasses
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from unips_jax.baselines.method import Estimated, Unsupported
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import Benchmark, Item
from unips_jax.evaluation.methods import Variant
from unips_jax.evaluation.protocols import Case, Protocol, choose_images, show
from unips_jax.evaluation.scores import Score, best_signs, from_json, score
from unips_jax.evaluation.store import Store, result_key
from unips_jax.io.claims import slug
from unips_jax.provenance import code_hash
from unips_jax.version import __version__

_POLL_S = 0.2
_CODE = ("evaluation.benchmarks", "evaluation.protocols", "evaluation.scores")


class Plan(NamedTuple):
    """What is to be evaluated.

    Attributes:
        benchmark: the data.
        variants: the methods.
        protocol: how objects are shown.
        counts: numbers of images; None stands for all.
        seeds: of the subsets; each draws its own.
        fingerprints: of each entry's data.
    """

    benchmark: Benchmark
    variants: Sequence[Variant]
    protocol: Protocol
    counts: Sequence[int | None]
    seeds: Sequence[int]
    fingerprints: Sequence[str]


@dataclasses.dataclass(frozen=True)
class Task:
    """A method, an object and a choice of images.

    Attributes:
        index: the entry's.
        variant: the method.
        count: number of images; None for all.
        seed: of the subset; None where all images are used.
        name: of the result in the store.
        fields: what the result depends on.
    """

    index: int
    variant: Variant
    count: int | None
    seed: int | None
    name: str
    fields: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Result:
    """A finished task.

    Attributes:
        entry: the object's name.
        tags: the object's tags.
        notes: quirks of its data.
        label: the method's.
        count: number of images asked for; None for all.
        images: number of images used.
        score: None where the truth is withheld or the method could not run.
        measures: the method's own figures, by name.
        unsupported: why the method could not run, empty where it did.
        name: of the result in the store.
        seed: of the subset; None where all images are used.
    """

    entry: str
    tags: Mapping[str, str]
    notes: Sequence[str]
    label: str
    count: int | None
    images: int
    score: Score | None
    measures: Mapping[str, float]
    unsupported: str
    name: str
    seed: int | None = None

    @property
    def reason(self) -> str:
        """Why the method could not run, without the method's name before it."""
        return re.sub(r"^\w+: ", "", self.unsupported)


def check_data(benchmark: Benchmark) -> Iterator[str]:
    """Reads every object's files through.

    Yields:
        Each entry's fingerprint.

    Raises:
        InputError: at the first file that cannot be used.
    """
    for index in range(len(benchmark)):
        yield benchmark.check(index)


def check_counts(benchmark: Benchmark, counts: Sequence[int | None]) -> None:
    """Checks that every object has as many images as are asked for.

    Raises:
        InputError: naming the object that has fewer.
    """
    for count in counts:
        if count is None:
            continue
        if count < 1:
            raise InputError(f"--num-images: expected 1 or more, got {count}")
        for entry in benchmark.entries:
            if len(entry.images) < count:
                raise InputError(
                    f"--num-images {count}: {entry.name} has {len(entry.images)} images"
                )


def tasks_of(plan: Plan) -> list[Task]:
    """All tasks, object by object."""
    code = code_hash(*_CODE)
    tasks = []
    for index, entry in enumerate(plan.benchmark.entries):
        shared = {
            "benchmark": plan.benchmark.name,
            "entry": entry.name,
            "data": plan.fingerprints[index],
            "protocol": plan.protocol.label,
            "crop_focal_ratio": plan.benchmark.crop_focal_ratio,
            "version": __version__,
            "code": code,
        }
        for count, seed in _choices(plan, index):
            images = _chosen(plan, index, count, seed).tolist()
            for variant in plan.variants:
                fields = {**variant.key, **shared, "images": images}
                number = "all" if count is None else str(count)
                label = f"{slug(variant.label)}-{number}-{result_key(fields)}"
                folders = slug(plan.benchmark.name), slug(entry.name)
                name = "/".join((*folders, label))
                tasks.append(Task(index, variant, count, seed, name, fields))
    return tasks


def _choices(plan: Plan, index: int) -> Iterator[tuple[int | None, int | None]]:
    """Numbers of images and seeds; where all are used there is nothing to draw."""
    total = len(plan.benchmark.entries[index].images)
    for count in plan.counts:
        for seed in [None] if count in (None, total) else plan.seeds:
            yield count, seed


def _chosen(plan: Plan, index: int, count: int | None, seed: int | None) -> np.ndarray:
    total = len(plan.benchmark.entries[index].images)
    return choose_images(total if count is None else count, total, seed=seed or 0)


def execute(plan: Plan, tasks: Sequence[Task], store: Store) -> Iterator[Task]:
    """Finishes all tasks, here or in other processes that share the store.

    Yields:
        Each task when its result is there.
    """
    waiting = list(tasks)
    while waiting:
        left: list[Task] = []
        shown: _Shown | None = None
        for task in waiting:
            with store.claim(task.name) as ours:
                if ours and not store.done(task.name):
                    shown = _show(plan, task, shown)
                    _finish(plan, task, shown, store)
                finished = ours
            if finished:
                yield task
            else:
                left.append(task)
        waiting = left
        if waiting:
            time.sleep(_POLL_S)


@dataclasses.dataclass(frozen=True)
class _Shown:
    """The object being worked on, as read and as shown to the methods."""

    task: Task
    item: Item
    case: Case

    def serves(self, task: Task) -> bool:
        ours = self.task
        return (ours.index, ours.count, ours.seed) == (
            task.index,
            task.count,
            task.seed,
        )


def _show(plan: Plan, task: Task, last: _Shown | None) -> _Shown:
    """Prepares the task's object, unless the last task had the same."""
    if last and last.serves(task):
        return last
    same = last is not None and last.task.index == task.index
    item = last.item if last and same else plan.benchmark[task.index]
    case = show(
        item,
        plan.protocol,
        _chosen(plan, task.index, task.count, task.seed),
        crop_focal_ratio=plan.benchmark.crop_focal_ratio,
    )
    return _Shown(task, item, case)


def _finish(plan: Plan, task: Task, shown: _Shown, store: Store) -> None:
    item, case = shown.item, shown.case
    mask = case.observed.mask
    chosen = _chosen(plan, task.index, task.count, task.seed)
    record: dict[str, Any] = {
        "fields": task.fields,
        "entry": item.name,
        "tags": dict(item.tags),
        "notes": list(item.notes),
        "images": [plan.benchmark.entries[task.index].images[i].name for i in chosen],
        "score": None,
        "measures": {},
        "unsupported": "",
    }
    try:
        normals, measures = estimate(task.variant, case)
    except Unsupported as error:
        record["unsupported"] = " ".join(str(error).split())
        store.commit(task.name, record, None)
        return
    record["measures"] = dict(measures)
    if case.normals is not None:
        record["score"] = score(normals, case.normals, mask)._asdict()
    store.commit(task.name, record, np.where(mask[..., None], normals, 0))


def estimate(variant: Variant, case: Case) -> Estimated:
    """Runs a method on a prepared object.

    Returns:
        Normals `[h, w, 3]`, float32, as the method gives them, and its figures.

    Raises:
        Unsupported: if the method lacks something.
        ValueError: if what it gives has another shape.
    """
    if variant.oracle and case.normals is None:
        raise Unsupported("sign=oracle: needs the true normals, which are withheld")
    found = variant.run(case.observed)
    estimated = found if isinstance(found, Estimated) else Estimated(found, {})
    normals = np.asarray(estimated.normals, np.float32)
    mask = case.observed.mask
    if normals.shape != (*mask.shape, 3):
        raise ValueError(
            f"method {variant.label!r}: expected normals of shape "
            f"{(*mask.shape, 3)}, got {normals.shape}"
        )
    if variant.oracle and case.normals is not None:
        normals = best_signs(normals, case.normals, mask)
    return estimated._replace(normals=normals)


def collect(tasks: Sequence[Task], store: Store) -> list[Result]:
    """Reads the results of finished tasks, in their order."""
    results = []
    for task in tasks:
        record = store.load(task.name)
        results.append(
            Result(
                record["entry"],
                record["tags"],
                record["notes"],
                task.variant.label,
                task.count,
                len(record["images"]),
                None if record["score"] is None else from_json(record["score"]),
                record["measures"],
                record["unsupported"],
                task.name,
                task.seed,
            )
        )
    return results
