"""Where an object is put so that its outline reaches the frame. Plain NumPy."""

import math

import numpy as np

FRAME_MM = 36.0  # the frame's side that focal lengths refer to
_NEAREST = 0.05  # to a camera in perspective
_TOLERANCE = 0.01  # of the frame's half side


def camera_distance(focal_mm: float | None) -> float:
    """From the origin, at which the plane z = 0 is seen within a circle of radius 1."""
    return 10.0 if focal_mm is None else math.hypot(1, 2 * focal_mm / FRAME_MM)


def fit(points: np.ndarray, focal_mm: float | None) -> tuple[float, np.ndarray, bool]:
    """Scale and offset at which an object's outline reaches the frame's edge, +-1.

    `points` are `[N, 3]`, turned as the object is to be. The offset `[3]`, across the
    view axis, is to be added after scaling. Returns also whether the outline then
    reaches the frame to 1 %, in front of the camera.
    """
    for damping, steps in ((1.0, 30), (0.3, 200)):  # elongated objects need damping
        scale, offset = 0.5, np.zeros(3)
        for _ in range(steps):
            low, high, factor = _outline(scale * points + offset, focal_mm)
            offset[:2] -= damping * (low + high) / 2 / factor
            scale *= (2 / (high - low).max()) ** damping
        placed = scale * points + offset
        low, high, _ = _outline(placed, focal_mm)
        off = max(abs((high - low).max() / 2 - 1), np.abs(low + high).max() / 2)
        ahead = camera_distance(focal_mm) - placed[:, 2].max() > _NEAREST
        if off < _TOLERANCE and ahead:
            return scale, offset, True
    return scale, offset, False


def _outline(
    seen: np.ndarray, focal_mm: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Least and greatest place in the frame, and the magnification at the origin."""
    flat, factor = seen[:, :2], 1.0
    if focal_mm is not None:
        distance = camera_distance(focal_mm)
        factor = 2 * focal_mm / FRAME_MM
        flat = factor * flat / np.maximum(distance - seen[:, 2:], _NEAREST)
        factor /= distance
    return flat.min(0), flat.max(0), factor
