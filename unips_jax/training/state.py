"""What a training step changes."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.models.network import init_params
from unips_jax.training.config import Config
from unips_jax.training.optimizer import make_optimizer


class TrainState(NamedTuple):
    """The state of a training run."""

    step: Array  # steps done, int32
    params: Any  # the network's parameters, float32
    opt_state: Any
    ema_params: Any  # averaged parameters; None without averaging

    def released_params(self) -> Any:
        """The parameters to validate and release."""
        return self.params if self.ema_params is None else self.ema_params


def init_state(config: Config, key: Array) -> TrainState:
    """The state training starts from; pure, so that it can be jitted."""
    params = init_params(config.model, key)
    optimizer = make_optimizer(config)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=params,
        opt_state=optimizer.init(params),
        ema_params=jax.tree.map(jnp.copy, params) if config.optim.ema_decay else None,
    )


def new_state(config: Config, key: Array, shardings: Any = None) -> TrainState:
    """`init_state`, compiled; its program, as large as a step's, does not stay."""
    program = jax.jit(functools.partial(init_state, config), out_shardings=shardings)
    return program(key)
