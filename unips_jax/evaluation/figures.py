"""Every figure of a run, as arrays: what `unips eval` wrote to `tables/figures.csv`.

    figures = unips_jax.load_results("out")
    figures.pick(method="unips", measure="mae_deg").value.mean()
    figures.compare("unips", "woodham", images=10)
    figures.frame()                                     # where pandas is installed

A row is one number of one method on one object, under one lighting and in one view,
from some of its images. Reading needs no JAX.
"""

import csv
import dataclasses
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unips_jax.errors import InputError
from unips_jax.evaluation.statistics import Pair, compare

if TYPE_CHECKING:
    import pandas

COLUMNS = tuple(
    "benchmark object lighting view method images seed measure value".split()
)


@dataclasses.dataclass(frozen=True)
class Figures:
    """Figures as columns `[N]`.

    Attributes:
        benchmark: its name.
        object: the object's.
        lighting: empty where the benchmark has none.
        view: empty where it has none.
        method: the label of the method.
        images: how many were used.
        seed: of the subset; -1 where all images were used.
        measure: what was measured, such as `mae_deg`.
        value: the number.
    """

    benchmark: np.ndarray
    object: np.ndarray
    lighting: np.ndarray
    view: np.ndarray
    method: np.ndarray
    images: np.ndarray
    seed: np.ndarray
    measure: np.ndarray
    value: np.ndarray

    def __len__(self) -> int:
        return len(self.value)

    def pick(self, **wanted: Any) -> "Figures":
        """The rows whose columns have these values, as in `pick(method="unips")`."""
        kept = np.ones(len(self), bool)
        for name, value in wanted.items():
            if name not in COLUMNS:
                raise ValueError(f"expected one of {', '.join(COLUMNS)}, got {name!r}")
            kept &= getattr(self, name) == value
        return Figures(**{name: getattr(self, name)[kept] for name in COLUMNS})

    def compare(
        self, first: str, second: str, *, measure: str = "mae_deg", **wanted: Any
    ) -> Pair:
        """Compares two methods on what both have, object by object; lower is better.

        `wanted` is as in `pick`. Over what is left of an object, such as seeds, the
        mean of what both have is taken. `ValueError` if they share nothing.
        """
        both = [
            self.pick(method=name, measure=measure, **wanted)._by_place()
            for name in (first, second)
        ]
        shared = both[0].keys() & both[1].keys()
        pair = compare(*(_by_object(values, shared) for values in both))
        if pair is None:
            known = ", ".join(dict.fromkeys(self.method))
            raise ValueError(
                f"{first!r} and {second!r} share no {measure}; there are {known}"
            )
        return pair

    def _by_place(self) -> dict[tuple[str, str, int], float]:
        """Values by object, entry (what of it was shown) and seed."""
        shown = zip(self.lighting, self.view, self.images, strict=True)
        entries = [" ".join(map(str, one)) for one in shown]
        places = zip(self.object, entries, self.seed, strict=True)
        return dict(zip(places, self.value, strict=True))

    def frame(self) -> "pandas.DataFrame":
        """The rows as a data frame of pandas, which must be installed."""
        import pandas

        return pandas.DataFrame(dataclasses.asdict(self))


def _by_object(
    values: Mapping[tuple[str, str, int], float], shared: Collection[Any]
) -> dict[str, dict[str, float]]:
    """Means over the seeds that both have, by object and entry."""
    found: dict[str, dict[str, list[float]]] = {}
    for name, entry, seed in sorted(shared):
        own = found.setdefault(str(name), {}).setdefault(entry, [])
        own.append(float(values[name, entry, seed]))
    return {
        name: {entry: sum(own) / len(own) for entry, own in entries.items()}
        for name, entries in found.items()
    }


def load_results(workdir: str | os.PathLike[str]) -> Figures:
    """Reads the figures that `unips eval` wrote into its `--workdir`."""
    path = Path(workdir) / "tables" / "figures.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            names, *rows = csv.reader(file)
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(
            f"{path}: expected what `unips eval --workdir {workdir}` writes ({error})"
        ) from error
    if tuple(names) != COLUMNS:
        raise InputError(f"{path}: expected the columns {', '.join(COLUMNS)}")
    numbers = {"images": int, "seed": int, "value": float}
    try:
        values = list(zip(*rows, strict=True)) or [()] * len(names)
        columns = {
            name: np.array([numbers.get(name, str)(v) for v in column])
            for name, column in zip(names, values, strict=True)
        }
    except ValueError as error:
        raise InputError(
            f"{path}: expected a value in each column of each row, got a damaged file "
            f"({error}); run `unips eval` again"
        ) from error
    return Figures(**columns)
