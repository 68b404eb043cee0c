"""A yardstick for weights that is real: photographs, and borders as cameras see them.

    python tools/real_sets.py --weights tiny runs/a/last.safetensors

Scenes from the distribution that trained a network say little of how it does on
photographs: weights are chosen by these sets, on none of which is ever trained. A row
for each set and object, a column for each of the weights.

- DiLiGenT's objects that are there, 10 images and all; native protocol, as in
  `unips eval`.
- A folder of photographs under known lamps, without truth: mean angle to least squares
  with these lamps, to which its highlights and shadows add some degrees for any method.
- Spheres with mixed borders (`spheres`) under masks too small and too large; the error
  is that of pixels well inside, the same ones for all masks.
- The same masks on DiLiGenT's objects, with 10 images.
- Folders that `unips render` wrote.

Sets that are absent are skipped with a line. The last column is a constant normal's.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
import spheres

from unips_jax.baselines.calibrated import woodham
from unips_jax.baselines.method import Estimated, Lights, Observed
from unips_jax.console import command, print_table, start_jax
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.benchmarks.base import Item
from unips_jax.evaluation.benchmarks.diligent import Diligent
from unips_jax.evaluation.benchmarks.ps_wild import PSWildTest
from unips_jax.evaluation.protocols import Case, Protocol, choose_images, show
from unips_jax.evaluation.scores import error_map
from unips_jax.io.color import as_linear
from unips_jax.io.photographs import read_photographs

OFFSETS = (-2, -1, 0, 1, 2, 5)
_INNER = 4  # pixels inside the border: what masks 2 px too small leave, and two more

Estimate = Callable[[np.ndarray, np.ndarray], np.ndarray]


class RealCase(NamedTuple):
    """One set of photographs, and where its estimate is compared with what.

    Attributes:
        group: what it is averaged with.
        name: of the object.
        images: `[N, H, W, 3]`, linear.
        mask: `[H, W]`, bool: the one that methods are given.
        normals: `[H, W, 3]`, the truth.
        scored: `[H, W]`, bool.
    """

    group: str
    name: str
    images: np.ndarray
    mask: np.ndarray
    normals: np.ndarray
    scored: np.ndarray


def wrong_mask(mask: np.ndarray, offset: float) -> np.ndarray:
    """A mask that is some pixels too large, or too small where negative.

    Distances are Euclidean; pixels at the border are 1 from the other side.

    Args:
        mask: `[H, W]`, bool.
        offset: in pixels.
    """
    side = mask if offset < 0 else ~mask
    padded = np.pad(side.astype(np.uint8), 1, mode="edge")
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance = distance[1:-1, 1:-1]
    return distance > -offset if offset < 0 else mask | (distance <= offset)


def sphere_cases(offsets: Sequence[float] = OFFSETS) -> Iterator[RealCase]:
    """The spheres under every mask."""
    depth, normals = spheres.depth_inside(), spheres.sphere_normals()
    for name, look in spheres.LOOKS.items():
        images = spheres.photograph_sphere(look)
        for offset in offsets:
            group = f"spheres, mask {offset:+d} px"
            mask = depth > -offset
            yield RealCase(group, name, images, mask, normals, depth > _INNER)


def diligent_cases(
    root: Path, counts: Sequence[int | None] = (10, None), offsets: Sequence[int] = ()
) -> Iterator[RealCase]:
    """DiLiGenT's objects that are there.

    Args:
        root: holds some of `ballPNG` and so on, or `pmsData` with them.
        counts: numbers of images, chosen as by `unips eval`; None: all.
        offsets: also with masks so wrong, with the first of the counts.
    """
    below = root / "pmsData" if (root / "pmsData").is_dir() else root
    names = sorted(p.name.removesuffix("PNG") for p in below.glob("*PNG"))
    benchmark = Diligent(root, objects=names)
    for item in (benchmark[i] for i in range(len(benchmark))):
        for count in counts:
            case = _shown(item, "native", count)
            label = "all" if count is None else f"{count} images"
            yield _truly(f"diligent, {label}", item.name, case)
            if count != counts[0]:
                continue
            mask = case.observed.mask
            for offset in offsets:
                group = f"diligent, mask {offset:+d} px"
                yield _truly(group, item.name, case)._replace(
                    mask=wrong_mask(mask, offset), scored=wrong_mask(mask, -_INNER)
                )


def ps_wild_cases(root: Path) -> Iterator[RealCase]:
    """Objects of a folder that `unips render` wrote, by lighting."""
    benchmark = PSWildTest(root)
    for item in (benchmark[i] for i in range(len(benchmark))):
        group = f"{root.name}, {item.tags.get('lighting', 'any light')}"
        yield _truly(group, item.name, _shown(item, "crop", None))


def lamp_cases(folder: Path) -> Iterator[RealCase]:
    """Photographs under known lamps, against least squares.

    Args:
        folder: photographs, linear, their mask, and `light_directions*.txt`: three
            lines (x, y, z) of one column per image.
    """
    images, mask, _ = read_photographs(folder)
    tables = sorted(folder.glob("light_directions*.txt"))
    if not tables:
        raise InputError(f"{folder}: expected light_directions*.txt, found none")
    directions = files.read_numbers(tables[0], len(images), "lights, a column each").T
    lights = Lights(directions, np.ones((len(images), 3)))
    linear = as_linear(images, "linear")
    normals = woodham()(Observed(linear, mask, lights))
    if isinstance(normals, Estimated):
        normals = normals.normals
    name = folder.name.removesuffix(".data")
    yield RealCase("least squares, known lamps", name, linear, mask, normals, mask)


def score(case: RealCase, normals: np.ndarray) -> float:
    """Mean angular error in degrees."""
    return float(error_map(normals, case.normals)[case.scored].mean())


def score_all(
    cases: Iterator[RealCase], estimates: dict[str, Estimate]
) -> dict[str, dict[str, dict[str, float]]]:
    """Errors by group, object and method."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for case in cases:
        row = found.setdefault(case.group, {}).setdefault(case.name, {})
        for method, estimate in estimates.items():
            row[method] = score(case, estimate(case.images, case.mask))
    return found


def constant_normal(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The normal towards the viewer: the floor."""
    return mask[..., None] * np.array([0, 0, 1], np.float32)


def table_rows(
    found: dict[str, dict[str, dict[str, float]]],
) -> list[tuple[str, list[float]]]:
    """Groups with their means, each followed by its objects: names and figures."""
    table = []
    for group, rows in sorted(found.items(), key=lambda item: _natural(item[0])):
        figures = [list(row.values()) for row in rows.values()]
        table.append((group, np.mean(figures, axis=0).tolist()))
        if len(rows) > 1:
            table += [(f"  {n}", row) for n, row in zip(rows, figures, strict=True)]
    return table


def _natural(group: str) -> tuple[str, float]:
    text, _, offset = group.partition(" mask ")
    return text, float(offset.removesuffix(" px") or -99)


def _shown(item: Item, protocol: Literal["crop", "native"], count: int | None) -> Case:
    total = len(item.images)
    chosen = choose_images(count or total, total, seed=0)
    return show(item, Protocol(protocol), chosen, crop_focal_ratio=1.0)


def _truly(group: str, name: str, case: Case) -> RealCase:
    if case.normals is None:
        raise InputError(f"{name}: expected true normals, found none")
    images, mask = case.observed.images, case.observed.mask
    return RealCase(group, name, images, mask, case.normals, mask)


def unips(source: str) -> Estimate:
    """The network with some weights, a shipped name or a file."""
    from unips_jax.estimation.streaming import estimate_photographs
    from unips_jax.weights import load_weights

    network = load_weights(source)
    return lambda images, mask: estimate_photographs(network, images, mask)


def real_cases(root: Path, ps_wild: Sequence[Path]) -> Iterator[RealCase]:
    """All sets; prints a line for each that is absent.

    Args:
        root: holds `diligent_dev` and `photos/psbox_cat.data`.
        ps_wild: folders that `unips render` wrote.
    """
    yield from sphere_cases()
    sets: list[tuple[Path, Callable[[Path], Iterator[RealCase]]]] = [
        (root / "diligent_dev", lambda path: diligent_cases(path, offsets=OFFSETS)),
        (root / "photos" / "psbox_cat.data", lamp_cases),
        *((path, ps_wild_cases) for path in ps_wild),
    ]
    for path, cases in sets:
        if path.is_dir():
            yield from cases(path)
        else:
            print(f"skipped {path}: no such folder", file=sys.stderr)


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Parses the command line, scores, and prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--photographs", type=Path, default=Path("../shared"), metavar="DIR")
    add("--weights", nargs="+", default=["tiny"], help="shipped names or files (tiny)")
    add("--ps-wild", nargs="*", type=Path, default=[], help="from `unips render`")
    add("--json", action="store_true", help="JSON instead of the table")
    arguments = parser.parse_args(argv)
    start_jax()
    estimates = {source: unips(source) for source in arguments.weights}
    found = score_all(
        real_cases(arguments.photographs, arguments.ps_wild),
        {**estimates, "constant normal": constant_normal},
    )
    if arguments.json:
        return print(json.dumps(found))
    names = [Path(source).name for source in arguments.weights]
    print_table(
        "mean angular error in degrees, photographs and wrong masks",
        ["set", *names, "constant normal"],
        [[name, *(f"{x:.2f}" for x in row)] for name, row in table_rows(found)],
    )


if __name__ == "__main__":
    raise SystemExit(main())
