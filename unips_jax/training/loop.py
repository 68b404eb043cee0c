"""The training loop: batches, steps, validation, checkpoints, until done or stopped.

Everything follows from the seed and the step, and what does not is in the checkpoint,
so a run that was stopped or killed resumes exactly.
"""

import dataclasses
import functools
import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from unips_jax.config import to_json
from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.scenes import render_batch
from unips_jax.training.checkpoints import Checkpoints
from unips_jax.training.compilation import (
    compile_together,
    keep_freed_memory,
    return_freed_memory,
)
from unips_jax.training.config import Config
from unips_jax.training.folders import draw_num_images, folder_batches
from unips_jax.training.guards import (
    alone_in,
    any_process,
    check_finite,
    check_input,
    stop_on_sigterm,
)
from unips_jax.training.log import TrainLog, say
from unips_jax.training.sharding import (
    batch_sharding,
    make_mesh,
    replicated,
    state_sharding,
    to_host,
)
from unips_jax.training.state import TrainState, init_state, new_state
from unips_jax.training.step import Batch, train_step
from unips_jax.training.validation import validate, validation_pictures
from unips_jax.weights import load_weights, save_weights

# Fields of a network that do not change what its parameters mean.
_SAME_PARAMETERS = {"remat", "dtype", "dropout_rate", "drop_path_rate", "mirror"}


def train(
    config: Config, workdir: Path, *, init_weights: str | None = None
) -> TrainState:
    """Trains, from nothing or from the newest checkpoint in `workdir`.

    Writes `checkpoints/`, `metrics.jsonl`, `best.safetensors` at every validation that
    improves, and `last.safetensors` at the end.

    Args:
        config: of the run.
        workdir: its folder.
        init_weights: weights to start a new run from.

    Returns:
        The state after the last step, or at SIGTERM to any of the processes.

    Raises:
        InputError: if the folder holds a run with another configuration (other than
            its length, rhythm, place of the data or memory), another process trains
            there, or the batch does not fit the devices.
        FloatingPointError: if the loss is not finite; the batch is saved.
    """
    settle = keep_freed_memory() if config.train.keep_memory else return_freed_memory
    mesh = make_mesh(config.mesh)
    check_input(config, mesh)
    make_folder(workdir, "--workdir")
    key = jax.random.key(config.train.seed)
    init_key, scene_key, step_key = jax.random.split(key, 3)

    shapes = jax.eval_shape(functools.partial(init_state, config), init_key)
    shardings = state_sharding(shapes, mesh)
    with (
        alone_in(workdir),
        Checkpoints(workdir, config) as checkpoints,
        stop_on_sigterm() as stop,
    ):
        if checkpoints.latest_step() is None:
            state = new_state(config, init_key, shardings)
            if init_weights is not None:
                state = _start_from(state, init_weights, config)
            record: dict[str, Any] = {"best_mae_deg": None}
        else:
            abstract = jax.tree.map(_with_sharding, shapes, shardings)
            state, record = checkpoints.restore(abstract)
        unlogged = jax.tree.map(np.float32, record.pop("unlogged", []))
        first = int(state.step)
        log = TrainLog(workdir, first, config.train.steps)
        run_step = compile_together(
            jax.jit(
                functools.partial(train_step, config=config),
                donate_argnums=0,
                out_shardings=(shardings, replicated(mesh)),
            ),
            say,
            settle,
        )
        batches = _batches(config, scene_key, mesh, first)
        pending: tuple[int, Batch, dict[str, jax.Array]] | None = None
        validated = False
        for step in range(first + 1, config.train.steps + 1):
            batch = next(batches)
            state, metrics = run_step(state, batch, step_key)
            if pending is not None:
                check_finite(*pending, workdir)
            pending = (step, batch, metrics)
            checkpoints.check()
            unlogged.append(metrics)
            if step % config.train.log_every == 0:
                log.metrics(step, _means(jax.device_get(unlogged)))
                unlogged.clear()
            done = step == config.train.steps
            validates = done or step % config.train.validate_every == 0
            # All processes stop after the same step. They agree on it where they wait
            # for the device anyway.
            agrees = jax.process_count() == 1 or step % config.train.log_every == 0
            stopping = agrees and any_process(stop.is_set())
            saves = done or stopping or step % config.train.checkpoint_every == 0
            if validates or saves:
                check_finite(*pending, workdir)
            if validates:
                record = _validate_and_keep_best(config, state, record, workdir, log)
                if not validated:  # it compiled
                    settle()
                validated = True
            if saves:
                floats = jax.tree.map(float, unlogged)
                checkpoints.save(step, state, {**record, "unlogged": floats})
            if stopping:
                say(f"stopped by SIGTERM after step {step}; checkpoint saved")
                break
    params = to_host(state.released_params())
    _write_weights(workdir / "last.safetensors", config, params, int(state.step), {})
    return state


def _means(values: list[dict[str, Any]]) -> dict[str, Any]:
    # Steps on folders have no "lights".
    names = dict.fromkeys(name for value in values for name in value)
    return {
        name: np.mean([value[name] for value in values if name in value])
        for name in names
    }


def _with_sharding(shape: jax.ShapeDtypeStruct, sharding: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape.shape, shape.dtype, sharding=sharding)


def _start_from(state: TrainState, source: str, config: Config) -> TrainState:
    model, params = load_weights(source)
    run, own = dataclasses.asdict(config.model), dataclasses.asdict(model)
    changed = {
        name: (value, run[name])
        for name, value in own.items()
        if name not in _SAME_PARAMETERS and run[name] != value
    }
    if changed:
        raise InputError(
            f"--init-weights {source}: expected weights of the run's network, got "
            f"others (field: weights, run): {changed}; change --model or the weights"
        )
    place = functools.partial(
        jax.tree.map, lambda new, old: jax.device_put(new, old.sharding)
    )
    placed = place(params, state.params)
    # A copy: the step gives both buffers away, which must not be the same.
    ema = None if state.ema_params is None else jax.tree.map(jnp.copy, placed)
    return state._replace(params=placed, ema_params=ema)


def _batches(
    config: Config, scene_key: jax.Array, mesh: Mesh, first: int
) -> Iterator[Batch]:
    """The batches of the steps after `first`; each follows from its step."""
    data, seed = config.data, config.train.seed
    scene_share = {"scenes": 1.0, "folders": 0.0}.get(data.source, data.scene_share)

    def from_scenes(step: int) -> bool:
        return bool(np.random.default_rng((seed, step, 1)).random() < scene_share)

    # Scenes always have the largest number of images: one compilation serves all.
    sharding = batch_sharding(mesh)

    @functools.partial(jax.jit, out_shardings=sharding)
    def render(step: jax.Array) -> Batch:
        keys = jax.random.split(jax.random.fold_in(scene_key, step), data.batch_size)
        scene = render_batch(
            keys,
            size=data.image_size,
            num_images=max(data.num_images),
            config=config.scenes,
        )
        batch = {"images": scene.images, "mask": scene.mask, "normals": scene.normals}
        if config.model.consensus_blocks:  # others would be compiled for them in vain
            batch["lights"] = scene.light_means
        return batch

    folders: Iterator[dict[str, np.ndarray]] = iter(())
    if scene_share < 1:
        folders = folder_batches(
            data.root,
            size=data.image_size,
            batch_size=data.batch_size,
            num_images=data.num_images,
            seed=seed,
            first=sum(not from_scenes(step) for step in range(1, first + 1)),
            process=(jax.process_index(), jax.process_count()),
            workers=data.workers,
        )

    @functools.partial(jax.jit, static_argnums=1, out_shardings=sharding)
    def take(x: jax.Array, count: int) -> jax.Array:
        return x[:, :count]

    place = functools.partial(jax.make_array_from_process_local_data, sharding)
    for step in itertools.count(first + 1):
        if from_scenes(step):
            batch = render(np.int32(step))
            count = draw_num_images(data.num_images, seed, step)
            sets = (name for name in ("images", "lights") if name in batch)
            yield {**batch, **{name: take(batch[name], count) for name in sets}}
        else:
            yield jax.tree.map(place, next(folders))


def _validate_and_keep_best(
    config: Config,
    state: TrainState,
    record: dict[str, Any],
    workdir: Path,
    log: TrainLog,
) -> dict[str, Any]:
    if not config.train.validation_scenes:
        return record
    params = to_host(state.released_params())
    scores = validate(
        params,
        config.model,
        config.scenes,
        count=config.train.validation_scenes,
        num_images=config.train.validation_images,
        size=config.data.image_size,
    )
    step = int(state.step)
    log.metrics(step, {f"validation/{name}": v for name, v in scores.items()})
    if log.shows_pictures:
        log.pictures(step, validation_pictures(params, config))
    # A score on other scenes, before a resumption, is no measure of this one.
    on = [config.train.validation_scenes, config.train.validation_images]
    best = record["best_mae_deg"] if record.get("best_on", on) == on else None
    if not scores["mae"] < (math.inf if best is None else best):  # nor is NaN better
        return record
    _write_weights(workdir / "best.safetensors", config, params, step, scores)
    return {"best_mae_deg": scores["mae"], "best_step": step, "best_on": on}


def _write_weights(
    path: Path, config: Config, params: Any, step: int, scores: dict[str, float]
) -> None:
    if jax.process_index() == 0:
        record = {"step": step, "config": json.loads(to_json(config))}
        save_weights(path, config.model, params, record={**record, "scores": scores})
