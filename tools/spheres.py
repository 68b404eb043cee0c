"""Spheres before a wall, with borders that mix: exact truth for any mask.

Not drawn by `scenes`, on which networks are trained: closed-form shading, sampled many
times per pixel, so that a border pixel is partly wall, as in a photograph.
"""

from typing import NamedTuple

import numpy as np

SIZE, RADIUS = 160, 60.3
_SAMPLES = 4
_CENTER = (79.6, 80.3)  # of no pixel


class Look(NamedTuple):
    """What a sphere is made of and stands before.

    Attributes:
        gloss: strength of its highlight.
        exponent: the highlight's sharpness.
        color: of the sphere, 3 numbers.
        wall: brightness of the wall behind it, in the same light.
    """

    gloss: float
    exponent: float
    color: tuple[float, float, float]
    wall: float


LOOKS = {
    "matt, black wall": Look(0.0, 1.0, (0.8, 0.6, 0.5), 0.0),
    "glossy, black wall": Look(0.8, 60.0, (0.5, 0.2, 0.15), 0.0),
    "glossy, dark wall": Look(0.3, 20.0, (0.4, 0.45, 0.5), 0.1),
    "matt, bright wall": Look(0.1, 10.0, (0.3, 0.35, 0.2), 0.7),
}


def depth_inside() -> np.ndarray:
    """How far each pixel's centre lies inside the silhouette, in pixels, `[H, W]`."""
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    return RADIUS - np.hypot(x - _CENTER[0], y - _CENTER[1])


def sphere_normals() -> np.ndarray:
    """True normals `[H, W, 3]`, float32; zero where a pixel's centre is wall."""
    return _normals(1)[0].astype(np.float32)


def photograph_sphere(look: Look) -> np.ndarray:
    """Photographs under ten distant lamps, `[10, H, W, 3]`, float32 in [0, 1]."""
    normals, inside = _normals(_SAMPLES)
    images = []
    for light in lamps(10):
        shading = np.maximum(normals @ light, 0)
        half = light + (0, 0, 1)
        shine = np.maximum(normals @ (half / np.linalg.norm(half)), 0) ** look.exponent
        shine = look.gloss * shine * (shading > 0)
        sphere = shading[..., None] * look.color + shine[..., None]
        image = np.where(inside[..., None], sphere, look.wall * light[2])
        blocks = image.reshape(SIZE, _SAMPLES, SIZE, _SAMPLES, 3)
        images.append(blocks.mean((1, 3)))
    stack = np.stack(images)
    return np.clip(stack / np.quantile(stack, 0.999), 0, 1).astype(np.float32)


def lamps(count: int) -> np.ndarray:
    """Directions over a cap around the viewer, `[N, 3]`."""
    index = np.arange(count)
    z = 1 - 0.55 * (index + 0.5) / count
    angle = index * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1)


def _normals(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals at `samples` squared points per pixel, zero outside; what is inside."""
    y, x = (np.mgrid[: SIZE * samples, : SIZE * samples] + 0.5) / samples
    x, y = (x - _CENTER[0]) / RADIUS, (_CENTER[1] - y) / RADIUS
    squared = x * x + y * y
    inside = squared < 1
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - squared, 0))], -1)
    return normals * inside[..., None], inside
