"""The photographs' estimated lights as lamps, one to a frame, and their camera."""

import json
import math
from pathlib import Path

import bpy
from mathutils import Vector

SENSOR = 36.0  # mm, the longer side


def read_lights(path: Path) -> list[dict]:
    """What `unips estimate --lights` wrote of each photograph.

    Raises:
        OSError, ValueError, KeyError: if it is not that.
    """
    return json.loads(path.read_bytes())["photographs"]


def add_lights(name: str, photographs: list[dict]) -> bpy.types.Collection:
    """Lamps and a world: frame 1 has the light of the first photograph, and so on.

    The key light is a sun; what comes from elsewhere is taken as equal from all sides.
    Colours are scaled so that white that faces a light of 1 is white.

    Args:
        name: of the object.
        photographs: from `read_lights`.
    """
    scene = bpy.context.scene
    collection = bpy.data.collections.new(f"{name} lights")
    scene.collection.children.link(collection)
    background = _background(scene, name)
    for frame, photograph in enumerate(photographs, 1):
        color = photograph["color"]
        strength = max(*color, 1e-9)
        sun = bpy.data.lights.new(photograph["file"], "SUN")
        sun.energy, sun.angle = math.pi * strength, 0.0
        sun.color = [value / strength for value in color]
        lamp = bpy.data.objects.new(photograph["file"], sun)
        towards = Vector(photograph["direction"])
        lamp.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
        lamp.location = 3 * towards
        collection.objects.link(lamp)
        for when in (frame - 1, frame, frame + 1):
            for switch in ("hide_render", "hide_viewport"):
                setattr(lamp, switch, when != frame)
                lamp.keyframe_insert(switch, frame=when)
        # The mean over all directions, less the key's part of it.
        rest = [
            math.pi * max(0.282095 * mean - key / (4 * math.pi), 0)
            for mean, key in zip(photograph["harmonics"][0], color, strict=True)
        ]
        background.inputs["Color"].default_value = (*rest, 1)
        background.inputs["Color"].keyframe_insert("default_value", frame=frame)
    scene.frame_start, scene.frame_end = 1, len(photographs)
    scene.frame_set(1)
    return collection


def add_camera(
    name: str, size: tuple[int, int], *, focal: float | None, distance: float
) -> bpy.types.Object:
    """The scene's camera, which sees the object as the photographs do.

    Args:
        name: of the object, whose longer side is two units wide.
        size: of the photographs: width, height.
        focal: of the lens, in pixels; None: orthographic.
        distance: from the plane z = 0, of a lens.
    """
    camera = bpy.data.cameras.new(f"{name} camera")
    camera.sensor_fit = "AUTO"  # what follows is of the longer side
    if focal is None:
        camera.type, camera.ortho_scale, distance = "ORTHO", 2, 10
    else:
        camera.sensor_width = SENSOR
        camera.lens = SENSOR * focal / max(size)
    seen = bpy.data.objects.new(camera.name, camera)
    seen.location = (0, 0, distance)
    scene = bpy.context.scene
    scene.collection.objects.link(seen)
    scene.camera = seen
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    return seen


def _background(scene: bpy.types.Scene, name: str) -> bpy.types.Node:
    """The shader of a world of its own, whose colour follows the frames."""
    scene.world = bpy.data.worlds.new(f"{name} surroundings")
    if bpy.app.version < (5, 0):  # later worlds always have nodes
        scene.world.use_nodes = True
    tree = scene.world.node_tree
    return next(node for node in tree.nodes if node.type == "BACKGROUND")
