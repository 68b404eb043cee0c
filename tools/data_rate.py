"""How many objects a second a run would read from a folder like PS-Wild.

    python tools/data_rate.py PS-Wild --config unips --workers 0 2
    python tools/data_rate.py --write 12 --size 512     # of objects made for this

Reads what training would read, without a network: a line of JSON for each number of
reading processes. What was read or written shortly before comes from memory.
"""

import argparse
import itertools
import json
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.console import command
from unips_jax.errors import InputError
from unips_jax.training import DataConfig, load_config, write_folder
from unips_jax.training.folders import READ_AHEAD, folder_batches


def write_objects(root: Path, count: int, size: int) -> None:
    """Writes objects of noise, ten images each, as large on disk as ones of 16 bits."""
    generator = np.random.default_rng(0)
    y, x = np.mgrid[1 : -1 : size * 1j, -1 : 1 : size * 1j]
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normals, mask = np.stack([x, y, z], -1), z > 0
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    for index in range(count):
        photographs = (generator.random((size, size, 3)) for _ in range(10))
        folder = root / f"object{index}.data"
        write_folder(folder, photographs, mask, normals, {}, name="{:03d}.tif")


def measure(
    root: Path, data: DataConfig, *, workers: int, batches: int
) -> dict[str, Any]:
    """Reads batches, after those that are read ahead."""
    stream = folder_batches(
        str(root),
        size=data.image_size,
        batch_size=data.batch_size,
        num_images=data.num_images,
        seed=0,
        first=0,
        workers=workers,
    )
    for _ in range(READ_AHEAD + 1):
        next(stream)
    start, used = time.monotonic(), sum(os.times()[:2])
    shapes = [batch["images"].shape for batch in itertools.islice(stream, batches)]
    seconds, cores = time.monotonic() - start, sum(os.times()[:2]) - used
    photographs = sum(shape[0] * shape[1] for shape in shapes)
    figures = {
        "workers": workers,
        "objects_per_second": round(data.batch_size * batches / seconds, 2),
        "photographs_per_second": round(photographs / seconds, 2),
    }
    if not workers:  # while others read, their time is not known
        figures["cpu_seconds_per_photograph"] = round(cores / photographs, 4)
    return figures


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path, nargs="?", help="holds X.data folders")
    parser.add_argument("--write", type=int, default=12, help="objects, without a root")
    parser.add_argument("--size", type=int, default=512, help="side of these")
    parser.add_argument("--config", default="unips", help="a recipe: what is read")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 2])
    parser.add_argument("--batches", type=int, default=16)
    arguments = parser.parse_args(argv)
    data = load_config(arguments.config).data
    with tempfile.TemporaryDirectory() as place:
        root = arguments.root
        if root is None:
            if arguments.write < data.batch_size:
                raise InputError(
                    f"--write {arguments.write}: expected at least the "
                    f"{data.batch_size} objects of a batch"
                )
            root = Path(place)
            write_objects(root, arguments.write, arguments.size)
        for workers in arguments.workers:
            figures = measure(root, data, workers=workers, batches=arguments.batches)
            print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
