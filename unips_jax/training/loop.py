"""The training loop: batches, steps, validation, checkpoints, until done or stopped.

Everything follows from the seed and the step, and what does not is in the checkpoint,
so a run that was stopped or killed resumes exactly.
"""

import dataclasses
import functools
import json
import math
import os
import threading
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from unips_jax.errors import InputError
from unips_jax.io.claims import make_folder
from unips_jax.models.config_json import to_json
from unips_jax.models.network import UniversalNetwork
from unips_jax.provenance import code_hash
from unips_jax.scenes.draws import seeded
from unips_jax.training.batches import data_facts, kinds_of_batches, make_batches
from unips_jax.training.checkpoints import Checkpoints
from unips_jax.training.compilation import compile_together
from unips_jax.training.config import Config, TrainConfig
from unips_jax.training.log import TrainLog, say
from unips_jax.training.restarts import Restarts
from unips_jax.training.safety import (
    alone_in,
    any_process,
    check_finite,
    check_input,
    check_memory,
    stop_on_sigterm,
)
from unips_jax.training.sharding import make_mesh, replicated, state_sharding, to_host
from unips_jax.training.state import TrainState, init_state, new_state
from unips_jax.training.step import Batch, train_step
from unips_jax.training.tracking import Sink
from unips_jax.training.validation import score_table, validate, validation_pictures
from unips_jax.weights import load_weights, save_weights, weights_hash

# Fields of a network that do not change what its parameters mean.
_SAME_PARAMETERS = {"remat", "dtype", "dropout_rate", "drop_path_rate"}
# Fields that add parts to a network without a change to what it gives at first.
_NEW_PARTS = {"fine_dim", "light_tokens", "known_lights"}


def train(
    config: Config,
    workdir: str | os.PathLike[str],
    *,
    init_weights: str | None = None,
    sink: Sink | None = None,
    restarts: Restarts | None = None,
) -> TrainState:
    """Trains, from nothing or from the newest checkpoint in `workdir`.

    Writes `checkpoints/`, `metrics.jsonl`, `best.safetensors` at every validation that
    improves, and `last.safetensors` at the end. A new run starts from `init_weights`,
    where they are given. Returns the state after the last step, at SIGTERM to any of
    the processes, or, with `restarts`, where the process is to start again.

    Raises:
        InputError: if the folder holds a run with another configuration (other than
            its length, rhythm, place of the data or memory) or damaged checkpoints
            only, another process trains there, its disk is full, or the batch does
            not fit the devices.
        FloatingPointError: if the loss is not finite; the batch is saved.
    """
    mesh = make_mesh(config.mesh)
    check_input(config, mesh)
    facts = data_facts(config)
    workdir = Path(workdir)
    make_folder(workdir, "--workdir")
    kind = mesh.devices.flat[0].device_kind
    say(f"training in {workdir}, {config.train.steps} steps, on {mesh.size} x {kind}")
    key = seeded(config.train.seed)
    init_key, scene_key, step_key = jax.random.split(key, 3)
    abstract = _abstract_state(config, init_key, mesh)
    check_memory(abstract, mesh)
    with (
        stop_on_sigterm() as stop,  # until the last checkpoint is written
        alone_in(workdir),
        Checkpoints(workdir, config) as checkpoints,
    ):
        if checkpoints.latest_step() is None:
            _refuse_to_replace(workdir)
            state = _new_state(config, init_key, abstract, init_weights)
            record: dict[str, Any] = {"best_mae_deg": None}
            weights = init_weights and weights_hash(load_weights(init_weights))
            begun: dict[str, Any] = {"init": weights}
        else:
            say(f"going on after step {checkpoints.latest_step()}")
            state, record = checkpoints.restore(abstract)
            begun = {k: record.pop(k) for k in ("init", "data") if k in record}
            _check_same_start(init_weights, begun)
            _say_what_changed(begun.get("data", facts), facts)
        begun["data"] = facts
        unlogged = record.pop("unlogged", [])
        first, steps = int(state.step), config.train.steps
        every = config.train.log_every
        log = TrainLog(workdir, first, steps, every=every, pending=unlogged, sink=sink)
        run_step = compile_together(_jitted_step(config, abstract, mesh), log.compiling)
        batches = make_batches(config, scene_key, mesh, first, log.compiling)
        kinds: set[tuple[int, bool]] = set()  # of batches, seen so far
        every_kind = len(set(config.data.num_images)) * kinds_of_batches(config)
        unchecked: tuple[int, Batch, dict[str, jax.Array]] | None = None
        saved = True
        for step in range(first + 1, steps + 1):
            try:
                batch = next(batches)
            except InputError:  # a file that cannot be read: no step shall be lost
                if unchecked is not None and jax.process_count() == 1:
                    check_finite(*unchecked, workdir)
                    if not saved:
                        known = {**record, **begun, "unlogged": log.pending()}
                        checkpoints.save(step - 1, state, known)
                raise
            state, metrics = run_step(state, batch, step_key)
            if unchecked is not None:
                check_finite(*unchecked, workdir)
            unchecked = (step, batch, metrics)
            checkpoints.check()
            log.step(step, metrics)
            kinds.add((batch["images"].shape[1], "lights" in batch))
            fresh = (
                restarts is not None
                and not stop.is_set()
                and len(kinds) == every_kind
                and restarts.compiled_all(steps - step)
            )
            due = _due(step, config.train, stop, fresh)
            if due.validation or due.checkpoint:
                check_finite(*unchecked, workdir)
            if due.validation:
                with log.untimed():
                    record = _validate_and_keep_best(
                        config, state, record, workdir, log
                    )
            if due.checkpoint:
                known = {**record, **begun, "unlogged": log.pending()}
                checkpoints.save(step, state, known)
            saved = due.checkpoint
            if due.stop:
                say(
                    f"starting again after step {step}: steps then take less time"
                    if fresh
                    else f"stopped by SIGTERM after step {step}; checkpoint saved"
                )
                break
    if restarts is not None and stop.is_set():
        restarts.due = False
    network = UniversalNetwork(config.model, to_host(state.released_params()))
    _write_weights(workdir / "last.safetensors", config, network, int(state.step), {})
    return state


class _Due(NamedTuple):
    """What follows a step."""

    validation: bool
    checkpoint: bool
    stop: bool


def _due(
    step: int, train: TrainConfig, stop: threading.Event, restart: bool = False
) -> _Due:
    done = step == train.steps
    # All processes stop after the same step. They agree on it where they wait for the
    # device anyway.
    agrees = jax.process_count() == 1 or step % train.log_every == 0
    stopping = restart or (agrees and any_process(stop.is_set()))
    return _Due(
        validation=done or step % train.validate_every == 0,
        # The first step's shows a disk that is full, before much is lost.
        checkpoint=step == 1 or done or stopping or step % train.checkpoint_every == 0,
        stop=stopping,
    )


def _abstract_state(config: Config, key: jax.Array, mesh: Mesh) -> TrainState:
    """Shapes, types and shardings of the state."""
    shapes = jax.eval_shape(functools.partial(init_state, config), key)

    def place(shape: jax.ShapeDtypeStruct, sharding: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape.shape, shape.dtype, sharding=sharding)

    return jax.tree.map(place, shapes, state_sharding(shapes, mesh))


def _shardings(abstract: TrainState) -> Any:
    return jax.tree.map(lambda x: x.sharding, abstract)


def _jitted_step(config: Config, abstract: TrainState, mesh: Mesh) -> Any:
    """The training step; it overwrites the state that it is given."""
    return jax.jit(
        functools.partial(train_step, config=config),
        donate_argnums=0,
        out_shardings=(_shardings(abstract), replicated(mesh)),
    )


def _new_state(
    config: Config, key: jax.Array, abstract: TrainState, init_weights: str | None
) -> TrainState:
    state = new_state(config, key, _shardings(abstract))
    return state if init_weights is None else _start_from(state, init_weights, config)


def _refuse_to_replace(workdir: Path) -> None:
    """Keeps weights of an earlier run whose checkpoints are gone."""
    for name in ("best.safetensors", "last.safetensors"):
        if (workdir / name).exists():
            raise InputError(
                f"--workdir {workdir}: expected a run's checkpoints beside its {name}, "
                "found none; choose another folder, or move it and metrics.jsonl away"
            )


def _check_same_start(init_weights: str | None, begun: dict[str, Any]) -> None:
    """Refuses weights that the run in the folder did not begin with."""
    if init_weights is None or not begun:
        return
    try:
        given = weights_hash(load_weights(init_weights))
    except InputError:  # they are not needed any more
        return
    if given != begun["init"]:
        was = f"those of hash {begun['init']}" if begun["init"] else "drawn ones"
        raise InputError(
            f"--init-weights {init_weights}: expected what the run in this folder "
            f"began with, {was}, got weights of hash {given}; leave it out to go on, "
            "or choose another --workdir"
        )


def _say_what_changed(before: dict[str, str], now: dict[str, str]) -> None:
    """Names the data that are others than those of the steps before."""
    words = {
        "folders": "the objects below --data.root",
        "renderer": "the code that makes scenes",
        "meshes": "the meshes of --scenes.mesh-file",
    }
    for name, value in before.items():
        if now.get(name, value) != value:
            say(
                f"warning: {words[name]} changed since the checkpoint: the steps from "
                "here are not those that an unbroken run would have taken"
            )


def _start_from(state: TrainState, source: str, config: Config) -> TrainState:
    network = load_weights(source)
    run, own = dataclasses.asdict(config.model), dataclasses.asdict(network.config)
    changed = {
        name: (value, run.get(name))
        for name, value in own.items()
        if name not in _SAME_PARAMETERS
        and run.get(name) != value
        and not (name in _NEW_PARTS and not value)
    }
    if changed:
        raise InputError(
            f"--init-weights {source}: expected weights of the run's network, got "
            f"others (field: weights, run): {changed}; change --model or the weights"
        )
    place = functools.partial(
        jax.tree.map, lambda new, old: jax.device_put(new, old.sharding)
    )
    placed = place(_with_new_parts(network.params, state.params), state.params)
    # A copy: the step gives both buffers away, which must not be the same.
    ema = None if state.ema_params is None else jax.tree.map(jnp.copy, placed)
    return state._replace(params=placed, ema_params=ema)


def _with_new_parts(params: Any, drawn: Any) -> Any:
    """Parameters, with those drawn for the parts that they lack."""
    if not isinstance(drawn, dict):
        return params
    return {
        name: _with_new_parts(params[name], part) if name in params else part
        for name, part in drawn.items()
    }


def _validate_and_keep_best(
    config: Config,
    state: TrainState,
    record: dict[str, Any],
    workdir: Path,
    log: TrainLog,
) -> dict[str, Any]:
    if not config.train.validation_scenes:
        return record
    network = UniversalNetwork(config.model, to_host(state.released_params()))
    scores = validate(
        network,
        config.scenes,
        count=config.train.validation_scenes,
        num_images=config.train.validation_images,
        size=config.data.image_size,
    )
    step = int(state.step)
    log.record(step, {f"validation/{name}": v for name, v in scores.items()})
    if log.shows_pictures:
        log.pictures(step, validation_pictures(network, config))
    # A score on other scenes, before a resumption, is no measure of this one.
    scenes, images = config.train.validation_scenes, config.train.validation_images
    on = [scenes, images, code_hash("scenes.render")]
    best = record["best_mae_deg"] if record.get("best_on") == on else None
    better = scores["mae"] < (math.inf if best is None else best)  # NaN is not
    rank = "the best so far" if better else f"best: {best or math.nan:.2f}"
    say(
        f"validation after step {step}: {scores['mae']:.2f} degrees ({rank}), "
        f"{scores['constant']:.2f} for constant normals\n{score_table(scores)}"
    )
    if not better:
        return record
    _write_weights(workdir / "best.safetensors", config, network, step, scores)
    return {"best_mae_deg": scores["mae"], "best_step": step, "best_on": on}


def _write_weights(
    path: Path,
    config: Config,
    network: UniversalNetwork,
    step: int,
    scores: dict[str, float],
) -> None:
    if jax.process_index() == 0:
        record = {"step": step, "config": json.loads(to_json(config))}
        save_weights(path, network, record={**record, "scores": scores})
