"""Training: `python -m unips_jax.train --config configs/tiny.py --workdir runs/tiny`.

Any field of the configuration can be given too, as in `--optim.learning-rate 3e-4`. The
same command resumes a run that was stopped or killed, exactly: everything follows from
the seed and the step, and what does not is in the checkpoint.
"""

import argparse
import runpy
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import tyro

from unips_jax.console import command, keep_compiled
from unips_jax.errors import InputError
from unips_jax.training.config import Config
from unips_jax.training.loop import train


def load_config(path: str) -> Config:
    """Runs a configuration file and returns what its `get_config()` gives.

    Raises:
        InputError: if there is no such file or function, or a field's value is bad.
    """
    if not Path(path).is_file():
        raise InputError(f"--config {path}: expected a Python file, found nothing")
    names = runpy.run_path(path)
    if "get_config" not in names:
        raise InputError(f"--config {path}: expected a function get_config() in it")
    try:
        return names["get_config"]()
    except ValueError as error:
        raise InputError(f"--config {path}: {error}") from None


@command
def main(argv: Sequence[str] | None = None) -> None:
    """`python -m unips_jax.training.loop` and `unips train`."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--config", required=True, help="file with get_config()")
    parser.add_argument("--workdir", type=Path, help="the run's folder")
    parser.add_argument("--init-weights", help="start a new run from these weights")
    parser.add_argument(
        "--fields",
        action="store_true",
        help="list the configuration's fields and end",
    )
    parser.add_argument(
        "--distributed", action="store_true", help="join the other processes first"
    )
    arguments, overrides = parser.parse_known_args(argv)
    if arguments.fields:
        overrides = ["--help"]
    elif arguments.workdir is None:
        parser.error("the following arguments are required: --workdir")
    elif arguments.distributed:
        jax.distributed.initialize()
    keep_compiled()
    default = load_config(arguments.config)
    config = tyro.cli(Config, prog="unips train", default=default, args=overrides)
    start = time.monotonic()
    state = train(config, arguments.workdir, init_weights=arguments.init_weights)
    minutes = (time.monotonic() - start) / 60
    print(f"step {int(state.step)} after {minutes:.1f} minutes: {arguments.workdir}")


if __name__ == "__main__":
    raise SystemExit(main())
