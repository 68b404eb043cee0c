"""MPM-style method, second half: one field of normals from many patches.

Two ways. `merge_angles` (the 2018 paper's idea): angles between normals do not depend
on a patch's frame; propagated along shortest paths they make a Gram matrix. Paths that
bend overestimate angles. `merge_sync` (as in the 2021 follow-up): overlaps give the
rotation or reflection between two patches, and all of them are reconciled at once.

Source: Mo et al. (CVPR 2018); Guo et al., "Patch-based uncalibrated photometric stereo
under natural illumination" (TPAMI 2021), both for the idea.
"""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from scipy import sparse
from scipy.sparse import csgraph

from unips_jax.baselines.mpm.patches import Patch

_MIN_SHARED = 8
_NOISE = 0.05  # expected error of overlapping normals, as a chord
_NODES, _LANDMARKS = 1200, 300
_NEAR = np.deg2rad(20.0)


def merge_sync(patches: Sequence[Patch], count: int) -> np.ndarray:
    """Merges at least one patch by synchronising the patches' frames.

    Returns unit normals of the mask's `count` pixels in one frame, NaN where unknown.
    """
    weights = _link_weights(patches, count)
    _, component = csgraph.connected_components(weights[0] > 0, directed=False)
    kept = np.flatnonzero(component == np.bincount(component).argmax())
    weight, rotation = weights[0][np.ix_(kept, kept)], weights[1][np.ix_(kept, kept)]
    size = len(kept)
    degree = np.maximum(weight.sum(1), 1e-300)
    scale = 1 / np.sqrt(degree[:, None] * degree)
    blocks = (weight * scale)[..., None, None] * rotation
    blocks[np.arange(size), np.arange(size)] = np.eye(3) * 1e-9  # for a lone patch
    matrix = blocks.transpose(0, 2, 1, 3).reshape(3 * size, 3 * size)
    top = [3 * size - 3, 3 * size - 1]
    _, vectors = scipy.linalg.eigh(matrix, subset_by_index=top)
    frames = vectors.reshape(size, 3, 3) / np.sqrt(degree)[:, None, None]
    return _average(
        [patches[i] for i in kept.tolist()], _nearest_orthogonal(frames), count
    )


def _link_weights(
    patches: Sequence[Patch], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Trust `[K, K]` and frame change `[K, K, 3, 3]` of every pair of patches."""
    # Row vectors: patch i's normals times the change (i, j) are patch j's.
    size = len(patches)
    stack = _stacked(patches, count)
    moments = (
        (stack.T @ stack).toarray().reshape(size, 3, size, 3).transpose(0, 2, 1, 3)
    )
    owners = abs(stack[:, ::3]) + abs(stack[:, 1::3]) + abs(stack[:, 2::3])
    owners = (owners > 0).astype(float)
    shared = (owners.T @ owners).toarray()
    left, singular, right = np.linalg.svd(moments)
    misfit = (2 - 2 * singular.sum(-1) / np.maximum(shared, 1)) / 3
    trust = np.array([patch.weight for patch in patches])
    weight = shared * np.exp(-np.maximum(misfit, 0) / (2 * _NOISE**2))
    weight *= trust[:, None] * trust
    shape = singular[..., 2] / np.maximum(singular[..., 0], 1e-12)
    weight *= np.minimum(1, 50 * shape)
    weight[(shared < _MIN_SHARED) | np.eye(size, dtype=bool)] = 0
    return weight, left @ right


def merge_angles(patches: Sequence[Patch], count: int) -> np.ndarray:
    """Merges patches by shortest paths of angles; returns as `merge_sync`."""
    # Paths run over at most 1200 pixels, from at most 300 of them; the others follow
    # from the frames that fit their patches best.
    covered = np.zeros(count, bool)
    for patch in patches:
        covered[patch.pixels] = True
    nodes = np.flatnonzero(covered)
    nodes = nodes[_spread(len(nodes), _NODES)]
    node_of = np.full(count, -1)
    node_of[nodes] = np.arange(len(nodes))

    angles = _mean_angles(patches, node_of, len(nodes))
    graph = sparse.csr_array(np.where(angles < _NEAR, np.maximum(angles, 1e-9), 0))
    _, component = csgraph.connected_components(graph, directed=False)
    inside = np.flatnonzero(component == np.bincount(component).argmax())
    marks = inside[_spread(len(inside), _LANDMARKS)]
    paths = csgraph.dijkstra(graph, directed=False, indices=marks)[:, inside]
    gram = np.cos(np.minimum(paths, np.pi))
    own = gram[:, np.searchsorted(inside, marks)]
    values, vectors = np.linalg.eigh((own + own.T) / 2)
    points = vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], 1e-12))
    field = np.full((count, 3), np.nan)
    found = np.linalg.lstsq(points, gram, rcond=None)[0].T
    length = np.linalg.norm(found, axis=1, keepdims=True)
    field[nodes[inside]] = found / np.maximum(length, 1e-12)
    return _follow(patches, field)


def _mean_angles(
    patches: Sequence[Patch], node_of: np.ndarray, size: int
) -> np.ndarray:
    """Angle between every two nodes `[Q, Q]`, the patches' mean; inf without one."""
    total, votes = np.zeros((size, size)), np.zeros((size, size))
    for patch in patches:
        member = node_of[patch.pixels] >= 0
        where = np.ix_(*[node_of[patch.pixels[member]]] * 2)
        normals = patch.normals[member]
        total[where] += np.arccos(np.clip(normals @ normals.T, -1, 1))
        votes[where] += 1
    np.fill_diagonal(votes, 0)
    return np.where(votes > 0, total / np.maximum(votes, 1), np.inf)


def _follow(patches: Sequence[Patch], field: np.ndarray) -> np.ndarray:
    """Carries a field known at some pixels to all pixels of the patches there."""
    known = np.isfinite(field[:, 0])
    members, moments = [], []
    for patch in patches:
        here = known[patch.pixels]
        if here.sum() >= 3:
            members.append(patch)
            moments.append(patch.normals[here].T @ field[patch.pixels[here]])
    return _average(members, _nearest_orthogonal(np.stack(moments)), len(field))


def _spread(total: int, wanted: int) -> np.ndarray:
    # A fixed draw: a regular one would line up with the image's rows.
    if total <= wanted:
        return np.arange(total)
    return np.sort(np.random.default_rng(0).choice(total, wanted, replace=False))


def _stacked(patches: Sequence[Patch], count: int) -> sparse.csc_array:
    """All patches' normals as one sparse matrix `[count, 3 K]`."""
    rows = np.concatenate([np.repeat(patch.pixels, 3) for patch in patches])
    columns = np.concatenate(
        [np.tile(3 * k + np.arange(3), len(p.pixels)) for k, p in enumerate(patches)]
    )
    data = np.concatenate([patch.normals.ravel() for patch in patches])
    return sparse.csc_array((data, (rows, columns)), shape=(count, 3 * len(patches)))


def _nearest_orthogonal(matrices: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(matrices)
    return left @ right


def _average(patches: Sequence[Patch], frames: np.ndarray, count: int) -> np.ndarray:
    trust = np.array([patch.weight for patch in patches])
    total = _stacked(patches, count) @ (trust[:, None, None] * frames).reshape(-1, 3)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), np.nan)
