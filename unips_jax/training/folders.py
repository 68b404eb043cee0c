"""Batches of training objects from disk, through grain.

A batch follows from the seed and its number, whatever the number of processes and
workers, so that a resumed run reads what it would have read.
"""

import hashlib
import multiprocessing
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import grain
import numpy as np

from unips_jax.io.ps_wild import PSWildFolders, TrainingObject, read_object

READ_AHEAD = 4  # batches held ready, each read by a thread of its own


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

    Yields `images [B, N, size, size, 3]`, `mask [B, size, size]` and `normals [B, size,
    size, 3]`, B being this process' share of the batch, after the `first` ones.
    `process` is its number and how many share a batch; with no `workers`, threads of
    this one read.
    """
    source = PSWildFolders(Path(root), min_images=max(num_images))

    share = batch_size // process[1]
    mine = slice(process[0] * share, (process[0] + 1) * share)

    def read(step: int, batch: list[TrainingObject]) -> dict[str, np.ndarray]:
        count = draw_num_images(num_images, seed, step)
        objects = []
        for place, files in list(enumerate(batch))[mine]:
            key = np.random.default_rng((seed, step, place))
            chosen = key.permutation(len(files.photographs))[:count]
            objects.append(read_object(files, chosen, size))
        return {name: np.stack([x[name] for x in objects]) for name in objects[0]}

    dataset = (
        grain.MapDataset.source(source)  # type: ignore[arg-type]
        .seed(seed)
        .shuffle()
        .repeat()
        .batch(batch_size, drop_remainder=True, batch_fn=list)
        .map_with_index(read)[first:]
    )
    # By default hundreds of batches are read ahead, by threads that starve this one.
    ahead = grain.ReadOptions(num_threads=READ_AHEAD, prefetch_buffer_size=READ_AHEAD)
    iterable = dataset.to_iter_dataset(ahead)
    if workers:
        from absl import flags

        flags.FLAGS.mark_as_parsed()
        iterable = iterable.mp_prefetch(
            grain.MultiprocessingOptions(workers),
            worker_init_fn=_stand_apart,
        )
    return iter(iterable)


def names_hash(root: str, min_images: int) -> str:
    """A hash of the objects' names and numbers of photographs, wherever they lie."""
    source = PSWildFolders(Path(root), min_images=min_images)
    found = hashlib.blake2b(digest_size=8)
    for index in range(len(source)):
        files = source[index]
        place = files.normals.parent.relative_to(root).as_posix()
        line = f"{place} {len(files.photographs)}\n"
        found.update(line.encode(errors="surrogateescape"))
    return found.hexdigest()


def _stand_apart(*_: int) -> None:
    """Signals to all of a job are the training process' to answer: it saves first."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)
    training = multiprocessing.parent_process()
    if training is not None:  # when it is gone no signal of the group ends this one

        def leave() -> None:
            training.join()
            os._exit(1)

        threading.Thread(target=leave, daemon=True).start()
