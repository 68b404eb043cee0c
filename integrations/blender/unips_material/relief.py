"""Images, mesh and material in Blender."""

from pathlib import Path

import bpy
import numpy as np

VERTICES = 250_000  # of a mesh, at most about


def load(path: Path, *, color: bool) -> bpy.types.Image:
    """Loads an image.

    Args:
        path: of the file.
        color: its values are colours, in sRGB; else they are taken as they are.

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
    *,
    reach: float,
    roughness: float,
    strength: float,
) -> bpy.types.Object:
    """A mesh where there is a surface, displaced by its height, with the material.

    Args:
        name: of object, mesh and material.
        pictures: "normals", "height" and "base_color".
        reach: height of full scale, in pixels.
        roughness: of the material.
        strength: of the displacement.
    """
    heights = pixels_of(pictures["height"])[..., 0]
    inside = np.linalg.norm(pixels_of(pictures["normals"]) * 2 - 1, axis=-1) > 0.5
    mesh = _grid(name, inside)
    mesh.materials.append(_material(name, pictures, roughness))
    made = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(made)
    texture = bpy.data.textures.new(f"{name} height", "IMAGE")
    texture.image = pictures["height"]
    texture.use_interpolation = False  # outside, height is 0
    texture.extension = "EXTEND"
    displace = made.modifiers.new("Relief", "DISPLACE")
    displace.texture, displace.texture_coords = texture, "UV"
    displace.direction, displace.mid_level = "Z", 0
    displace.strength = strength * reach * 2 / max(heights.shape)
    return made


def _grid(name: str, inside: np.ndarray) -> bpy.types.Mesh:
    """Vertices at every few pixels' centres, and faces whose corners are inside."""
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
    scale = 2 / max(width, height)
    places = np.stack(
        [(x - width / 2) * scale, (y - height / 2) * scale, np.zeros_like(x)], -1
    )
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(places.tolist(), [], faces.tolist())
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
