"""The batches of a run: scenes made on the device, PS-Wild folders, or both."""

import functools
import hashlib
import itertools
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike

from unips_jax.errors import InputError
from unips_jax.models.config import SelfCalibratingConfig
from unips_jax.provenance import code_hash
from unips_jax.scenes import load_meshes, render_batch
from unips_jax.training.config import Config
from unips_jax.training.folders import draw_num_images, folder_batches, names_hash
from unips_jax.training.sharding import batch_sharding
from unips_jax.training.step import Batch


def make_batches(
    config: Config,
    scene_key: jax.Array,
    mesh: Mesh,
    first: int,
    compiling: Callable[[str], AbstractContextManager[None]],
) -> Iterator[Batch]:
    """The batches of the steps after `first`; each follows from its step.

    `compiling` is entered, with what it is, while something compiles. Yields
    `images [B, N, H, H, 3]`, `mask [B, H, H]`, `normals [B, H, H, 3]`, and, of scenes
    where the network has use for them, `lights [B, N, 3]` and `incident`
    (`scenes.IncidentLight`, `[B, N, ...]`).
    """
    data, seed = config.data, config.train.seed
    scene_share = {"scenes": 1.0, "folders": 0.0}.get(data.source, data.scene_share)

    def from_scenes(step: int) -> bool:
        return bool(np.random.default_rng((seed, step, 1)).random() < scene_share)

    before = range(1, first + 1)
    sharding = batch_sharding(mesh)
    if scene_share > 0:
        render = _scene_renderer(config, scene_key, mesh, compiling)
    if scene_share < 1:
        folders = folder_batches(
            data.root,
            size=data.image_size,
            batch_size=data.batch_size,
            num_images=data.num_images,
            seed=seed,
            first=sum(not from_scenes(step) for step in before),
            process=(jax.process_index(), jax.process_count()),
            workers=data.workers,
        )
    place = functools.partial(jax.make_array_from_process_local_data, sharding)
    for step in itertools.count(first + 1):
        if from_scenes(step):
            yield render(step)
        else:
            yield jax.tree.map(place, _next(folders, data.workers))


def kinds_of_batches(config: Config) -> int:
    """How many kinds of batches there are, each of which is compiled for."""
    data = config.data
    mixed = data.source == "mixture" and 0 < data.scene_share < 1
    return 2 if mixed and config.model.guesses else 1  # with lights, and without


def data_facts(config: Config) -> dict[str, str]:
    """Hashes of what a run learns from that its configuration does not hold."""
    data, facts = config.data, {}
    if data.source != "scenes":
        facts["folders"] = names_hash(data.root, max(data.num_images))
    if data.source != "folders":
        facts["renderer"] = code_hash("scenes.render")
        meshes = load_meshes(config.scenes)
        if meshes is not None:
            found = hashlib.blake2b(meshes.tobytes(), digest_size=8)
            facts["meshes"] = found.hexdigest()
    return facts


def _next(
    folders: Iterator[dict[str, np.ndarray]], workers: int
) -> dict[str, np.ndarray]:
    try:
        return next(folders)
    except RuntimeError as error:
        if "Worker process was terminated" not in str(error):
            raise
        raise InputError(
            f"--data.workers {workers}: a process that reads was ended, as where "
            "memory is short; the same command goes on from the last checkpoint, "
            "also with fewer"
        ) from None


def scene_batch(
    keys: jax.Array, meshes: ArrayLike | None, *, config: Config, num_images: int
) -> Batch:
    """A scene for each key, with what the network has use for; see `make_batches`."""
    model = config.model
    kinds = isinstance(model, SelfCalibratingConfig) and model.light_tokens
    incident = kinds or config.data.known_lights_rate > 0
    scene = render_batch(
        keys,
        size=config.data.image_size,
        num_images=num_images,
        config=config.scenes,
        meshes=meshes,
        incident=incident,
    )
    batch = {"images": scene.images, "mask": scene.mask, "normals": scene.normals}
    if model.guesses:  # others would be compiled for them in vain
        batch["lights"] = scene.light_means
    if incident:
        batch["incident"] = scene.incident
    return batch


def _scene_renderer(
    config: Config,
    key: jax.Array,
    mesh: Mesh,
    compiling: Callable[[str], AbstractContextManager[None]],
) -> Callable[[int], Batch]:
    data, sharding = config.data, batch_sharding(mesh)
    # Scenes always have the largest number of images: one compilation serves all.
    make = functools.partial(
        scene_batch, config=config, num_images=max(data.num_images)
    )

    @functools.partial(jax.jit, out_shardings=sharding)
    def render(step: jax.Array, meshes: jax.Array | None) -> Batch:
        keys = jax.random.split(jax.random.fold_in(key, step), data.batch_size)
        return make(keys, meshes)

    @functools.partial(jax.jit, static_argnums=1, out_shardings=sharding)
    def take(sets: Batch, count: int) -> Batch:
        return jax.tree.map(lambda x: x[:, :count], sets)

    meshes = load_meshes(config.scenes)
    if meshes is not None:
        meshes = jax.device_put(meshes, NamedSharding(mesh, PartitionSpec()))
    with compiling("what makes the scenes"):
        compiled = render.lower(np.int32(0), meshes).compile()

    def scenes(step: int) -> Batch:
        batch = compiled(np.int32(step), meshes)
        count = draw_num_images(data.num_images, config.train.seed, step)
        names = {"images", "lights", "incident"} & batch.keys()
        return batch | take({name: batch[name] for name in names}, count)

    return scenes
