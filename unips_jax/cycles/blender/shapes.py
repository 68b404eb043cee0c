"""Meshes: procedural solids, each a function of one seed, and files of the user.

None of them is made the way the training scenes make theirs (signed distances): these
are polygons with bevels, booleans, swept curves and displacement by textures.
"""

import math
from collections.abc import Callable
from typing import Any

import bmesh
import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector

from .meshes import applied, grid, new_mesh, new_object, read_mesh, round_shaded, tube

Generator = np.random.Generator


def build(kind: str = "", seed: int = 0, file: str = "") -> Any:
    """Makes a `bpy` mesh: a key of `KINDS`, "sphere", or a file (see `read_mesh`)."""
    if file:
        return read_mesh(file)
    if kind == "sphere":
        return new_mesh(
            lambda b: bmesh.ops.create_icosphere(b, subdivisions=8, radius=1)
        )
    return KINDS[kind](np.random.default_rng(seed))


def _primitive(rng: Generator) -> Any:
    """A box, cylinder, cone or ball with bevelled edges, about 1 in radius."""
    kind = rng.choice(["box", "cylinder", "cone", "ball"])
    size = rng.uniform(0.5, 1.0, 3)

    def fill(b: Any) -> None:
        if kind == "box":
            bmesh.ops.create_cube(b, size=1.4)
        elif kind == "ball":
            bmesh.ops.create_icosphere(b, subdivisions=6, radius=0.9)
        else:
            sides = int(rng.choice([5, 6, 8, 96]))
            top = 0.8 if kind == "cylinder" else rng.uniform(0.1, 0.5)
            ends = {"radius1": 0.8, "radius2": top, "depth": 1.6}
            bmesh.ops.create_cone(b, cap_ends=True, segments=sides, **ends)
        bmesh.ops.scale(b, vec=Vector(size), verts=b.verts)

    item = new_object(new_mesh(fill, smooth=False))
    if kind == "ball":
        return round_shaded(applied(item))
    width = rng.uniform(0.02, 0.18)
    bevel = {"width": width, "segments": 6, "limit_method": "ANGLE"}
    return round_shaded(applied(item, ("BEVEL", bevel)))


def _remeshed(item: Any, rng: Generator, *more: tuple[str, dict[str, Any]]) -> Any:
    """Even, dense polygons with softened edges."""
    remesh = {"mode": "VOXEL", "voxel_size": 0.018, "use_smooth_shade": True}
    smooth = {"factor": 0.5, "iterations": int(rng.integers(4, 14))}
    mesh = applied(item, *more, ("REMESH", remesh), ("SMOOTH", smooth))
    mesh.shade_smooth()
    return mesh


def _turn(rng: Generator) -> Any:
    return Euler(rng.uniform(-math.pi, math.pi, 3)).to_matrix().to_4x4()


def cut(rng: Generator) -> Any:
    """A solid with others cut away from it, of which enough is left."""
    while True:
        mesh = _cut(rng)
        if len(mesh.polygons) > 5000:
            return mesh


def _cut(rng: Generator) -> Any:
    body = new_object(_primitive(rng))
    tools = []
    for _ in range(int(rng.integers(2, 5))):
        tool = new_object(_primitive(rng))
        place = rng.normal(size=3)
        place *= rng.uniform(0.4, 0.8) / np.linalg.norm(place)
        shrink = Matrix.Scale(rng.uniform(0.5, 0.9), 4)
        tool.matrix_world = Matrix.Translation(Vector(place)) @ _turn(rng) @ shrink
        tools.append(tool)
    settings = [
        ("BOOLEAN", {"object": t, "operation": "DIFFERENCE", "solver": "EXACT"})
        for t in tools
    ]
    mesh = _remeshed(body, rng, *settings)
    for tool in tools:
        bpy.data.objects.remove(tool)
    return mesh


def _texture(rng: Generator, scale: float) -> Any:
    kind = str(rng.choice(["CLOUDS", "VORONOI", "MARBLE", "MUSGRAVE", "STUCCI"]))
    texture = bpy.data.textures.new("texture", kind)
    texture.noise_scale = scale
    if kind == "VORONOI":
        texture.distance_metric = "DISTANCE_SQUARED"
    if kind == "STUCCI":
        texture.turbulence = rng.uniform(3, 10)
    return texture


def displaced(rng: Generator) -> Any:
    """A ball or a ring, displaced twice."""

    def fill(b: Any) -> None:
        bmesh.ops.create_icosphere(b, subdivisions=7, radius=0.8)
        bmesh.ops.scale(b, vec=Vector(rng.uniform(0.6, 1.0, 3)), verts=b.verts)

    coarse = {
        "texture": _texture(rng, rng.uniform(0.35, 0.8)),
        "strength": rng.uniform(0.25, 0.6),
    }
    fine = {
        "texture": _texture(rng, rng.uniform(0.08, 0.2)),
        "strength": rng.uniform(0.02, 0.06),
    }
    smooth = ("SMOOTH", {"factor": 0.5, "iterations": 4})
    mesh = applied(
        new_object(new_mesh(fill)), ("DISPLACE", coarse), ("DISPLACE", fine), smooth
    )
    mesh.shade_smooth()
    return mesh


def knot(rng: Generator) -> Any:
    """A torus knot whose thickness varies."""
    p, q = [(2, 3), (3, 2), (2, 5), (3, 4), (3, 5), (1, 2)][int(rng.integers(6))]
    t = np.linspace(0, 2 * math.pi, 600, endpoint=False)
    ring = 1 + rng.uniform(0.3, 0.45) * np.cos(q * t)
    height = rng.uniform(0.3, 0.5) * np.sin(q * t)
    points = np.stack([ring * np.cos(p * t), ring * np.sin(p * t), height], -1)
    waves = np.cos(int(rng.integers(2, 9)) * t + rng.uniform(0, 6))
    radii = rng.uniform(0.1, 0.19) * (1 + rng.uniform(0, 0.35) * waves)
    return tube(points, radii, 64)


def lathe(rng: Generator) -> Any:
    """A vessel or baluster, turned; sometimes fluted."""
    knots = rng.uniform(0.2, 0.85, int(rng.integers(5, 9)))
    t = np.linspace(0, 1, 240)
    radius = np.interp(t, np.linspace(0, 1, len(knots)), knots)
    kernel = np.hanning(int(rng.choice([9, 25, 45])))
    wide = np.pad(radius, len(kernel) // 2, mode="edge")
    radius = np.convolve(wide, kernel / kernel.sum(), "valid")
    angle = np.linspace(0, 2 * math.pi, 256, endpoint=False)
    flutes = int(rng.choice([0, 0, 5, 8, 12, 20]))
    depth = rng.uniform(0.02, 0.1) if flutes else 0.0
    twist = rng.uniform(-2, 2)
    waves = np.cos(flutes * (angle[None] + twist * t[:, None]))
    around = radius[:, None] * (1 + depth * waves)
    height = np.broadcast_to(rng.uniform(1.0, 2.2) * (t[:, None] - 0.5), around.shape)
    points = np.stack([around * np.cos(angle), around * np.sin(angle), height], -1)
    return grid(points, closed=False)


def extruded(rng: Generator) -> Any:
    """A gear, star or rosette of some thickness, with bevelled edges and a hole."""
    lobes = int(rng.integers(3, 14))
    angle = np.linspace(0, 2 * math.pi, 8 * lobes, endpoint=False)
    tooth = np.cos(lobes * angle)
    if rng.random() < 0.5:
        tooth = np.sign(tooth) * np.abs(tooth) ** 0.3
    outer = 1 + rng.uniform(0.08, 0.3) * tooth
    inner = np.full_like(outer, rng.uniform(0.2, 0.5))
    thick = rng.uniform(0.15, 0.5)
    rings = [(outer, -thick), (outer, thick), (inner, thick), (inner, -thick)]
    points = np.array(
        [
            np.stack([r * np.cos(angle), r * np.sin(angle), np.full_like(r, z)], -1)
            for r, z in rings
        ]
    )
    mesh = grid(points, closed=True)
    bevel = {"width": rng.uniform(0.02, 0.09), "segments": 6, "limit_method": "ANGLE"}
    return round_shaded(applied(new_object(mesh), ("BEVEL", bevel)))


def relief(rng: Generator) -> Any:
    """A thick plate with a relief of two textures."""

    def fill(b: Any) -> None:
        bmesh.ops.create_grid(b, x_segments=300, y_segments=300, size=1)
        bmesh.ops.scale(b, vec=Vector((1, rng.uniform(0.6, 1), 1)), verts=b.verts)

    layers = [
        (rng.uniform(0.25, 0.6), rng.uniform(0.15, 0.4)),
        (rng.uniform(0.06, 0.15), rng.uniform(0.02, 0.07)),
    ]
    settings = [
        ("DISPLACE", {"texture": _texture(rng, scale), "strength": strength})
        for scale, strength in layers
    ]
    smooth = ("SMOOTH", {"factor": 0.5, "iterations": 3})
    thick = ("SOLIDIFY", {"thickness": 0.12, "offset": -1})
    return round_shaded(applied(new_object(new_mesh(fill)), *settings, smooth, thick))


def pile(rng: Generator) -> Any:
    """Bevelled solids stuck into each other."""
    parts = []
    for _ in range(int(rng.integers(5, 12))):
        part = new_object(_primitive(rng))
        place = Matrix.Translation(Vector(rng.normal(size=3) * 0.45))
        part.matrix_world = place @ _turn(rng) @ Matrix.Scale(rng.uniform(0.3, 0.7), 4)
        parts.append(part)
    b = bmesh.new()
    for part in parts:
        mesh = part.data.copy()
        mesh.transform(part.matrix_world)
        b.from_mesh(mesh)
        bpy.data.objects.remove(part)
    mesh = bpy.data.meshes.new("mesh")
    b.to_mesh(mesh)
    b.free()
    return round_shaded(mesh)


KINDS: dict[str, Callable[[Generator], Any]] = {
    "cut": cut,
    "displaced": displaced,
    "knot": knot,
    "lathe": lathe,
    "extruded": extruded,
    "relief": relief,
    "pile": pile,
}
