"""A surface for a purpose: a model for Blender and games, a solid to print, an archive.

The model (`.glb`) is a coarse grid of the surface with normals, texture coordinates and
a material: base colour, and a normal map that gives back every pixel's normal. It is in
metres; without a known scale its longest side is 1 m. The solid (`.stl`) stands on a
base, is watertight, and in millimetres; without a known scale its longest side is
100 mm.
"""

import io
import zipfile
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import scipy.ndimage

from unips_jax.errors import InputError
from unips_jax.io.images import encode_image
from unips_jax.surface.gltf import GltfMesh, encode_glb
from unips_jax.surface.mesh import METRES, Mesh, mesh_of_depth

Export = Literal["blender", "print", "archive"]

_FACES = 100_000
_BASE = 0.04  # of the longest side

_WHAT = {
    ".glb": "the surface with a material, for Blender and games, in metres",
    ".stl": "the surface as a solid on a base, to print, in millimetres",
    "normals.png": "normal map, 16 bits: x right, y up (OpenGL), z to the viewer",
    "normals.npy": "the normals as an array [H, W, 3], float32, 0: no surface",
    "normals.exr": "the normals as an image of floats",
    "normals.mat": "the normals for MATLAB, key Normal_est",
    "normals.json": "how the normals came about: photographs, weights, options",
    "sheet.png": "photographs and normals on one sheet",
    "mask.png": "where the object is",
    "depth.exr": "depth, float32, away from the viewer; NaN: no surface",
    "depth.png": "depth, 16 bits: 1 nearest, 65535 farthest, 0 no surface",
    "height.png": "height for displacement, 16 bits: 65535 nearest",
    "surface.json": "camera, unit and scale of the depth",
    "mesh.glb": "the surface with the photographs' colours",
    "mesh.ply": "the surface with the photographs' colours",
    "mesh.obj": "the surface with the photographs' colours",
    "view.html": "a page to look at all of it in a browser, without a network",
    "lights.json": "each photograph's light; its conventions are in the file",
    "lights.lp": "the lights' directions, as RTI software reads them",
    "base_color.exr": "base colour, linear, up to one factor",
    "base_color.png": "base colour, 16 bits, sRGB",
    "relight.ptm": "a polynomial texture map, for RTI viewers",
    "info.json": "the texture map for web pages, with plane_0.jpg to plane_5.jpg",
    "confidence.exr": "spread of the normals in degrees; NaN: no surface",
    "confidence.png": "spread of the normals, hundredths of degrees, 16 bits",
    "unreliable.png": "white where the normals are not to be trusted",
}


class Scale(NamedTuple):
    """What depth means."""

    focal: float | None = None  # in pixels; None for an orthographic camera
    pixel_size: float = 1.0  # side of a pixel in depth's unit; orthographic only
    unit: str = "pixels"  # of the depth; m, cm and mm are known


_UNKNOWN = Scale()


def blender_model(
    depth: np.ndarray,
    normals: np.ndarray,
    scale: Scale = _UNKNOWN,
    *,
    name: str,
    colors: np.ndarray | None = None,
    max_faces: int | None = None,
) -> tuple[bytes, dict[str, Any]]:
    """A `.glb` with normals, texture coordinates, base colour and normal map.

    Returns its content, and for the record its size and number of triangles.

    Args:
        depth: `[H, W]`, NaN where there is no surface, at least a triangle.
        normals: `[H, W, 3]`, unit or 0.
        scale: of the depth.
        name: of the object.
        colors: `[H, W, 3]`, uint8, sRGB.
        max_faces: of the grid, 100,000 if not given.
    """
    height, width = depth.shape
    most = max_faces or _FACES
    step = max(2, int(np.ceil(np.sqrt(2 * np.isfinite(depth).sum() / most))))
    coarse = np.full_like(depth, np.nan)
    coarse[::step, ::step] = depth[::step, ::step]
    small = mesh_of_depth(coarse[::step, ::step], cut=None)
    _require_faces(small)
    row, column = np.divmod(small.pixels, coarse[::step, ::step].shape[1])
    pixels = step * row * width + step * column
    points = _points(depth, pixels, scale)
    points, facts = _sized(points, scale.unit, METRES.get(scale.unit), 1.0, "m")
    # What the map is relative to, at the vertices and between them.
    smooth = _filled(normals)
    smooth = cv2.blur(smooth, (2 * step + 1, 2 * step + 1))
    across = _unit(_stretched(smooth[::step, ::step], step, (height, width)))
    at = across.reshape(-1, 3)[pixels]
    tangents = np.concatenate([_tangents(at), np.ones((len(at), 1))], -1)
    places = np.stack([pixels % width + 0.5, pixels // width + 0.5], -1)
    model = GltfMesh(
        points,
        small.faces,
        at,
        tangents,
        places / [width, height],
        base_color=None if colors is None else encode_image(".png", _filled(colors)),
        normal_map=encode_image(".png", _relative(_filled(normals), across)),
    )
    facts = {**facts, "faces": len(small.faces)}
    return encode_glb(model, name=name, facts=facts), facts


def printable(
    depth: np.ndarray, scale: Scale = _UNKNOWN
) -> tuple[bytes, dict[str, Any]]:
    """A watertight `.stl` on a base; arguments and result as of `blender_model`.

    Of a surface in parts the largest is taken. Jumps of depth become walls.
    """
    import trimesh

    top = _without_pinches(mesh_of_depth(_largest(depth), cut=None))
    _require_faces(top)
    points = _points(depth, top.pixels, scale)
    known = METRES.get(scale.unit)
    points, facts = _sized(points, scale.unit, known and 1000 * known, 100.0, "mm")
    count = len(points)
    below = points.copy()
    below[:, 2] = points[:, 2].min() - _BASE * np.ptp(points, axis=0).max()
    edges = top.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, index, times = np.unique(
        np.sort(edges, -1), axis=0, return_index=True, return_counts=True
    )
    a, b = edges[index[times == 1]].T
    walls = np.concatenate(
        [np.stack([b, a, a + count], -1), np.stack([b, a + count, b + count], -1)]
    )
    faces = np.concatenate([top.faces, top.faces[:, ::-1] + count, walls])
    solid: Any = trimesh.Trimesh(np.concatenate([points, below]), faces, process=False)
    return solid.export(file_type="stl"), {**facts, "faces": len(faces)}


def archive(name: str, files: list[Path]) -> bytes:
    """A ZIP of files with the object's name in theirs, and a text on each."""
    lines = [f"{name}: normals by unips_jax, and what follows from them.", ""]
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as packed:
        for file in files:
            own = file.name in (f"{name}.glb", f"{name}.stl")
            title = file.name if own else f"{name}-{file.name}"
            packed.write(file, f"{name}/{title}")
            what = _WHAT.get(file.suffix if own else file.name)
            if what is not None:
                lines.append(f"{title}: {what}")
        packed.writestr(f"{name}/{name}-README.txt", "\n".join(lines) + "\n")
    return data.getvalue()


def _require_faces(mesh: Mesh) -> None:
    if not len(mesh.faces):
        raise InputError(
            "--export: expected a surface of more than single pixels, got no triangle; "
            "give a larger mask"
        )


def _points(depth: np.ndarray, pixels: np.ndarray, scale: Scale) -> np.ndarray:
    height, width = depth.shape
    away = depth.ravel()[pixels].astype(np.float64)
    factor = scale.pixel_size if scale.focal is None else away / scale.focal
    x = (pixels % width - (width - 1) / 2) * factor
    y = ((height - 1) / 2 - pixels // width) * factor
    return np.stack([x, y, -away], -1)


def _sized(
    points: np.ndarray, unit: str, factor: float | None, side: float, of: str
) -> tuple[np.ndarray, dict[str, Any]]:
    """Points around 0 in a unit of the file, and what its size follows from."""
    points = points - (points.min(0) + points.max(0)) / 2
    longest = float(np.ptp(points, axis=0).max())
    from_what = f"from the scale given, in {unit}"
    if factor is None:
        factor = side / longest
        from_what = f"scale unknown: the longest side is {side:g} {of}"
    facts = {"unit": of, "longest_side": longest * factor, "size": from_what}
    return points * factor, facts


def _filled(values: np.ndarray) -> np.ndarray:
    """Pixels without a value (0) take the nearest one that has."""
    empty = ~(values != 0).any(-1)
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
    """Unit vectors to the right, in the planes of the normals."""
    along = np.array([1.0, 0.0, 0.0]) - normals[..., :1] * normals
    return _unit(along)


def _relative(normals: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Normals in the frames of others, as the 8-bit picture of a normal map."""
    tangent = _tangents(around)
    frame = (tangent, np.cross(around, tangent), around)
    inside = np.stack([(normals * axis).sum(-1) for axis in frame], -1)
    inside[..., 2] = np.maximum(inside[..., 2], 0.02)
    return np.rint((_unit(inside) + 1) * 127.5).astype(np.uint8)


def _largest(depth: np.ndarray) -> np.ndarray:
    labels, count = scipy.ndimage.label(np.isfinite(depth))
    if count < 2:
        return depth
    sizes = np.bincount(labels.ravel())[1:]
    return np.where(labels == 1 + sizes.argmax(), depth, np.nan)


def _without_pinches(mesh: Mesh) -> Mesh:
    """A mesh no two parts of which meet in one vertex alone: those are cut away."""
    faces = mesh.faces
    while len(faces):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), -1)
        edges, times = np.unique(edges, axis=0, return_counts=True)
        ends = np.bincount(edges[times == 1].ravel(), minlength=len(mesh.pixels))
        bad = ends > 2
        if not bad.any():
            break
        faces = faces[~bad[faces].any(-1)]
    used = np.zeros(len(mesh.pixels), bool)
    used[faces.ravel()] = True
    number = np.cumsum(used) - 1
    return Mesh(mesh.vertices[used], number[faces].astype(np.int32), mesh.pixels[used])
