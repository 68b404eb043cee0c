"""Meshes as grids of signed distances, for `SceneConfig.mesh_rate`.

Whatever a mesh is like, open, of several parts, or with faces turned either way, its
surface becomes a wall somewhat over a cell thick, and what it encloses is solid.
"""

from typing import Any

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

RADIUS = 0.96  # of the object, in the grid's unit sphere
_WALL = 0.7  # half thickness of walls, in cells; below half, walls have gaps
_SAMPLES = 150_000
_EXACT, _NEAR = 3, 8  # cells from the surface up to which distances are exact, sampled


def normalized(mesh: Any) -> Any:
    """A mesh within a sphere of `RADIUS` around the origin."""
    mesh = mesh.copy()
    mesh.apply_translation(-mesh.bounds.mean(0))
    mesh.apply_scale(RADIUS / np.linalg.norm(mesh.vertices, axis=1).max())
    return mesh


def grid_of(mesh: Any, size: int) -> np.ndarray:
    """Signed distances at the nodes of a cube from -1 to 1, `[size] * 3`, x first.

    Args:
        mesh: `trimesh.Trimesh`, from `normalized`.
        size: nodes along an axis.
    """
    cell = 2 / (size - 1)
    samples, faces = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    tree = cKDTree(samples)
    axis = np.linspace(-1, 1, size)
    close = np.zeros((size,) * 3, bool)
    close[tuple(np.rint((samples.T + 1) / cell).astype(int))] = True
    far = ndimage.distance_transform_edt(~close)
    distance = far * cell
    where = np.argwhere(far < _NEAR)
    points = axis[where]
    near, index = tree.query(points, k=4)
    exact = near[:, 0] < _EXACT * cell
    where_exact, repeated = where[exact], np.repeat(points[exact], 4, 0)
    triangles = mesh.triangles[faces[index[exact]]].reshape(-1, 3, 3)
    away = repeated - trimesh.triangles.closest_point(triangles, repeated)
    away = away.reshape(-1, 4, 3)
    best = np.linalg.norm(away, axis=-1).argmin(1)
    away = np.take_along_axis(away, best[:, None, None], 1)[:, 0]
    distance[tuple(where.T)] = near[:, 0]
    distance[tuple(where_exact.T)] = np.linalg.norm(away, axis=-1)
    # What the outside reaches; of walls, what lies on that side of the surface.
    free = distance > _WALL * cell
    labels, _ = ndimage.label(free)
    outside = labels == labels[0, 0, 0]
    nearest = ndimage.distance_transform_edt(
        ~outside, return_distances=False, return_indices=True
    )
    towards = axis[nearest[:, *where_exact.T].T] - axis[where_exact]
    same_side = np.einsum("ec,ec->e", away, away + towards) >= 0
    outside[tuple(where_exact.T)] |= same_side & ~free[tuple(where_exact.T)]
    return np.where(outside, distance, -distance) - _WALL * cell


def worth_it(mesh: Any) -> bool:
    """Whether a mesh is more than a few plates: 400 faces, of many directions."""
    sides = mesh.extents
    main = np.abs(mesh.face_normals).max(1) @ mesh.area_faces / mesh.area
    return len(mesh.faces) >= 400 and sides.min() > 0.2 * sides.max() and main < 0.96
