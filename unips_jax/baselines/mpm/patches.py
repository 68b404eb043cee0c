"""MPM-style method, first half: patches and their normals up to an orthogonal frame.

Within a patch whose normals vary little, an environment acts like one directional light
(its vector irradiance), so a patch's pixels times images have rank 3; uniform albedo
fixes the metric, which leaves a rotation or reflection per patch.

Everything is float64 NumPy: patches are small, and the metric is ill-conditioned.

Source: Mo et al., "Uncalibrated photometric stereo under natural illumination" (CVPR
2018), for the idea; Hayakawa, "Photometric stereo under a light source with arbitrary
motion" (JOSA A 1994), for the metric. The rest is our own.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from unips_jax.baselines.grid import integrate

MIN_IMAGES = 6
MIN_PIXELS = 24
_MIN_SHARE = 0.35  # of a patch's square that must lie on the object
_SHADOW = 0.03  # of the stack's bright end: darker patches have attached shadows


class Patch(NamedTuple):
    """One patch, solved up to an orthogonal matrix."""

    pixels: np.ndarray  # `[p]`, indices into the mask's pixels in row-major order
    normals: np.ndarray  # `[p, 3]`, unit length, in the patch's own frame
    weight: float  # trust, in (0, 1.001]


def flatten_albedo(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Divides an estimate of the albedo out; its smooth changes remain.

    Neighbours whose profiles over the images agree have the same normal; a step of
    their brightness is then one of the albedo. These steps are integrated. Images are
    `[N, H, W]`, grey, linear; NaN where saturated; the mask has only pixels that are
    lit in some image.
    """
    known = np.nan_to_num(images)
    size = np.where(mask, np.linalg.norm(known, axis=0), 1)
    profile, bright = known / size, np.log(size)
    slopes = np.zeros((2, *mask.shape))
    slopes[0, :, :-1] = _albedo_steps(profile, bright, mask)
    swapped = (np.swapaxes(image, -1, -2) for image in (profile, bright, mask))
    slopes[1, :-1] = _albedo_steps(*swapped).T
    log_albedo = np.asarray(
        integrate(jnp.asarray(slopes, jnp.float32), jnp.asarray(mask)), float
    )
    return images / np.exp(log_albedo - np.median(log_albedo[mask]))


def _albedo_steps(
    profile: np.ndarray, bright: np.ndarray, mask: np.ndarray
) -> np.ndarray:
    """Steps of the albedo's logarithm along rows, `[H, W - 1]`, mostly zero."""
    chord = np.linalg.norm(np.diff(profile, axis=-1), axis=0)
    angle = 2 * np.arcsin(np.minimum(chord / 2, 1))
    step = np.diff(bright, axis=-1)
    both = mask[:, 1:] & mask[:, :-1]
    edge = both & (np.abs(step) > np.maximum(0.08, 3 * angle))
    # Shading changes across an edge as it does on both its sides.
    smooth = np.pad(both & ~edge, ((0, 0), (1, 1)))
    change = np.pad(step, ((0, 0), (1, 1))) * smooth
    sides = smooth[:, :-2].astype(int) + smooth[:, 2:]
    shading = (change[:, :-2] + change[:, 2:]) / np.maximum(sides, 1)
    return np.where(edge, step - shading, 0.0)


def solve_patches(
    images: np.ndarray, mask: np.ndarray, *, radius: int
) -> tuple[list[Patch], float]:
    """Cuts the object into overlapping squares and solves each.

    `radius` is their half-width in pixels; their grid's step is half of it. Images as
    in `flatten_albedo`. Returns the patches, and the share of squares that had to be
    dropped, in [0, 1].
    """
    index = np.full(mask.shape, -1)
    index[mask] = np.arange(mask.sum())
    values = images[:, mask].T  # [P, N]
    bright = float(np.percentile(np.nan_to_num(values), 99))
    least = max(MIN_PIXELS, _MIN_SHARE * (2 * radius + 1) ** 2)
    patches, tried = [], 0
    rows, columns = (_centres(line, radius) for line in np.nonzero(mask))
    for row in rows:
        for column in columns:
            top, left = max(row - radius, 0), max(column - radius, 0)
            square = index[top : row + radius + 1, left : column + radius + 1]
            pixels = square[square >= 0]
            if len(pixels) < least:
                continue
            tried += 1
            patch = _solve(pixels, values[pixels], bright)
            if patch is not None:
                patches.append(patch)
    return patches, 1 - len(patches) / max(tried, 1)


def _centres(places: np.ndarray, radius: int) -> np.ndarray:
    # Symmetric about the object's middle, so that turned images give turned normals.
    low, high = int(places.min()), int(places.max())
    step = max(radius // 2, 1)
    count = (high - low) // step + 1
    spare = (high - low - (count - 1) * step) / 2
    return np.rint(low + spare + step * np.arange(count)).astype(int)


def _solve(pixels: np.ndarray, values: np.ndarray, bright: float) -> Patch | None:
    """Normals of one patch `[p, N]`, or None where the model does not hold."""
    dark = np.percentile(np.nan_to_num(values), 2, axis=0)
    enough = max(MIN_IMAGES, int(np.sum(dark > _SHADOW * bright)))
    chosen = np.sort(np.argsort(-dark)[:enough])
    whole = np.isfinite(values[:, chosen]).all(1)
    pixels, values = pixels[whole], values[whole][:, chosen]
    if len(pixels) < MIN_PIXELS:
        return None
    energy, vectors = np.linalg.eigh(values.T @ values)
    if energy[-3] < 1e-7 * energy[-1]:
        return None
    factors = values @ vectors[:, -3:] / np.sqrt(energy[-3:] / len(pixels))
    scaled = upgrade(factors)
    if scaled is None:
        return None
    albedo = np.linalg.norm(scaled, axis=1)
    spread = albedo.std() / albedo.mean()
    normals = scaled / np.maximum(albedo, 1e-12)[:, None]
    return Patch(pixels, normals, float(np.exp(-spread / 0.05) + 1e-3))


def upgrade(factors: np.ndarray) -> np.ndarray | None:
    """Finds the frame in which rank-3 factors have constant length.

    Factors `[p, 3]` are whitened: their second moment is the identity. Returns
    `[p, 3]`, lengths near 1, known up to an orthogonal matrix; None if no real frame
    fits, which happens where the light is not equivalent to one direction.
    """
    x, y, z = factors.T
    terms = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)
    weights = np.ones(len(factors))
    for _ in range(5):
        root = np.sqrt(weights)
        q = np.linalg.lstsq(root[:, None] * terms, root, rcond=None)[0]
        weights = 1 / np.sqrt(np.maximum(np.abs(terms @ q - 1), 1e-3))
    form = np.array([[q[0], q[3], q[4]], [q[3], q[1], q[5]], [q[4], q[5], q[2]]])
    scales, axes = np.linalg.eigh(form)
    if scales[0] <= 0:
        return None
    return factors @ (axes * np.sqrt(scales))
