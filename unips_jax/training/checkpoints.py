"""Training checkpoints, written with orbax.

A checkpoint is written beside its place and moved there when complete, so that a kill
at any moment leaves the earlier ones.
"""

import json
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import jax
from orbax.checkpoint import v1 as ocp

from unips_jax.config import to_json
from unips_jax.errors import InputError
from unips_jax.training.config import Config

# What may change between the runs of one training: where and how, not what.
_FREE = {
    "model": {"remat", "mirror"},
    "optim": {"fall_steps"},
    "data": {"root", "workers"},
    "scenes": set(),
    "train": {
        *("steps", "log_every", "checkpoint_every", "keep", "validate_every"),
        "keep_memory",
        *("validation_scenes", "validation_images"),
    },
}


def changed_fields(saved: dict[str, Any], ours: dict[str, Any]) -> dict[str, Any]:
    """What makes a run another one than that which was saved.

    Fields that the saved one does not know came with a later version and have no say.

    Args:
        saved: a `Config` as read from JSON.
        ours: the same of the present run.

    Returns:
        By field, what was saved and what is given.
    """
    return {
        f"{part}.{name}": (value, ours[part].get(name))
        for part, free in _FREE.items()
        for name, value in saved[part].items()
        if name not in free and ours[part].get(name) != value
    }


class Checkpoints:
    """The checkpoints of one run."""

    def __init__(self, workdir: Path, config: Config) -> None:
        """Opens a run's folder; it is made if absent.

        Args:
            workdir: of the run.
            config: of the run; the number of checkpoints kept is among it.
        """
        self._config = config
        self._path = workdir / "checkpoints"
        self._path.mkdir(parents=True, exist_ok=True)
        policies = ocp.training
        self._checkpointer = policies.Checkpointer(
            self._path.resolve(),
            save_decision_policy=policies.save_decision_policies.FixedIntervalPolicy(1),
            preservation_policy=policies.preservation_policies.LatestN(
                config.train.keep
            ),
            cleanup_tmp_directories=jax.process_index() == 0,
        )

    def __enter__(self) -> Self:
        """Nothing to do."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Waits for writes under way."""
        self._checkpointer.close()

    def latest_step(self) -> int | None:
        """The step of the newest complete checkpoint; None if there is none."""
        latest = self._checkpointer.latest
        return None if latest is None else latest.step

    def save(self, step: int, state: Any, record: dict[str, Any]) -> None:
        """Starts to write a checkpoint; training goes on meanwhile.

        Args:
            step: steps done.
            state: a tree of arrays.
            record: what else must survive, anything JSON can hold.
        """
        self._checkpointer.save_checkpointables_async(
            step,
            {"state": state},
            custom_metadata={
                "config": to_json(self._config),
                "record": json.dumps(record),
            },
            overwrite=True,
        )

    def restore(self, abstract_state: Any) -> tuple[Any, dict[str, Any]]:
        """Reads the newest checkpoint.

        Args:
            abstract_state: shapes, types and shardings to read it into.

        Returns:
            The state and the record.

        Raises:
            InputError: if it was written by a run that differs in more than its
                length, rhythm, place of the data or memory.
        """
        step = self.latest_step()
        metadata = self._checkpointer.checkpointables_metadata(step).custom_metadata
        saved = json.loads(metadata["config"])
        changed = changed_fields(saved, json.loads(to_json(self._config)))
        if changed:
            raise InputError(
                f"{self._path}: checkpoint {step} was written with another "
                f"configuration (field: saved, given): {changed}; continue with the "
                "saved one, or choose another --workdir and --init-weights"
            )
        state = self._checkpointer.load_checkpointables(step, {"state": abstract_state})
        return state["state"], json.loads(metadata["record"])
