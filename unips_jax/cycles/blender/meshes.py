"""Meshes in Blender: made, modified, swept, and read from the user's files."""

import math
from collections.abc import Callable
from typing import Any

import bmesh
import bpy
import numpy as np

_SHARP_DEG = 40.0


def new_object(mesh: Any) -> Any:
    """A mesh as an object of the scene."""
    item = bpy.data.objects.new("part", mesh)
    bpy.context.scene.collection.objects.link(item)
    return item


def new_mesh(fill: Callable[[Any], Any], *, smooth: bool = True) -> Any:
    """A mesh that `fill` makes out of an empty `bmesh`."""
    b = bmesh.new()
    fill(b)
    mesh = bpy.data.meshes.new("mesh")
    b.to_mesh(mesh)
    b.free()
    if smooth:
        mesh.shade_smooth()
    return mesh


def applied(item: Any, *modifiers: tuple[str, dict[str, Any]]) -> Any:
    """The mesh of an object after modifiers; the object goes."""
    for kind, settings in modifiers:
        modifier = item.modifiers.new(kind, kind)
        for name, value in settings.items():
            setattr(modifier, name, value)
    graph = bpy.context.evaluated_depsgraph_get()
    mesh = bpy.data.meshes.new_from_object(item.evaluated_get(graph))
    bpy.data.objects.remove(item)
    return mesh


def round_shaded(mesh: Any) -> Any:
    """Shades a mesh smoothly, but for edges of more than 40 degrees."""
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=math.radians(_SHARP_DEG))
    return mesh


def tube(points: np.ndarray, radii: np.ndarray, sides: int) -> Any:
    """A closed tube along points `[K, 3]`."""
    ahead = np.roll(points, -1, 0) - np.roll(points, 1, 0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead[0], [0.31, 0.55, 0.78])
    rings, sides_at = [], []
    for direction in ahead:  # the frame is carried along without twisting
        side = side - direction * (side @ direction)
        side /= np.linalg.norm(side)
        sides_at.append(side)
    # What the frame has turned by when it comes home is spread over the way.
    last = sides_at[-1] - ahead[0] * (sides_at[-1] @ ahead[0])
    up = np.cross(ahead[0], sides_at[0])
    twist = math.atan2(last @ up, last @ sides_at[0])
    angle = np.linspace(0, 2 * math.pi, sides, endpoint=False)
    for index, (point, direction) in enumerate(zip(points, ahead, strict=True)):
        turned = angle - twist * index / len(points)
        across = np.cross(direction, sides_at[index])
        ring = np.outer(np.cos(turned), sides_at[index])
        ring += np.outer(np.sin(turned), across)
        rings.append(point + radii[index] * ring)
    return grid(np.array(rings), closed=True)


def grid(points: np.ndarray, *, closed: bool) -> Any:
    """A mesh of a grid `[K, S, 3]` that is closed along S, and along K if asked."""
    count, sides = points.shape[:2]
    index = np.arange(count * sides).reshape(count, sides)
    ahead = np.roll(index, -1, 0) if closed else index[1:]
    here = index if closed else index[:-1]
    quads = np.stack([here, np.roll(here, -1, 1), np.roll(ahead, -1, 1), ahead], -1)
    mesh = bpy.data.meshes.new("mesh")
    faces = quads.reshape(-1, 4).tolist()
    if not closed:
        faces += [index[0][::-1].tolist(), index[-1].tolist()]
    mesh.from_pydata(points.reshape(-1, 3).tolist(), [], faces)
    return outward(mesh)


def outward(mesh: Any) -> Any:
    """Turns the faces of a closed mesh outward, and shades it."""
    b = bmesh.new()
    b.from_mesh(mesh)
    bmesh.ops.recalc_face_normals(b, faces=b.faces)
    b.to_mesh(mesh)
    b.free()
    return round_shaded(mesh)


def read_mesh(file: str) -> Any:
    """All meshes of a file that it would render, joined, in the file's own places.

    Without normals in it, other than in a .blend, they are smooth but for sharp edges.
    """
    suffix = file.rsplit(".", 1)[-1].lower()
    if suffix == "blend":
        with bpy.data.libraries.load(file) as (there, here):
            here.objects = list(there.objects)
        for item in here.objects:
            if item is not None and item.name not in bpy.context.scene.objects:
                bpy.context.scene.collection.objects.link(item)
    elif suffix in ("glb", "gltf"):  # bones would be drawn as balls
        bpy.ops.import_scene.gltf(filepath=file, disable_bone_shape=True)
    else:
        readers = {
            "obj": bpy.ops.wm.obj_import,
            "ply": bpy.ops.wm.ply_import,
            "stl": bpy.ops.wm.stl_import,
        }
        readers[suffix](filepath=file)
    graph = bpy.context.evaluated_depsgraph_get()
    parts = []
    for item in bpy.context.scene.objects:
        if item.type != "MESH" or item.hide_render:
            continue
        mesh = bpy.data.meshes.new_from_object(item.evaluated_get(graph))
        if suffix != "blend" and not mesh.has_custom_normals:
            round_shaded(mesh)
        _transform(mesh, item.matrix_world)
        if mesh.polygons:
            parts.append(mesh)
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    if not parts:
        raise ValueError(f"{file}: holds no faces")
    return _joined(parts)


def _transform(mesh: Any, matrix: Any) -> None:
    """Moves a mesh and the normals that its file gave it; `transform` does not."""
    # By face and vertex: faces that are turned have their corners in another order.
    given = {}
    if mesh.has_custom_normals and matrix.determinant():
        turn = matrix.to_3x3().inverted().transposed()
        given = {
            corner: (turn @ normal.vector).normalized()
            for corner, normal in zip(_corners(mesh), mesh.corner_normals, strict=True)
        }
    mesh.transform(matrix)
    if matrix.is_negative:
        mesh.flip_normals()
    if given:
        mesh.normals_split_custom_set([given[corner] for corner in _corners(mesh)])


def _corners(mesh: Any) -> list[tuple[int, int]]:
    """Face and vertex of every corner, in Blender's order."""
    return [(face.index, vertex) for face in mesh.polygons for vertex in face.vertices]


def _joined(parts: list[Any]) -> Any:
    """One mesh; it has texture coordinates if all of them have."""
    mapped = all(mesh.uv_layers for mesh in parts)
    b = bmesh.new()
    for mesh in parts:
        names = [
            layer.name
            for layer in mesh.uv_layers
            if not (mapped and layer.active_render)
        ]
        for name in names:
            mesh.uv_layers.remove(mesh.uv_layers[name])
        if mapped:  # of one name, or they would be several layers
            mesh.uv_layers[0].name = "UVMap"
        b.from_mesh(mesh)
    # What belongs to no face would count where the object is fitted to the frame.
    loose = [vertex for vertex in b.verts if not vertex.link_faces]
    if loose and b.faces:
        bmesh.ops.delete(b, geom=loose, context="VERTS")
    mesh = bpy.data.meshes.new("mesh")
    b.to_mesh(mesh)
    b.free()
    return mesh
