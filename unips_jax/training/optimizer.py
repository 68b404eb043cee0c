"""The optimiser: AdamW or Muon, with clipping and a schedule."""

import math
from typing import Any

import jax
import numpy as np
import optax
import optax.contrib

from unips_jax.training.config import Config, OptimConfig

# Optax's own five iterations. Given one by one they run in a loop; unrolled, as they
# are otherwise, XLA on CPU repeats parts of each in the next and takes half again as
# long.
_NEWTON_SCHULZ = np.array([(3.4445, -4.7750, 2.0315)] * 5, np.float32)

# Inputs per output up to which Muon's step on a convolution is taken whole.
_WIDE = 256


def make_schedule(config: OptimConfig, steps: int) -> optax.Schedule:
    """The learning rate at every step of a run."""
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(
            0.0 if config.warmup_steps else config.learning_rate,
            config.learning_rate,
            config.warmup_steps,
            max(steps, config.warmup_steps + 1),
        )
    if config.schedule == "trapezoid":
        rest = max(steps - config.warmup_steps, 1)
        fall = min(config.fall_steps, rest)
        after = optax.linear_schedule(
            config.learning_rate, 0.0, fall, transition_begin=rest - fall
        )
    else:
        after = optax.exponential_decay(
            config.learning_rate, config.decay_every, config.decay_rate, staircase=True
        )
    if not config.warmup_steps:
        return after
    warmup = optax.linear_schedule(0.0, config.learning_rate, config.warmup_steps)
    return optax.join_schedules([warmup, after], [config.warmup_steps])


def make_optimizer(config: Config) -> optax.GradientTransformation:
    """The whole update rule."""
    return _update_rule(config.optim, config.train.steps)


def _update_rule(config: OptimConfig, steps: int) -> optax.GradientTransformation:
    schedule = make_schedule(config, steps)
    if config.name == "adamw":
        rule = optax.adamw(
            schedule, b2=config.b2, weight_decay=config.weight_decay, mask=is_kernel
        )
    else:
        rule = optax.contrib.muon(
            schedule,
            adam_b2=config.b2,
            weight_decay=config.weight_decay,
            muon_weight_dimension_numbers=_matrix_axes,
            consistent_rms=0.2,
            ns_coeffs=_NEWTON_SCHULZ,
        )
        rule = optax.chain(rule, optax.stateless(_shorten_wide))
    if not config.clip_norm:
        return rule
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), rule)


def is_kernel(params: Any) -> Any:
    """Marks the parameters that weight decay shrinks: kernels, by their name."""
    return jax.tree_util.tree_map_with_path(
        lambda path, _: getattr(path[-1], "key", None) == "kernel", params
    )


def _shorten_wide(updates: Any, _: Any) -> Any:
    """Shortens Muon's steps on convolutions with many inputs."""
    # A step moves an output by as much as its many inputs agree. Those of a 3 x 3
    # convolution over hundreds of channels mostly do: their common part alone pushes
    # every ReLU of the pyramid pooling below zero for good, and what lies before it has
    # no gradient any more (`docs/history/tiny.md`). Only by the root: in proportion,
    # the pooling's output stays a sixth of what it is added to.

    def shorten(update: jax.Array) -> jax.Array:
        if update.ndim != 4:
            return update
        inputs = math.prod(update.shape[:-1])
        return update * min(1.0, math.sqrt(_WIDE / inputs))

    return jax.tree.map(shorten, updates)


def _matrix_axes(params: Any) -> Any:
    """How Muon sees a parameter: kernels as matrices `[inputs, outputs]`."""
    return jax.tree.map(
        lambda value, kernel: (
            optax.contrib.MuonDimensionNumbers(
                reduction_axis=tuple(range(value.ndim - 1)), output_axis=value.ndim - 1
            )
            if kernel
            else None
        ),
        params,
        is_kernel(params),
    )
