"""Benchmarks as published, read as they lie on disk."""

import os
from collections.abc import Sequence

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks.base import Benchmark, Entry, Item
from unips_jax.evaluation.benchmarks.diligent import (
    Diligent,
    Diligent102,
    DiligentMV,
    submission_bytes,
)
from unips_jax.evaluation.benchmarks.folder import Folder
from unips_jax.evaluation.benchmarks.luces import Luces
from unips_jax.evaluation.benchmarks.ps_wild import PSWildTest, PSWildTrain
from unips_jax.evaluation.benchmarks.psm_images import PsmImages

__all__ = [
    "BENCHMARKS",
    "Benchmark",
    "Entry",
    "Item",
    "open_benchmark",
    "submission_bytes",
]

_KINDS: list[type[Benchmark]] = [
    PSWildTest,
    PSWildTrain,
    Diligent,
    DiligentMV,
    Diligent102,
    Luces,
    PsmImages,
    Folder,
]
BENCHMARKS = {kind.name: kind for kind in _KINDS}


def open_benchmark(
    name: str, root: str | os.PathLike[str], *, objects: Sequence[str] = ()
) -> Benchmark:
    """Opens one of `BENCHMARKS`, or some objects of it; `InputError` if it can't."""
    if name not in BENCHMARKS:
        raise InputError(f"no benchmark {name!r}; there are {', '.join(BENCHMARKS)}")
    return BENCHMARKS[name](root, objects=objects)
