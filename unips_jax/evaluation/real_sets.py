"""A yardstick for weights that is real: photographs, and borders as cameras see them.

    python -m unips_jax.evaluation.real_sets --weights tiny runs/a/last.safetensors

Scenes from the distribution that trained a network say little of how it does on
photographs: weights are chosen by these sets, on none of which is ever trained.

- DiLiGenT's objects that are there, 10 images and all; native protocol, as in
  `unips eval`.
- A folder of photographs under known lamps, without truth: mean angle to least squares
  with these lamps, to which its highlights and shadows add some degrees for any method.
- Spheres with mixed borders (`spheres`) under masks too small and too large; the error
  is that of pixels well inside, the same ones for all masks.
- The same masks on DiLiGenT's objects, with 10 images.
- Folders that `unips render` wrote.

Sets that are absent are skipped with a line. A constant normal stands beside.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.baselines.calibrated import woodham
from unips_jax.baselines.method import Estimated, Lights
from unips_jax.command import InputError, command, keep_compiled
from unips_jax.evaluation import spheres
from unips_jax.evaluation.benchmarks import files
from unips_jax.evaluation.benchmarks.diligent import Diligent
from unips_jax.evaluation.benchmarks.ps_wild import PSWildTest
from unips_jax.evaluation.protocols import Case, Protocol, choose_images, show
from unips_jax.evaluation.scores import error_map
from unips_jax.photos import read_photographs, select

OFFSETS = (-2, -1, 0, 1, 2, 5)
_INNER = 4  # pixels inside the border: what masks 2 px too small leave, and two more
_SHARED = Path("../shared")

Estimate = Callable[[np.ndarray, np.ndarray], np.ndarray]


class RealCase(NamedTuple):
    """One set of photographs, and where its estimate is compared with what.

    Attributes:
        group: what it is averaged with.
        name: of the object.
        images: `[N, H, W, 3]`, linear.
        mask: `[H, W]`, bool: what the network is told.
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

    Distances are Euclidean; pixels beside the border are 1 from the other side.

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
            inner = wrong_mask(case.mask, -_INNER)
            for offset in offsets:
                wrong = case._replace(mask=wrong_mask(case.mask, offset))
                group = f"diligent, mask {offset:+d} px"
                yield _truly(group, item.name, wrong)._replace(scored=inner)


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
    selection = select(folder)
    images, mask = read_photographs(selection)
    tables = sorted(folder.glob("light_directions*.txt"))
    if not tables:
        raise InputError(f"{folder}: expected light_directions*.txt, found none")
    directions = files.read_numbers(tables[0], len(images), "lights, a column each").T
    lights = Lights(directions, np.ones((len(images), 3)))
    linear = images.astype(np.float32) / np.iinfo(images.dtype).max
    normals = woodham()(linear, mask, lights=lights)
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


def table(found: dict[str, dict[str, dict[str, float]]]) -> str:
    """Rows of groups, each followed by its objects, a column for each method."""
    methods = list(next(iter(next(iter(found.values())).values())))
    width = max(len(n) + 2 for g, rows in found.items() for n in (g, *rows))
    lines = [" " * width + "".join(f"{m[-16:]:>18}" for m in methods)]
    for group, rows in sorted(found.items(), key=lambda item: _natural(item[0])):
        mean = [sum(row[m] for row in rows.values()) / len(rows) for m in methods]
        named = [(group, mean)]
        if len(rows) > 1:
            named += [(f"  {n}", list(row.values())) for n, row in rows.items()]
        for name, values in named:
            cells = "".join(f"{value:18.2f}" for value in values)
            lines.append(f"{name:{width}}{cells}")
    return "\n".join(lines)


def _natural(group: str) -> tuple[str, float]:
    text, _, offset = group.partition(" mask ")
    return text, float(offset.removesuffix(" px") or -99)


def _shown(item, protocol, count) -> Case:  # type: ignore[no-untyped-def]
    total = len(item.images)
    chosen = choose_images(count or total, total, seed=0)
    return show(item, Protocol(protocol), chosen, crop_focal_ratio=1.0)


def _truly(group: str, name: str, case: Case) -> RealCase:
    if case.normals is None:
        raise InputError(f"{name}: expected true normals, found none")
    return RealCase(group, name, case.images, case.mask, case.normals, case.mask)


def unips(source: str) -> Estimate:
    """The network with some weights, a shipped name or a file."""
    from unips_jax.streaming import estimate_photographs
    from unips_jax.weights import load_weights

    config, params = load_weights(source)
    return lambda images, mask: estimate_photographs(
        params, images, mask, config=config
    )


def real_cases(
    *,
    diligent: Path,
    lamps: Path,
    ps_wild: Sequence[Path],
    counts: Sequence[int | None],
    offsets: Sequence[int],
) -> Iterator[RealCase]:
    """All sets; prints a line for each that is absent."""
    if offsets:
        yield from sphere_cases(offsets)
    if diligent.is_dir():
        yield from diligent_cases(diligent, counts, offsets)
    if lamps.is_dir():
        yield from lamp_cases(lamps)
    for root in filter(Path.is_dir, ps_wild):
        yield from ps_wild_cases(root)
    for path in (diligent, lamps, *ps_wild):
        if not path.is_dir():
            print(f"skipped {path}: no such folder")


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--weights", nargs="+", default=["tiny"], help="names or files")
    parser.add_argument("--diligent", type=Path, default=_SHARED / "diligent_dev")
    parser.add_argument(
        "--lamps", type=Path, default=_SHARED / "photos" / "psbox_cat.data"
    )
    parser.add_argument("--ps-wild", type=Path, nargs="*", default=[])
    parser.add_argument(
        "--num-images", nargs="+", default=["10", "all"], help="of DiLiGenT's objects"
    )
    parser.add_argument(
        "--offsets", type=int, nargs="*", default=list(OFFSETS), help="of masks, pixels"
    )
    arguments = parser.parse_args(argv)
    keep_compiled()
    estimates = {source: unips(source) for source in arguments.weights}
    found = score_all(
        real_cases(
            diligent=arguments.diligent,
            lamps=arguments.lamps,
            ps_wild=arguments.ps_wild,
            counts=[None if n == "all" else int(n) for n in arguments.num_images],
            offsets=arguments.offsets,
        ),
        {**estimates, "constant": constant_normal},
    )
    if not found:
        raise InputError("no set of photographs was found; give --diligent or --lamps")
    print(table(found))


if __name__ == "__main__":
    raise SystemExit(main())
