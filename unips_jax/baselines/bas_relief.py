"""Two ways to settle the generalised bas-relief ambiguity.

A factorised, integrable field `b0` (albedo times normal, as row vectors) is known up to
`b = b0 G` with `G = [[1, 0, 0], [0, 1, 0], [mu, nu, lam]]`; lights then are
`l = G^-1 l0` (Belhumeur, Kriegman and Yuille, 1999). The sign of `lam` stays with the
silhouette. Sources: minimum entropy of the albedos (Alldrin, Mallick and Kriegman, CVPR
2007); diffuse maxima (Favaro and Papadhimitri, CVPR 2012).
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import ndimage, sparse
from scipy.sparse import linalg

from unips_jax.baselines.method import Unsupported
from unips_jax.baselines.silhouette import smooth

_BINS = 1024
_PIXELS = 4096  # at most, for the entropy
_MAXIMA = 3000  # at most; their pairs' crossings take some 0.2 GB


def transform(relief: np.ndarray) -> np.ndarray:
    """The matrix G of (mu, nu, lam), `[3, 3]`."""
    matrix = np.eye(3)
    matrix[2] = relief
    return matrix


def by_entropy(vectors: np.ndarray) -> np.ndarray:
    """The ambiguity's parameters (mu, nu, lam > 0) that make the albedos fewest.

    The entropy of the albedos' histogram, searched from coarse to fine over mu, nu in
    [-4, 4] and lam in [1/4, 4], of b0 `[P, 3]`, its components of one size. Right for a
    few flat albedos; texture, shadows and highlights mislead it.
    """
    some = vectors[:: -(-len(vectors) // _PIXELS)]
    lengths = np.linalg.norm(some, axis=-1)
    # Of the mean albedo; the last bin is at four times it or above.
    width = max(np.ptp(lengths) / lengths.mean() / 128, 4 / _BINS)
    points = jnp.asarray(some, jnp.float32)
    axes = [np.arange(-4, 4.01, 0.5), np.arange(-4, 4.01, 0.5), np.arange(0.25, 4, 0.5)]
    step, best = 0.5, np.array([0.0, 0.0, 1.0])
    while True:
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[grid[:, 2] > 0.02]
        scores = _entropies(jnp.asarray(grid, jnp.float32), points, width)
        best = grid[np.argmin(scores)]
        if step <= 0.01:
            return best
        axes = [center + step * np.linspace(-1.5, 1.5, 7) for center in best]
        step /= 1.5


@jax.jit
def _entropies(reliefs: Array, vectors: Array, width: Array) -> Array:
    """Entropy of the albedos under each `[K, 3]` of parameters, `[K]`, in bits."""

    def entropy(relief: Array) -> Array:
        third = vectors[:, 2]
        x = vectors[:, 0] + relief[0] * third
        y = vectors[:, 1] + relief[1] * third
        albedo = jnp.sqrt(x**2 + y**2 + (relief[2] * third) ** 2)
        index = albedo / jnp.mean(albedo) / width
        index = jnp.clip(index.astype(jnp.int32), 0, _BINS - 1)
        counts = jnp.zeros(_BINS, jnp.float32).at[index].add(1.0)
        share = counts / vectors.shape[0]
        return -jnp.sum(share * jnp.log2(jnp.maximum(share, 1e-30)))

    return jax.lax.map(entropy, reliefs, batch_size=64)


def by_diffuse_maxima(
    field: np.ndarray, lights: np.ndarray, images: np.ndarray, mask: np.ndarray
) -> np.ndarray:
    """The ambiguity's parameters (mu, nu, lam > 0) from points that face their light.

    Of b0 `[H, W, 3]`, l0 `[N, 3]` and grey images `[N, H, W]`. Where a diffuse image
    has a local maximum, the normal points to the light. Each such pair confines (mu,
    nu) to a segment; the median of all segments' crossings is taken, and the median of
    the lam they imply. Of more than 3,000 points only every second, third, ... is used.
    `Unsupported` if no two segments cross.
    """
    index, rows, columns = diffuse_maxima(images, mask)
    b, light = field[rows, columns], lights[index]
    flat = light[:, 0] ** 2 + light[:, 1] ** 2
    # Lights have the images' unit, whatever it is.
    sideways = flat > 1e-12 * flat.max(initial=0)
    keep = np.flatnonzero((np.abs(b[:, 2]) > 1e-6) & sideways)
    keep = keep[:: max(1, -(-len(keep) // _MAXIMA))]
    b, light, flat = b[keep], light[keep], flat[keep]
    points, lams = [], []
    for first, others, point in _crossings(*_segments(b, light, flat)):
        points.append(point)
        # Both segments of a crossing give a lam of their own.
        for ends in (np.full_like(others, first), others):
            lams.append(_lam(b[ends], light[ends], flat[ends], point))
    if not points:
        raise Unsupported(
            "factorisation: no two diffuse maxima agree on the shape; more images or "
            'resolve="entropy" may help'
        )
    center = np.median(np.concatenate(points), axis=0)
    lam = np.median(np.concatenate(lams))
    return np.array([*center, max(lam, 1e-3)])


def diffuse_maxima(
    images: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Local maxima of smoothed images `[N, H, W]` that no other image shares.

    The images are divided by `flat_albedo` first. A maximum of the remaining albedo
    stays where it is when the light moves, so maxima that several images have within a
    pixel are dropped, as are those in the darker half of an image's range. Returns
    image number, row and column of each, `[K]`.
    """
    flat = images / flat_albedo(images, mask)
    stack = smooth(np.moveaxis(flat, 0, -1), mask, 2.0)
    inside = ndimage.binary_erosion(mask, iterations=2)
    values = stack[mask]
    half = (values.min(axis=0) + values.max(axis=0)) / 2
    peaks = stack == ndimage.maximum_filter(stack, (3, 3, 1))
    peaks &= inside[..., None] & (stack > half)
    dilated = ndimage.binary_dilation(peaks, np.ones((3, 3, 1)))
    peaks &= (dilated.sum(axis=-1) < 2)[..., None]
    rows, columns, index = np.nonzero(peaks)
    return index, rows, columns


def flat_albedo(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Albedo of a surface painted in flat colours; smooth texture is missed.

    Between neighbours of like intensity profile (like normals) in the grey images
    `[N, H, W]`, a jump of the profile's length is one of the albedo. The jumps are
    integrated. Returns `[H, W]`, positive, median 1 in the mask; 1 outside.
    """
    profile = images[:, mask].T  # [P, N]
    length = np.maximum(np.linalg.norm(profile, axis=-1), 1e-12 * images.max())
    profile = profile / length[:, None]
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(mask.sum())
    pairs = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    ends = np.concatenate([np.stack([a.ravel(), b.ravel()]) for a, b in pairs], axis=1)
    p, q = ends[:, (ends >= 0).all(axis=0)]
    jump = np.log(length[q] / length[p])
    angle = np.arccos(np.clip(np.sum(profile[p] * profile[q], axis=-1), -1, 1))
    jump = np.where(np.abs(jump) > np.maximum(0.08, 3 * angle), jump, 0)
    count = len(length)
    edge = np.arange(len(p))
    difference = sparse.coo_array((np.ones(len(p)), (edge, q)), (len(p), count)).tocsr()
    difference -= sparse.coo_array((np.ones(len(p)), (edge, p)), (len(p), count))
    system = difference.T @ difference + 1e-6 * sparse.eye_array(count)
    logarithm = linalg.spsolve(system.tocsc(), difference.T @ jump)
    albedo = np.ones(mask.shape)
    albedo[mask] = np.exp(logarithm - np.median(logarithm))
    return albedo


def _segments(
    b: np.ndarray, light: np.ndarray, flat: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the (mu, nu) segments of pairs (b, l), `[K, 2]` each."""
    start = -b[:, :2] / b[:, 2:]
    across = light[:, 0] * b[:, 1] - light[:, 1] * b[:, 0]
    turned = np.stack([light[:, 1] * across, -light[:, 0] * across], axis=-1)
    ahead = light[:, 2:] * light[:, :2] * b[:, 2:]
    return start, (turned + ahead) / (b[:, 2] * flat)[:, None]


def _crossings(
    start: np.ndarray, end: np.ndarray
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """A segment, the later ones that cross it `[C]`, and where `[C, 2]`."""
    # Segment by segment: all pairs at once would need memory for their number.
    steps = end - start
    for first in range(len(start) - 1):
        d, e = steps[first], steps[first + 1 :]
        gap = start[first + 1 :] - start[first]
        area = d[0] * e[:, 1] - d[1] * e[:, 0]
        safe = np.where(np.abs(area) < 1e-12, np.inf, area)
        s = (gap[:, 0] * e[:, 1] - gap[:, 1] * e[:, 0]) / safe
        t = (gap[:, 0] * d[1] - gap[:, 1] * d[0]) / safe
        hit = np.flatnonzero((s > 0) & (s < 1) & (t > 0) & (t < 1))
        if len(hit):
            yield first, first + 1 + hit, start[first] + s[hit, None] * d


def _lam(
    b: np.ndarray, light: np.ndarray, flat: np.ndarray, point: np.ndarray
) -> np.ndarray:
    """The lam of pairs (b, l) at points (mu, nu), `[K]`."""
    reach = np.sum((b[:, :2] + point * b[:, 2:]) ** 2, axis=-1) / flat
    rest = np.sum(point * light[:, :2], axis=-1) - light[:, 2]
    return (reach * rest**2 / b[:, 2] ** 2) ** 0.25
