"""Batches of training objects from disk, through grain.

A batch follows from the seed and its number, whatever the number of processes and
workers, so that a resumed run reads what it would have read.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grain
import numpy as np

from unips_jax.data.sources import PSWildFolders, read_object


def draw_num_images(choices: tuple[int, ...], seed: int, step: int) -> int:
    """The set size of a step, the same for all its objects."""
    return int(np.random.default_rng((seed, step)).choice(choices))


def folder_batches(
    root: str,
    *,
    size: int,
    batch_size: int,
    num_images: tuple[int, ...],
    seed: int,
    first: int,
    process: tuple[int, int] = (0, 1),
    workers: int = 0,
) -> Iterator[dict[str, np.ndarray]]:
    """Endless batches of PS-Wild objects, shuffled anew every epoch.

    Args:
        root: see `PSWildFolders`.
        size: side of the images.
        batch_size: objects per step, over all processes.
        num_images: the set sizes that steps draw from.
        seed: of order, set sizes and choice of photographs.
        first: batches to skip.
        process: this process' number and the number of processes, which share a batch.
        workers: reading processes; 0 reads in threads of this one.

    Returns:
        `images [B, N, size, size, 3]`, `mask [B, size, size]`,
        `normals [B, size, size, 3]`, B being this process' share of the batch.

    Raises:
        InputError: if the folders do not fit.
    """
    source = PSWildFolders(Path(root), min_images=max(num_images))

    def read(index: int, files: Any) -> dict[str, np.ndarray]:
        step = index // batch_size
        count = draw_num_images(num_images, seed, step)
        key = np.random.default_rng((seed, step, index % batch_size))
        chosen = key.permutation(len(files.photographs))[:count]
        return read_object(files, chosen, size)

    share = batch_size // process[1]
    dataset = (
        grain.MapDataset.source(source)  # type: ignore[arg-type]
        .seed(seed)
        .shuffle()
        .repeat()
        .map_with_index(read)
        .batch(batch_size, drop_remainder=True)[first:]
        .map(lambda batch: _share(batch, process[0] * share, share))
    )
    iterable = dataset.to_iter_dataset()
    if workers:
        from absl import flags

        flags.FLAGS.mark_as_parsed()
        iterable = iterable.mp_prefetch(grain.MultiprocessingOptions(workers))
    return iter(iterable)


def _share(
    batch: dict[str, np.ndarray], start: int, count: int
) -> dict[str, np.ndarray]:
    return {name: array[start : start + count] for name, array in batch.items()}
