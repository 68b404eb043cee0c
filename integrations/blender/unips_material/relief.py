"""Images, mesh and material in Blender."""

from pathlib import Path

import bpy
import numpy as np

VERTICES = 250_000  # of a mesh, at most about


def load(path: Path, *, color: bool) -> bpy.types.Image:
    """Loads an image of colours, in sRGB, or of values that are taken as they are.

    Raises:
        RuntimeError: if Blender cannot read it.
    """
    image = bpy.data.images.load(str(path), check_existing=True)
    image.colorspace_settings.name = "sRGB" if color else "Non-Color"
    return image


def pixels_of(image: bpy.types.Image) -> np.ndarray:
    """`[H, W, 3]`, float32, as stored, row 0 at the bottom."""
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(height, width, 4)[..., :3]


def make_object(
    name: str,
    pictures: dict[str, bpy.types.Image],
    surface: dict,
    *,
    roughness: float,
    strength: float,
    solid: bool,
) -> bpy.types.Object:
    """A mesh where there is a surface, with its relief and the material.

    Args:
        name: of object, mesh and material.
        pictures: "normals", "height", "depth" and "base_color".
        surface: what the results' record says of the depth.
        roughness: of the material.
        strength: of the relief.
        solid: the mesh itself has the relief, in perspective if the depth is; else a
            modifier makes it from the heights.
    """
    inside = np.linalg.norm(pixels_of(pictures["normals"]) * 2 - 1, axis=-1) > 0.5
    places = _places(inside.shape)
    if solid:
        depth, there = _depth(pictures["depth"], surface)
        inside = inside & there
        places = _solid(depth, surface, strength)
    mesh = _grid(name, inside, places)
    mesh.materials.append(_material(name, pictures, roughness))
    made = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(made)
    if not solid:
        reach = (surface["far"] - surface["near"]) / _pixel(surface)
        _displace(made, pictures["height"], strength * reach * 2 / max(inside.shape))
    return made


def camera_distance(surface: dict, size: tuple[int, ...]) -> float:
    """How far the lens is from the plane z = 0, where two units are the longer side."""
    return 2 * surface["focal_px"] / max(size)


def _pixel(surface: dict) -> float:
    """A pixel's side in the depth's unit, at the middle depth."""
    if surface.get("focal_px") is None:
        return surface.get("scale", 1)
    return (surface["near"] + surface["far"]) / 2 / surface["focal_px"]


def _depth(image: bpy.types.Image, surface: dict) -> tuple[np.ndarray, np.ndarray]:
    """Depth in the record's unit, row 0 at the bottom, and where there is one."""
    levels = np.rint(pixels_of(image)[..., 0] * 65535)
    share = (levels - 1) / 65534
    return surface["near"] + share * (surface["far"] - surface["near"]), levels > 0


def _places(shape: tuple[int, ...]) -> np.ndarray:
    """Pixels' centres in the plane z = 0, `[H, W, 3]`: the longer side is 2."""
    height, width = shape
    y, x = np.meshgrid(
        np.arange(height) + 0.5 - height / 2,
        np.arange(width) + 0.5 - width / 2,
        indexing="ij",
    )
    return np.stack([x, y, np.zeros_like(x)], -1) * 2 / max(shape)


def _solid(depth: np.ndarray, surface: dict, strength: float) -> np.ndarray:
    """Pixels' places on the surface, whose middle depth lies at z = 0."""
    places = _places(depth.shape)
    middle = (surface["near"] + surface["far"]) / 2
    focal = surface.get("focal_px")
    if focal is None:
        heights = strength * (middle - depth) / _pixel(surface)
        places[..., 2] = heights * 2 / max(depth.shape)
        return places
    distance = camera_distance(surface, depth.shape)
    share = 1 + strength * (depth / middle - 1)  # of the middle depth
    return np.stack(
        [
            places[..., 0] * share,
            places[..., 1] * share,
            distance * (1 - share),
        ],
        -1,
    )


def _displace(made: bpy.types.Object, heights: bpy.types.Image, strength: float):
    name = made.name
    texture = bpy.data.textures.new(f"{name} height", "IMAGE")
    texture.image = heights
    texture.use_interpolation = False  # outside, height is 0
    texture.extension = "EXTEND"
    displace = made.modifiers.new("Relief", "DISPLACE")
    displace.texture, displace.texture_coords = texture, "UV"
    displace.direction, displace.mid_level = "Z", 0
    displace.strength = strength


def _grid(name: str, inside: np.ndarray, places: np.ndarray) -> bpy.types.Mesh:
    """Vertices at every few pixels' places, and faces whose corners are inside."""
    height, width = inside.shape
    step = max(1, int(np.ceil((inside.sum() / VERTICES) ** 0.5)))
    rows, columns = (
        np.arange(step // 2, height, step),
        np.arange(step // 2, width, step),
    )
    there = inside[np.ix_(rows, columns)]
    index = np.where(there, np.cumsum(there).reshape(there.shape) - 1, -1)
    corners = np.stack(
        [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], -1
    ).reshape(-1, 4)
    faces = corners[(corners >= 0).all(-1)]  # counter-clockwise from +Z
    y, x = np.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
    x, y = x[there], y[there]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(places[np.ix_(rows, columns)][there].tolist(), [], faces.tolist())
    uv = np.stack([x / width, y / height], -1)[faces.ravel()]
    mesh.uv_layers.new(name="UVMap").data.foreach_set(
        "uv", uv.astype(np.float32).ravel()
    )
    mesh.shade_smooth()
    return mesh


def _material(
    name: str, pictures: dict[str, bpy.types.Image], roughness: float
) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0):  # later materials always have nodes
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = roughness
    images = {}
    for key, label, place in (
        ("base_color", "Base Color", (-700, 300)),
        ("normals", "Normals", (-700, -100)),
    ):
        node = images[key] = nodes.new("ShaderNodeTexImage")
        node.image, node.label, node.location = pictures[key], label, place
        node.extension = "EXTEND"
    # The normals are those of the displaced surface in the object's own frame: as
    # tangents' they would be added to those that the displacement makes.
    normal_map = nodes.new("ShaderNodeNormalMap")
    normal_map.space, normal_map.location = "OBJECT", (-300, -100)
    links.new(images["base_color"].outputs["Color"], shader.inputs["Base Color"])
    links.new(images["normals"].outputs["Color"], normal_map.inputs["Color"])
    links.new(normal_map.outputs["Normal"], shader.inputs["Normal"])
    return material
