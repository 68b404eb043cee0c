"""What is to be evaluated: every method on every object, in every subset of images.

A task's key holds the method with options, the hash of its weights, the protocol, the
images chosen, the object's data, this program's version and the source of what computes
it, so a result of anything else is never taken for it.
"""

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import Benchmark
from unips_jax.evaluation.normal_files import Subset
from unips_jax.evaluation.protocols import Protocol, choose_images, shown_mask
from unips_jax.evaluation.store import result_key
from unips_jax.evaluation.variants import Variant
from unips_jax.io.claims import slug
from unips_jax.io.record import print_line
from unips_jax.provenance import code_hash
from unips_jax.version import __version__

_CODE = ("evaluation.benchmarks", "evaluation.protocols", "evaluation.scores")


class Plan(NamedTuple):
    """What is to be evaluated."""

    benchmark: Benchmark
    variants: Sequence[Variant]
    protocol: Protocol  # how objects are shown
    counts: Sequence[int | None]  # numbers of images; None stands for all
    seeds: Sequence[int]  # of the subsets; each draws its own
    fingerprints: Sequence[str]  # of each entry's data


@dataclasses.dataclass(frozen=True)
class Task:
    """A method, an object and a choice of images."""

    index: int  # the entry's
    variant: Variant
    subset: Subset
    name: str  # of the result in the store
    fields: dict[str, Any]  # what the result depends on


def check_data(benchmark: Benchmark) -> Iterator[str]:
    """Reads every object's files through; yields each entry's fingerprint."""
    for index in range(len(benchmark)):
        yield benchmark.check(index)


def check_counts(benchmark: Benchmark, counts: Sequence[int | None]) -> None:
    """Checks that every object has as many images as are asked for."""
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
        for subset, chosen in subsets_of(plan, index):
            for variant in plan.variants:
                fields = {**variant.key, **shared, "images": chosen.tolist()}
                if variant.files:
                    fields["file"] = variant.files.hash_of(entry.name, subset)
                number = "all" if subset.count is None else str(subset.count)
                label = f"{slug(variant.label)}-{number}-{result_key(fields)}"
                folders = slug(plan.benchmark.name), slug(entry.name)
                name = "/".join((*folders, label))
                tasks.append(Task(index, variant, subset, name, fields))
    return tasks


def subsets_of(plan: Plan, index: int) -> Iterator[tuple[Subset, np.ndarray]]:
    """The subsets in which an object is shown, and their images' places."""
    # Where all images are used there is nothing to draw, and one seed is as any other.
    total = len(plan.benchmark.entries[index].images)
    drawn = [count for count in plan.counts if count is not None]
    alone = len(plan.counts) == 1 and (len(plan.seeds) == 1 or not drawn)
    for count in plan.counts:
        for seed in [None] if count in (None, total) else plan.seeds:
            number = total if count is None else count
            chosen = choose_images(number, total, seed=seed or 0)
            yield Subset(count, seed, alone), chosen


def check_normal_files(plan: Plan) -> None:
    """Reads the normals that other programs made, before any work."""
    for variant in plan.variants:
        if variant.files is None:
            continue
        found = False
        mended: dict[str, list[str]] = {}
        away = []
        for index, entry in enumerate(plan.benchmark.entries):
            subsets = [subset for subset, _ in subsets_of(plan, index)]
            paths = [variant.files.find(entry.name, subset) for subset in subsets]
            if not any(paths):
                continue
            truth = plan.benchmark.truth(entry)
            masks = [truth.mask, shown_mask(truth.mask, plan.protocol)]
            for path in filter(None, paths):
                lines: list[str] = []
                normals, _ = variant.files.read(path, masks, lines)
                found = True
                for line in lines:
                    mended.setdefault(line, []).append(path.name)
                if truth.normals is None and _faces_away(normals):
                    away.append(path.name)
        for line, names in mended.items():
            print_line("normals", f"{variant.label}: {line} ({_counted(names)})")
        if away:  # elsewhere the score shows it
            stated = variant.files.signs[2] < 0
            advice = "leave z=away out" if stated else "files:DIR,z=away says so"
            print(
                f"warning: {variant.label}: z points away from the viewer "
                f"({_counted(away)}); {advice}",
                file=sys.stderr,
            )
        if not found:
            first = plan.benchmark.entries[0].name
            folder = "" if subsets[0].alone else f"{subsets[0].folder}/"
            wanted = folder + (variant.files.file or f"{first}.npy")
            raise InputError(
                f"method {variant.label!r}: expected normals such as {wanted} in "
                f"{variant.files.folder}, found none for any object"
            )


def _faces_away(normals: np.ndarray) -> bool:
    known = normals.any(-1) & np.isfinite(normals).all(-1)
    return bool(known.any()) and float((normals[..., 2][known] < 0).mean()) > 0.95


def _counted(names: Sequence[str]) -> str:
    return f"{names[0]} and {len(names) - 1} more" if names[1:] else names[0]
