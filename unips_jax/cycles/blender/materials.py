"""Principled materials: procedural ones of the paper's six categories, and the user's.

Base colour, roughness and metallic vary in space; the geometry's normals stay the true
ones (no bump or normal maps). All three also go to passes of their own, for the truth
files.
"""

import colorsys
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

Generator = np.random.Generator
INPUTS = {"baseColor": "Base Color", "roughness": "Roughness", "metal": "Metallic"}


class Graph:
    """Adds shader nodes to a material; sockets are passed around."""

    def __init__(self, tree: Any, scale: float) -> None:
        """Starts with the object's coordinates, of about 1, times `scale`."""
        self.tree = tree
        coordinates = tree.nodes.new("ShaderNodeTexCoord")
        mapping = tree.nodes.new("ShaderNodeMapping")
        mapping.inputs["Scale"].default_value = (scale,) * 3
        tree.links.new(coordinates.outputs["Object"], mapping.inputs["Vector"])
        self.where = mapping.outputs[0]

    def node(self, kind: str, inputs: dict[Any, Any], **settings: Any) -> Any:
        """A node; inputs are sockets or values, settings are its fields."""
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for name, value in settings.items():
            setattr(node, name, value)
        for name, value in inputs.items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        return node

    def noise(self, scale: float, detail: float = 4.0, distortion: float = 0.0) -> Any:
        """Fractal noise about 0.5."""
        inputs = {
            "Vector": self.where,
            "Scale": scale,
            "Detail": detail,
            "Distortion": distortion,
        }
        return self.node("TexNoise", inputs).outputs[0]

    def wave(self, scale: float, axis: str, distortion: float) -> Any:
        """Parallel sine waves in [0, 1]."""
        inputs = {"Vector": self.where, "Scale": scale, "Distortion": distortion}
        return self.node("TexWave", inputs, bands_direction=axis).outputs["Fac"]

    def cells(self, scale: float) -> Any:
        """Distance to the nearest of random points."""
        inputs = {"Vector": self.where, "Scale": scale}
        return self.node("TexVoronoi", inputs).outputs["Distance"]

    def between(self, factor: Any, low: float, high: float) -> Any:
        """Maps [0.3, 0.7] to `[low, high]`, clamped."""
        inputs = {
            "Value": factor,
            "From Min": 0.3,
            "From Max": 0.7,
            "To Min": low,
            "To Max": high,
        }
        return self.node("MapRange", inputs).outputs[0]

    def times(self, a: Any, b: Any) -> Any:
        """A product of two numbers."""
        return self.node("Math", {0: a, 1: b}, operation="MULTIPLY").outputs[0]

    def ramp(self, factor: Any, colors: list[Any], low: float = 0.3) -> Any:
        """Colours one after another as the factor goes from `low` to 1 - `low`."""
        node = self.node("ValToRGB", {"Fac": factor})
        elements = node.color_ramp.elements
        places = np.linspace(low, 1 - low, len(colors))
        while len(elements) < len(colors):
            elements.new(0.5)
        for element, place, color in zip(elements, places, colors, strict=True):
            element.position, element.color = place, (*color, 1.0)
        return node.outputs["Color"]


def _color(
    rng: Generator, hue: tuple[float, float], saturation: float, value: float
) -> tuple[float, float, float]:
    h = rng.uniform(*hue) % 1.0
    s = float(np.clip(saturation * rng.uniform(0.7, 1.3), 0, 1))
    v = float(np.clip(value * rng.uniform(0.6, 1.4), 0.02, 0.95))
    return colorsys.hsv_to_rgb(h, s, v)


def _fabric(g: Graph, rng: Generator) -> dict[str, Any]:
    scale = rng.uniform(2, 6)
    weave = g.times(g.wave(scale, "X", 1.0), g.wave(scale, "Y", 1.0))
    hue = rng.uniform()
    other = (hue + rng.uniform(0, 0.5), hue + 0.5)
    saturation, value = rng.uniform(0.1, 0.8), rng.uniform(0.15, 0.7)
    colors = [_color(rng, (hue, hue), saturation, value)]
    colors += [_color(rng, other, saturation, value)]
    rough = g.between(g.noise(3.0), 0.75, 1.0)
    return {"Base Color": g.ramp(weave, colors, 0.1), "Roughness": rough}


def _concrete(g: Graph, rng: Generator) -> dict[str, Any]:
    spots = g.noise(rng.uniform(2, 5), 10.0, rng.uniform(0, 1))
    hue = (0.06, 0.14)
    colors = [_color(rng, hue, 0.1, v) for v in (0.18, 0.4, 0.55)]
    rough = g.between(g.noise(8.0), 0.6, 0.95)
    return {"Base Color": g.ramp(spots, colors), "Roughness": rough}


def _wood(g: Graph, rng: Generator) -> dict[str, Any]:
    rings = g.wave(rng.uniform(1.5, 5), "X", rng.uniform(3, 12))
    colors = [_color(rng, (0.04, 0.1), 0.6, v) for v in (0.12, 0.35, 0.5)]
    rough = g.between(rings, rng.uniform(0.25, 0.5), rng.uniform(0.5, 0.8))
    return {"Base Color": g.ramp(rings, colors, 0.1), "Roughness": rough}


def _floor(g: Graph, rng: Generator) -> dict[str, Any]:
    hue = rng.uniform()
    tiles = [
        (*_color(rng, (hue, hue + 0.1), rng.uniform(0, 0.5), 0.5), 1.0)
        for _ in range(2)
    ]
    joint = (*_color(rng, (0.05, 0.12), 0.1, 0.2), 1.0)
    inputs = {
        "Vector": g.where,
        "Color1": tiles[0],
        "Color2": tiles[1],
        "Mortar": joint,
        "Scale": rng.uniform(1.5, 4),
        "Mortar Size": rng.uniform(0.01, 0.03),
    }
    brick = g.node("TexBrick", inputs)
    worn = g.noise(4.0)
    low, high = rng.uniform(0.08, 0.3), rng.uniform(0.3, 0.6)
    return {"Base Color": brick.outputs[0], "Roughness": g.between(worn, low, high)}


def _ground(g: Graph, rng: Generator) -> dict[str, Any]:
    soil = g.noise(rng.uniform(3, 8), 12.0, rng.uniform(0.5, 2))
    colors = [_color(rng, (0.04, 0.28), 0.5, v) for v in (0.08, 0.2, 0.3, 0.4)]
    return {
        "Base Color": g.ramp(soil, colors),
        "Roughness": g.between(g.cells(12.0), 0.8, 1.0),
    }


def _metal(g: Graph, rng: Generator) -> dict[str, Any]:
    hue, saturation, value = [
        (0.1, 0.05, 0.6),
        (0.11, 0.6, 0.8),
        (0.05, 0.6, 0.7),
        (0.6, 0.1, 0.4),
    ][int(rng.integers(4))]
    bare = _color(rng, (hue, hue + 0.02), saturation, value)
    rough = g.between(
        g.noise(rng.uniform(2, 9), 6.0), rng.uniform(0.15, 0.3), rng.uniform(0.35, 0.6)
    )
    if rng.random() < 0.6:
        stained = tuple(0.6 * c for c in bare)
        color = g.ramp(g.noise(3.0), [bare, stained])
        return {"Base Color": color, "Roughness": rough, "Metallic": 1.0}
    rust = _color(rng, (0.03, 0.07), 0.7, 0.25)
    patches = g.noise(2.0, 8.0, 0.5)
    return {
        "Base Color": g.ramp(patches, [bare, rust], 0.45),
        "Roughness": g.ramp(patches, [(0.3,) * 3, (0.8,) * 3], 0.45),
        "Metallic": g.ramp(patches, [(1.0,) * 3, (0.0,) * 3], 0.45),
    }


CATEGORIES: dict[str, Callable[[Graph, Generator], dict[str, Any]]] = {
    "Fabric": _fabric,
    "Concrete": _concrete,
    "Wood": _wood,
    "Floor": _floor,
    "Ground": _ground,
    "Metal": _metal,
}


def _maps(g: Graph, mesh: Any, files: dict[str, str]) -> dict[str, Any]:
    """The user's pictures: by the mesh's own coordinates, or else from three sides."""
    found: dict[str, Any] = {}
    packed: dict[str, Any] = {}
    for name, file in files.items():
        picture = bpy.data.images.load(file)
        spaces = {"baseColor": "sRGB"}
        if not file.lower().endswith((".exr", ".hdr")):
            picture.colorspace_settings.name = spaces.get(name, "Non-Color")
        node = g.node("TexImage", {}, image=picture)
        if mesh.uv_layers:
            where = g.node("TexCoord", {}).outputs["UV"]
        else:
            node.projection, node.projection_blend = "BOX", 0.3
            where = g.where
        g.tree.links.new(where, node.inputs["Vector"])
        if name == "packed":
            parts = g.node("SeparateColor", {"Color": node.outputs["Color"]}).outputs
            packed = {"Roughness": parts["Green"], "Metallic": parts["Blue"]}
        else:
            found[INPUTS[name]] = node.outputs["Color"]
    return packed | found


def build(
    mesh: Any,
    category: str = "",
    seed: int = 0,
    maps: dict[str, str] | None = None,
    uniform: dict[str, Any] | None = None,
) -> Any:
    """Makes a `bpy` material for a mesh.

    Args:
        category: a key of `CATEGORIES`.
        seed: of a procedural material.
        maps: picture files for some of `baseColor`, `roughness`, `metal` instead, or
            `packed`: roughness in green and metal in blue, as in glTF.
        uniform: values of the Principled BSDF's inputs instead, or `{"diffuse": RGB}`
            for a Lambertian surface.
    """
    material = bpy.data.materials.new(category or "material")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    rng = np.random.default_rng(seed)
    graph = Graph(tree, rng.uniform(0.8, 2.0))
    if uniform is not None:
        values = {k: (*v, 1.0) if k == "Base Color" else v for k, v in uniform.items()}
    elif maps:
        values = {"Roughness": 0.5, "Metallic": 0.0} | _maps(graph, mesh, maps)
    else:
        values = {"Metallic": 0.0} | CATEGORIES[category](graph, rng)
    if uniform and "diffuse" in uniform:
        color = (*uniform["diffuse"], 1.0)
        bsdf = graph.node("BsdfDiffuse", {"Color": color})
        values = {"Base Color": color, "Roughness": 1.0, "Metallic": 0.0}
    else:
        # The paper's Blender: one scattering per facet.
        bsdf = graph.node("BsdfPrincipled", values, distribution="GGX")
    graph.node("OutputMaterial", {"Surface": bsdf.outputs[0]})
    for name, socket in INPUTS.items():
        kind = "Color" if name == "baseColor" else "Value"
        graph.node("OutputAOV", {kind: values[socket]}, aov_name=name)
    return material
