"""Triangle meshes of depth, written through trimesh (PLY, OBJ, GLB).

Vertices are the pixels' surface points in the normals' frame: x right, y up, z towards
the viewer, z = -depth. Orthographic: x and y are 0 in the middle of the image.
Perspective: the camera is at the origin and looks along -z, as in glTF, OpenGL and
Blender. Triangles are counter-clockwise seen by the viewer, so that they face him.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unips_jax.errors import InputError, install_hint
from unips_jax.io.color import as_linear
from unips_jax.io.door import write_whole
from unips_jax.surface.gltf import GltfMesh, encode_glb

SUFFIXES = (".ply", ".obj", ".glb")
CUT = 20.0
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


class Mesh(NamedTuple):
    """A triangle mesh."""

    vertices: np.ndarray  # `[V, 3]`, float32
    # `[F, 3]`, int32: the corners' vertices, counter-clockwise from in front
    faces: np.ndarray
    pixels: np.ndarray  # `[V]`, the vertices' pixels: row times width plus column


def mesh_of_depth(
    depth: np.ndarray,
    *,
    focal: float | None = None,
    principal_point: tuple[float, float] | None = None,
    pixel_size: float = 1.0,
    cut: float | None = CUT,
) -> Mesh:
    """Joins neighbouring pixels' surface points by triangles.

    Pixels without a triangle have no vertex. Depth and camera are those of
    `integrate_image`; `pixel_size` is in depth's unit, orthographic only. Triangles
    whose depth ranges over more than `cut` pixels (at their distance) are left out:
    jumps are not bridged. None keeps all.
    """
    if depth.ndim != 2:
        raise ValueError(f"depth: expected [H, W], got {depth.shape}")
    for name, value in (("pixel_size", pixel_size), ("cut", cut)):
        if value is not None and not value > 0:
            raise ValueError(f"{name}: expected above 0, got {value}")
    faces = _triangles(depth)
    if cut is not None:
        corners = depth.ravel()[faces]
        spacing = pixel_size if focal is None else corners.mean(axis=1) / focal
        faces = faces[np.ptp(corners, axis=1) <= cut * spacing]
    used = np.zeros(depth.size, bool)
    used[faces.ravel()] = True
    pixels = np.flatnonzero(used)
    number = np.cumsum(used, dtype=np.int32) - 1
    points = _points(depth, pixels, focal, principal_point, pixel_size)
    return Mesh(points, number[faces], pixels)


class NoTriangle(InputError):
    """A surface is too thin for a mesh."""


def write_mesh(
    path: Path,
    mesh: Mesh,
    *,
    colors: np.ndarray | None = None,
    max_faces: int | None = None,
    unit: str = "pixels",
) -> int:
    """Writes a mesh of at least a triangle; returns their number.

    `.ply`, `.obj` or `.glb`; GLB is in metres where the unit is m, cm or mm, and its
    colours are linear, as glTF asks; the others hold the unit and sRGB. Vertices take
    the colours `[H, W, 3]`, uint8, sRGB, of the image; of more than `max_faces`
    triangles it is simplified (quadric error).
    """
    import trimesh

    check_mesh_file(path)
    if not len(mesh.faces):
        raise NoTriangle(
            f"{path.name}: expected a surface of more than single pixels, got no "
            "triangle; give a larger mask (`unips surface`: or a larger --cut)"
        )
    scale = METRES.get(unit, 1.0) if path.suffix == ".glb" else 1.0
    vertices, faces = mesh.vertices * np.float32(scale), mesh.faces
    painted = None
    if colors is not None:
        painted = np.asarray(colors).reshape(-1, 3)[mesh.pixels]
    shape: Any = trimesh.Trimesh(vertices, faces, process=False)
    if max_faces is not None and len(faces) > max_faces:
        shape = _simplified(shape, max_faces)
        if painted is not None:
            painted = painted[_nearest(vertices, shape.vertices)]
    stated = "m" if scale != 1 or unit == "m" else unit
    if path.suffix == ".glb":
        colors = None if painted is None else as_linear(painted, "srgb")
        given = GltfMesh(
            shape.vertices, shape.faces, shape.vertex_normals, colors=colors
        )
        data = encode_glb(given, name=path.stem, facts={"unit": stated})
    else:
        if painted is not None:
            shape.visual.vertex_colors = painted
        shape.units = stated
        data = _encoded(shape, path.suffix, f"unit: {stated}")
    write_whole(path, data, sync=False)
    return len(shape.faces)


def check_mesh_file(path: Path) -> None:
    """Refuses suffixes that `write_mesh` does not write, before there is a mesh."""
    if path.suffix not in SUFFIXES:
        raise InputError(
            f"{path}: expected a mesh ending in {', '.join(SUFFIXES)}, got "
            f"{path.suffix or 'no suffix'}; rename it"
        )


def _triangles(depth: np.ndarray) -> np.ndarray:
    """All triangles of pixels in a square of 2 x 2: `[F, 3]`, int32, flat indices."""
    there = np.isfinite(depth)
    index = np.arange(depth.size, dtype=np.int32).reshape(depth.shape)

    def corners(values: np.ndarray) -> tuple[np.ndarray, ...]:
        return values[:-1, :-1], values[:-1, 1:], values[1:, :-1], values[1:, 1:]

    a, b, c, d = corners(index)
    ha, hb, hc, hd = corners(there)
    da, db, dc, dd = corners(np.where(there, depth, 0))
    falling = np.where(ha & hd, np.abs(da - dd), np.inf)
    rising = np.where(hb & hc, np.abs(db - dc), np.inf)
    first = falling <= rising
    chosen = (
        (first & ha & hc & hd, (a, c, d)),
        (first & ha & hd & hb, (a, d, b)),
        (~first & ha & hc & hb, (a, c, b)),
        (~first & hc & hd & hb, (c, d, b)),
    )
    return np.concatenate(
        [np.stack([each[where] for each in ends], -1) for where, ends in chosen]
    )


def _points(
    depth: np.ndarray,
    pixels: np.ndarray,
    focal: float | None,
    principal_point: tuple[float, float] | None,
    pixel_size: float,
) -> np.ndarray:
    height, width = depth.shape
    middle = ((width - 1) / 2, (height - 1) / 2)
    column, row = middle if focal is None else principal_point or middle
    away = depth.ravel()[pixels].astype(np.float64)
    factor = pixel_size if focal is None else away / focal
    across, down = pixels % width - column, pixels // width - row
    return np.stack([across * factor, -down * factor, -away], -1).astype(np.float32)


def _simplified(shape: Any, max_faces: int) -> Any:
    import trimesh

    try:
        import fast_simplification
    except ImportError:
        raise InputError(
            "--max-faces: expected the package fast-simplification, which is not "
            f"installed; {install_hint('mesh')}"
        ) from None
    # Its thresholds are lengths: of meshes in other units it would make others.
    some = shape.faces[:: max(1, len(shape.faces) // 100_000)]
    sides = shape.vertices[some[:, 0]] - shape.vertices[some[:, 1]]
    length = float(np.median(np.linalg.norm(sides, axis=-1))) or 1.0
    vertices, faces = fast_simplification.simplify(
        np.asarray(shape.vertices / length, np.float32),
        np.asarray(shape.faces, np.int32),
        target_count=max_faces,
    )
    return trimesh.Trimesh(vertices * length, faces, process=False)


def _nearest(known: np.ndarray, asked: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(known).query(asked)[1]


def _encoded(shape: Any, suffix: str, comment: str) -> bytes:
    if suffix == ".obj":
        return shape.export(file_type="obj", header=comment).encode()
    data = shape.export(file_type=suffix[1:])
    if suffix == ".ply":
        head, rest = data.split(b"\n", 2)[:2], data.split(b"\n", 2)[2]
        data = b"\n".join([*head, b"comment " + comment.encode(), rest])
    return data
