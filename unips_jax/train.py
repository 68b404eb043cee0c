"""Trains the network: `unips train`, or `python -m unips_jax.train`.

    unips train --config tiny --workdir runs/tiny --optim.learning-rate 3e-4

--config takes a shipped recipe's name, or a Python file like those in `configs/`. Any
field of the configuration can be given; the defaults below are those of the --config,
or without one the paper's. The same command resumes a run that was stopped or killed,
exactly: everything follows from the seed and the step, and what does not is in the
checkpoint.

Exit status: 0 at the last step, 143 if SIGTERM ended the run before it (a checkpoint
was saved: the same command goes on), 2 if something given cannot be used.
"""

import dataclasses
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from unips_jax.console import command, parse, start_jax
from unips_jax.errors import InputError
from unips_jax.training.config import Config
from unips_jax.training.recipes import load_config


@dataclasses.dataclass(frozen=True)
class _File:
    config: str | None = None


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `unips train`.

    Attributes:
        config: a shipped recipe, or a Python file with a function get_config() that
            returns a Config; it is run.
        workdir: the run's folder: checkpoints, metrics and weights.
        init_weights: start a new run from these weights.
        distributed: join the other processes first.
        fields: of the configuration.
    """

    config: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")]
    workdir: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    init_weights: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    distributed: bool = False
    fields: Annotated[Config, tyro.conf.arg(name="")] = Config()


def _join_others(jax: Any) -> None:
    try:
        jax.distributed.initialize()
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            "--distributed: expected other processes to join, as SLURM, Kubernetes and "
            f"TPU pods start them, got none: {reason}; leave it out on one machine"
        ) from None


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`unips train`."""
    file, _ = tyro.cli(_File, args=argv, return_unknown_args=True, add_help=False)
    config = Config() if file.config is None else load_config(file.config)
    missing: Any = tyro.MISSING
    options = parse(
        Options,
        argv,
        prog="unips train",
        description=__doc__,
        default=Options(missing, missing, fields=config),
        negatable=True,
    )
    import jax

    if options.distributed:
        _join_others(jax)
    start_jax()

    from unips_jax.training.restarts import Restarts

    restarts = Restarts(sys.argv[1:] if argv is None else argv)
    restarts.with_settings()

    from unips_jax.training.loop import train

    start = time.monotonic()
    try:
        state = train(
            options.fields,
            options.workdir,
            init_weights=options.init_weights,
            restarts=restarts,
        )
    except (MemoryError, RuntimeError) as error:
        text = str(error)
        if not (
            isinstance(error, MemoryError) or text.startswith("RESOURCE_EXHAUSTED")
        ):
            raise
        raise InputError(
            "out of memory: give --mesh.microbatches 2 or more, or --model.remat, and "
            f"the same command goes on from the last checkpoint ({text.strip():.100})"
        ) from None
    if restarts.due:
        restarts.start()
    minutes = (time.monotonic() - start) / 60
    print(f"step {int(state.step)} after {minutes:.1f} minutes: {options.workdir}")
    if int(state.step) < options.fields.train.steps:
        raise SystemExit(128 + signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main())
