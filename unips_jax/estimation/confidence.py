"""How far normals may be off, from how they spread over subsets of the photographs.

The photographs are halved twice at random, and each half is estimated alone, every
second one mirrored (our network takes the mean over the mirrored images anyway, so that
they differ in the halves alone). The spread is the root mean square angle between these
normals and the estimate from all photographs. It knows nothing of errors that all
halves share. What errors go with it: docs/lights.md.
"""

from collections.abc import Callable

import numpy as np

from unips_jax.errors import InputError
from unips_jax.estimation.streaming import estimate_photographs
from unips_jax.io.color import Transfer
from unips_jax.models.network import UniversalNetwork
from unips_jax.models.views import FrameKind


def normal_spread(
    network: UniversalNetwork,
    images: np.ndarray,
    mask: np.ndarray,
    normals: np.ndarray,
    *,
    transfer: Transfer = "linear",
    frame: FrameKind = "mask",
    lights: np.ndarray | None = None,
    splits: int = 2,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """The spread of normals over halves of the photographs, in degrees: `[H, W]`.

    Costs twice what the estimate costs. Arguments are those of `estimate_photographs`;
    `normals [H, W, 3]` is the estimate from all photographs, at least two, which are
    halved `splits` times. 0 outside the mask.
    """
    if len(images) < 2:
        raise InputError(
            "confidence: expected 2 photographs or more, got 1; leave out --confidence "
            "and --all"
        )
    halves = _halves(len(images), splits, seed)
    total = np.zeros(mask.shape, np.float32)
    pixels = int(np.count_nonzero(mask))
    for index, half in enumerate(halves):
        mirrored = index % 2 == 1
        step = -1 if mirrored else 1
        turned = np.array([step, 1, 1], np.float32)

        def report(done: int, _: int, before: int = index * pixels) -> None:
            if progress is not None:
                progress(before + done, len(halves) * pixels)

        found = estimate_photographs(
            network,
            images[half][:, :, ::step],
            mask[:, ::step],
            transfer=transfer,
            frame=frame,
            lights=None if lights is None else lights[half] * turned,
            progress=report,
        )[:, ::step]
        cosine = (found * normals * turned).sum(-1)
        total += np.square(np.arccos(np.clip(cosine, -1, 1))) / len(halves)
    return np.where(mask, np.degrees(np.sqrt(total)), 0).astype(np.float32)


def _halves(count: int, splits: int, seed: int) -> list[np.ndarray]:
    """Indices of the photographs of each half."""
    rng = np.random.default_rng(seed)
    halves = []
    for _ in range(splits):
        order = rng.permutation(count)
        halves += [np.sort(order[: count // 2]), np.sort(order[count // 2 :])]
    return halves
