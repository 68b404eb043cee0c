"""A surface for a purpose: a model for Blender and games, a solid to print.

The model (`.glb`) is a coarse grid of the surface with normals, texture coordinates and
a material: base colour, and a normal map that gives back every pixel's normal. It is in
metres; without a known scale its longest side is 1 m. Green is up in its normal map, as
the format wants; or down, for engines that take DirectX's maps as they are. The solid
(`.stl`) stands on a base, is watertight, and in millimetres; without a known scale its
longest side is 100 mm.
"""

from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import scipy.ndimage
import scipy.sparse.csgraph

from unips_jax.errors import InputError
from unips_jax.io.images import encode_image
from unips_jax.surface.gltf import GltfMesh, encode_glb
from unips_jax.surface.mesh import CUT, METRES, Mesh, mesh_of_depth

_FACES, _PRINTED_FACES = 100_000, 1_000_000
_BASE = 0.04  # of the longest side


class Scale(NamedTuple):
    """What depth means."""

    focal: float | None = None  # in pixels; None for an orthographic camera
    pixel_size: float = 1.0  # side of a pixel in depth's unit; orthographic only
    unit: str = "pixels"  # of the depth; m, cm, mm, or pixels: unknown


_UNKNOWN = Scale()


def blender_model(
    depth: np.ndarray,
    normals: np.ndarray,
    scale: Scale = _UNKNOWN,
    *,
    name: str,
    colors: np.ndarray | None = None,
    max_faces: int | None = None,
    cut: float = CUT,
    directx: bool = False,
    longest_mm: float | None = None,
) -> tuple[bytes, dict[str, Any]]:
    """A `.glb` with normals, texture coordinates, base colour and normal map.

    Of depth `[H, W]`, NaN where there is no surface, normals and colours `[H, W, 3]`.
    Returns its content, and for the record its size and number of triangles.

    Args:
        max_faces: of the grid, 100,000 if not given.
        cut: triangles over jumps of depth of more pixels than this are left out.
        directx: green is down in the normal map.
        longest_mm: the object's longest side, instead of the scale.
    """
    height, width = depth.shape
    step = max(2, _step(depth, max_faces or _FACES))
    small = _grid(depth, step)
    small = _of_faces(small, ~_over_jumps(depth, small, scale, cut, step))
    _require_faces(small)
    pixels = small.pixels
    points = _points(depth, pixels, scale)
    points, facts = _sized(points, scale.unit, "m", longest_mm)
    # What the map is relative to, at the vertices and between them.
    normals = _filled(normals, ~(normals != 0).any(-1))
    smooth = cv2.blur(normals, (2 * step + 1, 2 * step + 1))
    across = _unit(_stretched(smooth[::step, ::step], step, (height, width)))
    at = across.reshape(-1, 3)[pixels]
    tangents = np.concatenate([_tangents(at), np.ones((len(at), 1))], -1)
    places = np.stack([pixels % width + 0.5, pixels // width + 0.5], -1)
    relative = _relative(normals, across)
    model = GltfMesh(
        points,
        small.faces,
        at,
        tangents,
        places / [width, height],
        base_color=None
        if colors is None
        else encode_image(".png", _filled(colors, ~np.isfinite(depth))),
        normal_map=encode_image(".png", _turned(relative, directx)),
    )
    up = "down (DirectX)" if directx else "up (OpenGL)"
    facts = {**facts, "faces": len(small.faces), "green": up}
    return encode_glb(model, name=name, facts=facts), facts


def printable(
    depth: np.ndarray,
    scale: Scale = _UNKNOWN,
    *,
    max_faces: int | None = None,
    longest_mm: float | None = None,
) -> tuple[bytes, dict[str, Any]]:
    """A watertight `.stl` on a base; arguments and result as of `blender_model`.

    Of the grid about `max_faces` triangles are left, a million if not given: base and
    walls add as many.
    """
    # Of a surface in parts the largest is taken. Jumps of depth become walls.
    import trimesh

    largest = _largest(depth)
    step = _step(largest, max_faces or _PRINTED_FACES)
    top = _largest_part(_without_pinches(_grid(largest, step)))
    _require_faces(top)
    points = _points(depth, top.pixels, scale)
    count = len(points)
    below = points.copy()
    below[:, 2] = points[:, 2].min() - _BASE * np.ptp(points, axis=0).max()
    points = np.concatenate([points, below])
    points, facts = _sized(points, scale.unit, "mm", longest_mm)
    edges = top.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, index, times = np.unique(
        np.sort(edges, -1), axis=0, return_index=True, return_counts=True
    )
    a, b = edges[index[times == 1]].T
    walls = np.concatenate(
        [np.stack([b, a, a + count], -1), np.stack([b, a + count, b + count], -1)]
    )
    faces = np.concatenate([top.faces, top.faces[:, ::-1] + count, walls])
    solid: Any = trimesh.Trimesh(points, faces, process=False)
    return solid.export(file_type="stl"), {**facts, "faces": len(faces)}


def _step(depth: np.ndarray, faces: int) -> int:
    """The stride of a grid of pixels that has about this many triangles at most."""
    return max(1, int(np.ceil(np.sqrt(2 * np.isfinite(depth).sum() / faces))))


def _grid(depth: np.ndarray, step: int) -> Mesh:
    """The mesh of every pixel of a grid; its pixels are numbered as those of depth."""
    few = depth[::step, ::step]
    mesh = mesh_of_depth(few, cut=None)
    row, column = np.divmod(mesh.pixels, few.shape[1])
    return mesh._replace(pixels=step * (row * depth.shape[1] + column))


def _over_jumps(
    depth: np.ndarray, mesh: Mesh, scale: Scale, cut: float, step: int
) -> np.ndarray:
    """Which triangles of a grid lie where neighbouring pixels' depths jump: `[F]`."""
    depth = _filled(depth, np.isnan(depth))  # parts beside a gap may lie apart
    pixel = scale.pixel_size if scale.focal is None else depth / scale.focal
    most = np.broadcast_to(cut * pixel, depth.shape)
    across, down = np.zeros((2, *depth.shape), bool)
    across[:, :-1] = np.abs(np.diff(depth)) > most[:, :-1]
    down[:-1] = np.abs(np.diff(depth, axis=0)) > most[:-1]
    # Cells share their borders' edges with those before them.
    jump = across | down
    jump[:-1] |= across[1:]
    jump[:, :-1] |= down[:, 1:]
    height, width = depth.shape
    jump = np.pad(jump, ((0, -height % step), (0, -width % step)))
    blocks = jump.reshape(-(-height // step), step, -1, step)
    cells = np.any(blocks, axis=(1, 3))
    corners = np.divmod(mesh.pixels[mesh.faces], width)
    row, column = (places.min(-1) // step for places in corners)
    return np.asarray(cells)[row, column]


def _require_faces(mesh: Mesh) -> None:
    if not len(mesh.faces):
        raise InputError(
            "--export: expected a surface of more than single pixels, got no triangle; "
            "give a larger mask (`unips surface`: or a larger --cut)"
        )


def _points(depth: np.ndarray, pixels: np.ndarray, scale: Scale) -> np.ndarray:
    height, width = depth.shape
    away = depth.ravel()[pixels].astype(np.float64)
    factor = scale.pixel_size if scale.focal is None else away / scale.focal
    x = (pixels % width - (width - 1) / 2) * factor
    y = ((height - 1) / 2 - pixels // width) * factor
    return np.stack([x, y, -away], -1)


def _sized(
    points: np.ndarray, unit: str, of: Literal["m", "mm"], longest_mm: float | None
) -> tuple[np.ndarray, dict[str, Any]]:
    """Points around 0 in a unit of the file, and what its size follows from."""
    points = points - (points.min(0) + points.max(0)) / 2
    longest = float(np.ptp(points, axis=0).max())
    if longest_mm is not None:
        factor = longest_mm * (0.001 if of == "m" else 1) / longest
        from_what = f"the longest side is given, {longest_mm:g} mm"
    elif unit in METRES:
        factor = METRES[unit] * (1 if of == "m" else 1000)
        from_what = f"from the scale given, in {unit}"
    else:
        side = 1 if of == "m" else 100
        factor = side / longest
        from_what = f"scale unknown: the longest side is {side} {of}"
    facts = {"unit": of, "longest_side": longest * factor, "size": from_what}
    return points * factor, facts


def _filled(values: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """Pixels without a value take the nearest one that has."""
    if not empty.any() or empty.all():
        return values
    place = scipy.ndimage.distance_transform_edt(
        empty, return_distances=False, return_indices=True
    )
    return values[tuple(place)]


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-9)


def _stretched(values: np.ndarray, step: int, size: tuple[int, int]) -> np.ndarray:
    """A grid's values at every pixel, linear between its points."""
    row, column = np.mgrid[: size[0], : size[1]].astype(np.float32) / step
    return cv2.remap(
        values, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def _tangents(normals: np.ndarray) -> np.ndarray:
    """Unit vectors along the rows of the image, in the planes of the normals."""
    # As programs derive them from texture coordinates: Blender reads no others.
    towards = np.maximum(normals[..., 2], 1e-3)
    return _unit(np.stack([towards, 0 * towards, -normals[..., 0]], -1))


def _relative(normals: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Normals in the frames of others, as the 8-bit picture of a normal map."""
    tangent = _tangents(around)
    frame = (tangent, np.cross(around, tangent), around)
    inside = np.stack([(normals * axis).sum(-1) for axis in frame], -1)
    inside[..., 2] = np.maximum(inside[..., 2], 0.02)
    return np.rint((_unit(inside) + 1) * 127.5).astype(np.uint8)


def _turned(normal_map: np.ndarray, directx: bool) -> np.ndarray:
    """With green down, for DirectX."""
    return np.where([False, directx, False], 255 - normal_map, normal_map)


def _largest(depth: np.ndarray) -> np.ndarray:
    labels, count = scipy.ndimage.label(np.isfinite(depth))
    if count < 2:
        return depth
    sizes = np.bincount(labels.ravel())[1:]
    return np.where(labels == 1 + sizes.argmax(), depth, np.nan)


def _largest_part(mesh: Mesh) -> Mesh:
    """Of a mesh in parts, as a coarse grid leaves of thin bridges, the largest."""
    if not len(mesh.faces):
        return mesh
    count = len(mesh.pixels)
    a, b = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    edges = scipy.sparse.coo_array((np.ones(len(a), bool), (a, b)), (count, count))
    _, part = scipy.sparse.csgraph.connected_components(edges, directed=False)
    return _of_faces(mesh, part[mesh.faces[:, 0]] == np.bincount(part).argmax())


def _of_faces(mesh: Mesh, kept: np.ndarray) -> Mesh:
    """The mesh of some faces `[F]`, with the vertices that these need."""
    faces = mesh.faces[kept]
    used = np.zeros(len(mesh.pixels), bool)
    used[faces.ravel()] = True
    number = np.cumsum(used) - 1
    return Mesh(mesh.vertices[used], number[faces].astype(np.int32), mesh.pixels[used])


def _without_pinches(mesh: Mesh) -> Mesh:
    """A mesh no two parts of which meet in one vertex alone: those are cut away."""
    kept = np.ones(len(mesh.faces), bool)
    while kept.any():
        faces = mesh.faces[kept]
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), -1)
        edges, times = np.unique(edges, axis=0, return_counts=True)
        ends = np.bincount(edges[times == 1].ravel(), minlength=len(mesh.pixels))
        bad = ends > 2
        if not bad.any():
            break
        kept[kept] = ~bad[faces].any(-1)
    return _of_faces(mesh, kept)
