"""Objects spread over the machines of a Ray cluster (https://docs.ray.io).

Every object is a task of its own. A task that dies, or whose machine does, is done
again; since an object's files appear whole or not at all, and what is there is not made
twice, nothing is lost and nothing is done double. All machines see the same folders, by
the same paths, and have this package installed.
"""

import dataclasses
import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from unips_jax.console import reason_of, track
from unips_jax.errors import InputError, install_hint

_T = TypeVar("_T")
# How often a task may die before it is given up.
_RETRIES = 10


@dataclasses.dataclass(frozen=True)
class RayOptions:
    """Where objects are worked on.

    Attributes:
        ray: address of a Ray cluster that shares the work, object by object; 'auto' is
            the one that this machine belongs to, 'local' starts one here.
        ray_cores: how many of its cores a cluster counts for an object.
    """

    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    ray_cores: int = 2

    def check(self) -> None:
        """Raises `InputError` if an option cannot be meant."""
        if self.ray_cores < 1:
            raise InputError(f"--ray-cores: expected at least 1, got {self.ray_cores}")


def spread(
    work: Callable[[_T], None],
    items: Sequence[tuple[str, _T]],
    options: RayOptions,
    description: str,
) -> dict[str, str]:
    """Does a piece of work for every item, anywhere in the cluster.

    Args:
        work: a function of a module, which does it; done again if it dies.
        items: its arguments, each by its name.
        options: the cluster.
        description: shown with the progress.

    Returns:
        By name, why there is no result, of those that have none.

    Raises:
        InputError: if Ray is not installed or the cluster cannot be reached.
    """
    failed = {}
    done = _finished(work, items, options)
    for name, reason in track(done, description, total=len(items)):
        if reason:
            failed[name] = reason
    return failed


def _finished(
    work: Callable[[_T], None], items: Sequence[tuple[str, _T]], options: RayOptions
) -> Iterator[tuple[str, str]]:
    ray = _ray(options.ray)
    task = ray.remote(num_cpus=options.ray_cores, max_retries=_RETRIES)(_attempt)
    try:
        here = Path.cwd()
        names = {task.remote(work, item, here): name for name, item in items}
        waiting = list(names)
        while waiting:
            (ready,), waiting = ray.wait(waiting, num_returns=1)
            try:
                yield names[ready], ray.get(ready)
            except ray.exceptions.RayError as error:
                text = str(error).strip().splitlines()[0]
                yield names[ready], f"died {_RETRIES + 1} times: {text}"
    finally:
        ray.shutdown()  # also ends what still runs


def _ray(address: str | None) -> Any:
    try:
        ray = importlib.import_module("ray")
    except ImportError:
        raise InputError(
            f"--ray {address}: expected Ray, found none; {install_hint('ray')}"
        ) from None
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError) as error:
        text = str(error).strip().splitlines()[0]
        raise InputError(
            f"--ray {address}: expected the address of a cluster, 'auto' or 'local': "
            f"{text}"
        ) from None
    return ray


def _attempt(work: Callable[[Any], None], item: Any, here: Path) -> str:
    """Runs in a worker: the reason why it failed, or nothing."""
    try:
        os.chdir(here)
        work(item)
    except Exception as error:
        text = reason_of(error) or f"{type(error).__name__}: {error}"
        return " ".join(text.split())
    return ""
