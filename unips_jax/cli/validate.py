"""Scores of weights on held-out scenes: mean angular errors in degrees.

The scenes come from keys that training never uses. A table has a row for all scenes,
one for a constant normal towards the viewer, and one for every kind of light, material,
shape and camera; a column for each number of images.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from unips_jax.console import command, one_of, parse, print_table, start_jax
from unips_jax.errors import InputError
from unips_jax.scenes.config import LIGHT_KINDS, MATERIALS, SHAPE_KINDS, SceneConfig


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips validate`.

    Attributes:
        weights: shipped weights or a .safetensors file.
        scenes: how many scenes.
        images: numbers of images per scene; each is a column.
        size: side of the images in pixels, a multiple of 4.
        light: that all scenes have.
        material: that all scenes have.
        shape: that all scenes have.
        json: print a line of JSON for each number of images instead of the table.
    """

    weights: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "tiny"
    scenes: int = 256
    images: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N [N ...]")] = (8,)
    size: int = 128
    light: Annotated[str | None, one_of(LIGHT_KINDS)] = None
    material: Annotated[str | None, one_of(MATERIALS)] = None
    shape: Annotated[str | None, one_of(SHAPE_KINDS)] = None
    json: bool = False


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips validate`."""
    options = parse(Options, argv, prog="unips validate", description=__doc__)
    if options.size <= 0 or options.size % 4:
        raise InputError(f"--size: expected a multiple of 4, got {options.size}")
    least = min(options.scenes, *options.images, 1 if options.images else 0)
    if least < 1:
        raise InputError(f"--scenes, --images: expected at least 1, got {least}")
    start_jax()
    from unips_jax.training.validation import validate
    from unips_jax.weights import load_weights

    network = load_weights(options.weights)
    kinds = {
        "light_kind": (LIGHT_KINDS, options.light),
        "material": (MATERIALS, options.material),
        "shape": (SHAPE_KINDS, options.shape),
    }
    chosen = {name: all_.index(kind) for name, (all_, kind) in kinds.items() if kind}
    columns: dict[int, dict[str, float]] = {}
    for num_images in dict.fromkeys(options.images):
        scores = validate(
            network,
            SceneConfig(),
            count=options.scenes,
            num_images=num_images,
            size=options.size,
            description=f"{num_images} images",
            **chosen,
        )
        rounded = {name: round(score, 2) for name, score in scores.items()}
        columns[num_images] = rounded
        if options.json:
            print(json.dumps({"images": num_images, **rounded}), flush=True)
    if not options.json:
        _print(options, columns)


def _print(options: Options, columns: dict[int, dict[str, float]]) -> None:
    groups = [name for name in next(iter(columns.values())) if "/" in name]
    rows = {"mae": "all", "constant": "constant normal"}
    rows |= {group: group.replace("/", ": ") for group in groups}
    print_table(
        f"mean angular error in degrees, {options.scenes} held-out scenes of "
        f"{options.size} x {options.size} pixels, weights {options.weights}",
        ["scenes", *(f"{n} image{'s' * (n > 1)}" for n in columns)],
        [
            [shown, *(f"{scores[name]:.2f}" for scores in columns.values())]
            for name, shown in rows.items()
        ],
    )


if __name__ == "__main__":
    sys.exit(main())
