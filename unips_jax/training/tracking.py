"""Where else the metrics and pictures of a training run go.

Anything with the two methods of `Sink` does: the writers of `clu.metric_writers` have
them, and few lines make them of another tracker's. TensorBoard is one.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np


class Sink(Protocol):
    """Takes what a run measures; only the first process calls it."""

    def write_scalars(self, step: int, scalars: Mapping[str, float]) -> None:
        """Takes numbers by their names; a resumed run sends some again."""

    def write_images(self, step: int, images: Mapping[str, np.ndarray]) -> None:
        """Takes pictures, `[1, H, W, 3]`, uint8, by their names."""


class TensorBoard:
    """Event files in `workdir/tensorboard`."""

    def __init__(self, workdir: Path, first: int) -> None:
        """Opens the files, if tensorboardX is installed; later events are dropped."""
        from tensorboardX import SummaryWriter

        self._writer: Any = SummaryWriter(
            str(workdir / "tensorboard"), purge_step=first + 1
        )

    def write_scalars(self, step: int, scalars: Mapping[str, float]) -> None:
        """See `Sink`."""
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, step)

    def write_images(self, step: int, images: Mapping[str, np.ndarray]) -> None:
        """See `Sink`."""
        for name, (picture,) in images.items():
            self._writer.add_image(name, picture, step, dataformats="HWC")
