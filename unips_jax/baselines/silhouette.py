"""What a mask and a field over it show of a surface: silhouette, slopes, sign.

All in the product's frame: x right, y up (against the image rows), z to the viewer.
NumPy, float64: small next to the factorisations it serves.
"""

import numpy as np
from scipy import ndimage

from unips_jax.baselines.method import Unsupported


def smooth(field: np.ndarray, mask: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian mean of a field `[H, W, C]` over the neighbours inside the mask."""
    inside = mask[..., None].astype(np.float64)
    if sigma == 0:
        return field * inside
    weight = ndimage.gaussian_filter(inside, (sigma, sigma, 0), mode="constant")
    total = ndimage.gaussian_filter(field * inside, (sigma, sigma, 0), mode="constant")
    return np.where(inside > 0, total / np.where(inside > 0, weight, 1), 0)


def derivatives(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Central differences along x (right) and y (up), `[H, W, C]` each, per pixel."""
    return np.gradient(field, axis=1), -np.gradient(field, axis=0)


def silhouette(mask: np.ndarray, *, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The object's outline and its outward directions.

    The image's border is no outline: pixels within two of it are left out. Returns
    `[H, W]`, True on the outline's pixels; and `[K, 2]`, the unit outward direction (x
    right, y up) of each, in row order.
    """
    outline = mask & ~ndimage.binary_erosion(mask, border_value=1)
    outline[:2] = outline[-2:] = False
    outline[:, :2] = outline[:, -2:] = False
    padded = np.pad(mask.astype(np.float64), 8, mode="edge")
    soft = ndimage.gaussian_filter(padded, 2.0)[8:-8, 8:-8, None]
    outward = -np.concatenate(derivatives(soft), axis=-1)
    length = np.linalg.norm(outward, axis=-1)
    outline &= length > 1e-6
    if outline.sum() < 8:
        raise Unsupported(
            f"{name}: needs the object's outline to tell bumps from dents, and the "
            "mask has none within the image"
        )
    return outline, outward[outline] / length[outline][:, None]


def convex_sign(normals: np.ndarray, mask: np.ndarray, *, name: str) -> np.ndarray:
    """Settles bumps against dents: normals point outwards along the outline."""
    outline, outward = silhouette(mask, name=name)
    if np.sum(normals[outline][:, :2] * outward) >= 0:
        return normals
    return normals * np.array([-1, -1, 1], normals.dtype)
