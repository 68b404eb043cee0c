"""Fine-tunes weights on a set of one's own, read by grain, in a loop of one's own.

    unips render -o scenes --objects 6 --images 8 --size 128 --seed 0
    python examples/finetune.py scenes -o mine.safetensors

`unips train --config finetune` does so with checkpoints, resumption and several
devices; this is what is in its midst, for loops that have more to do.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import grain
import jax
import numpy as np
import optax

from unips_jax import UniversalNetwork, load_weights, save_weights
from unips_jax.training import (
    LossOptions,
    Objects,
    PSWildFolders,
    read_object,
    training_loss,
)


def batches(
    root: Path, *, size: int, batch_size: int, num_images: int, seed: int = 0
) -> Iterator[dict[str, np.ndarray]]:
    """Endless batches of a folder of `X.data` folders.

    Args:
        root: holds the folders, as `unips render` writes them.
        size: side of the images.
        batch_size: objects.
        num_images: photographs of each, drawn anew every time.
        seed: of the order and the draws.

    Returns:
        `images [B, N, size, size, 3]`, `mask [B, size, size]` and
        `normals [B, size, size, 3]`.
    """

    def read(index: int, files: Any) -> dict[str, np.ndarray]:
        order = np.random.default_rng((seed, index)).permutation(len(files.photographs))
        return read_object(files, order[:num_images], size)

    return iter(
        grain.MapDataset.source(PSWildFolders(root, min_images=num_images))
        .seed(seed)
        .shuffle()
        .repeat()
        .map_with_index(read)
        .batch(batch_size, drop_remainder=True)
        .to_iter_dataset(grain.ReadOptions(num_threads=2, prefetch_buffer_size=4))
    )


def finetune(
    network: UniversalNetwork,
    data: Iterator[dict[str, np.ndarray]],
    *,
    steps: int,
    learning_rate: float = 1e-4,
    num_pixels: int = 384,
) -> tuple[UniversalNetwork, list[float]]:
    """Trains a network further.

    Args:
        network: to begin with.
        data: batches.
        steps: how many batches to take.
        learning_rate: the highest; it falls to zero as a cosine.
        num_pixels: drawn from every object.

    Returns:
        The network, and every step's mean angular error in degrees.
    """
    options = LossOptions(
        num_pixels=num_pixels, frame="mask", grid_loss=False, squared_loss=False
    )
    optimizer = optax.adamw(optax.cosine_decay_schedule(learning_rate, steps))

    @jax.jit
    def step(network: Any, state: Any, batch: Any, key: jax.Array) -> Any:
        objects = Objects(**batch)
        keys = jax.random.split(key, len(objects.images))
        (_, metrics), gradient = jax.value_and_grad(training_loss, has_aux=True)(
            network, objects, keys, options
        )
        updates, state = optimizer.update(gradient, state, network)
        return optax.apply_updates(network, updates), state, metrics["mae_deg"]

    state, errors = optimizer.init(network), []
    for number in range(steps):
        key = jax.random.fold_in(jax.random.key(0), number)
        network, state, error = step(network, state, next(data), key)
        errors.append(float(error))
    return network, errors


def main() -> None:
    """Fine-tunes `tiny` and writes the weights."""
    parser = argparse.ArgumentParser()
    parser.add_argument("root", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=100)
    arguments = parser.parse_args()
    data = batches(arguments.root, size=128, batch_size=2, num_images=8)
    network, errors = finetune(load_weights("tiny"), data, steps=arguments.steps)
    print(f"mean angular error {errors[0]:.2f} -> {np.mean(errors[-5:]):.2f} degrees")
    save_weights(arguments.output, network)


if __name__ == "__main__":
    main()
