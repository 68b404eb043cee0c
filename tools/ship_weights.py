"""Writes trained weights as a file to release, if they are better than the shipped.

    python tools/ship_weights.py runs/tiny/last.safetensors

Scores them, in the half precision they ship in, next to the shipped ones on the same
held-out scenes, and writes `dist/tiny-HASH.safetensors` if the error with the most
images is smaller. With `--average` the mean of both takes the place of the trained
ones: two ends of runs whose learning rate fell to zero lie around a better point. The
file's record counts the steps of all runs, each begun with `--init-weights tiny`.

The file is an asset of a release (docs/releasing.md). With `--install` it also becomes
the one that the wheel carries: once per release, since every file that was ever
committed stays in every clone. Then `python tools/results.py --measure` measures its
figures and writes them down.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import jax

from unips_jax.console import cache_compilations, command
from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.io.door import write_whole
from unips_jax.scenes import SceneConfig
from unips_jax.training.validation import validate
from unips_jax.weights import (
    load_weights,
    save_weights,
    weights_hash,
    weights_path,
    weights_record,
)


def scores_of(weights: str, scenes: int, images: Sequence[int]) -> dict[str, float]:
    """Mean angular errors in degrees, by the number of images, and the constant's."""
    network = load_weights(weights)
    scores: dict[str, float] = {}
    for count in images:
        found = validate(
            network,
            SceneConfig(),
            count=scenes,
            num_images=count,
            size=128,
            description=f"{Path(weights).stem}, {count} images",
        )
        scores[str(count)] = round(found["mae"], 2)
    return {**scores, "constant": round(found["constant"], 2)}


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Compares, and writes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("weights", metavar="FILE", help="written by a training run")
    parser.add_argument("--over", default="tiny", help="shipped name or file (tiny)")
    parser.add_argument("--scenes", type=int, default=256, help="held out (256)")
    parser.add_argument("--images", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument(
        "--average", action="store_true", help="ship the mean of FILE and the shipped"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("dist"),
        metavar="OUT",
        help="folder for the file (dist)",
    )
    parser.add_argument(
        "--install", action="store_true", help="also replace the shipped file"
    )
    arguments = parser.parse_args(argv)
    cache_compilations()
    target, old = weights_path(arguments.over), weights_record(arguments.over)
    new = weights_record(arguments.weights)
    for file, record, name in (
        (arguments.weights, new, "step"),
        (arguments.over, old, "steps"),
    ):
        if name not in record:
            raise InputError(
                f"{file}: expected a record with {name!r}, got {sorted(record)}; give "
                "a training run's FILE, --over what this tool wrote"
            )
    images = sorted(arguments.images)
    with tempfile.TemporaryDirectory() as folder:
        halved = str(Path(folder) / "new.safetensors")
        network = load_weights(arguments.weights)
        if arguments.average:
            shipped = load_weights(str(target))
            if shipped.config != network.config:
                raise InputError(
                    f"--average: expected two networks alike, got {network.config} in "
                    f"{arguments.weights} and {shipped.config} in {target}; train with "
                    f"--init-weights {arguments.over} or leave --average out"
                )
            network = jax.tree.map(lambda a, b: (a + b) / 2, network, shipped)
        save_weights(halved, network, half=True)
        before, after = (
            scores_of(file, arguments.scenes, images) for file in (str(target), halved)
        )
        network = load_weights(halved)
    print(f"before: {before}\nafter:  {after}")
    if after[str(images[-1])] >= before[str(images[-1])]:
        print(f"kept {target}: the others are not better with {images[-1]} images")
        return
    steps = old["steps"]
    record = {
        "steps": {**steps, "all scenes": steps["all scenes"] + new["step"]},
        "note": "interim: short runs after another; what changed at which step is in "
        "docs/history/tiny.md",
        "scores": {"held_out_scenes": arguments.scenes, "mae_deg": after},
    }
    make_folder(arguments.output, "--output")
    digest = weights_hash(network)[:8]
    file = arguments.output / f"{target.stem}-{digest}.safetensors"
    save_weights(file, network, record=record, half=True)
    print(
        f"wrote {file}, hash {digest}: attach it to a release, as\n"
        f"    gh release upload TAG {file}\n"
        f"It is used by --weights {file}"
    )
    if arguments.install:
        write_whole(target, file.read_bytes())
        print(f"wrote {target}: commit it with the release only")


if __name__ == "__main__":
    raise SystemExit(main())
