"""Blender add-on: photographs under changing light become a material and a relief.

File > Import > Photographs (UniPS). The command `unips estimate` of unips_jax, in an
environment of its own, makes normals, depth and base colour; the add-on makes of them a
mesh with its relief and a material with normal, colour and roughness, and if wanted
lamps of the photographs' estimated lights, one to a frame.
"""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import bpy
from bpy.props import (
    BoolProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    StringProperty,
)

from . import lights, relief

bl_info = {
    "name": "UniPS: material from photographs",
    "author": "The unips_jax authors",
    "version": (0, 4, 0),
    "blender": (4, 2, 0),
    "location": "File > Import > Photographs (UniPS)",
    "category": "Import-Export",
}


class UnipsError(RuntimeError):
    """What went wrong, in one line for the user."""


def estimate(
    photographs: Path,
    *,
    command: str,
    weights: str,
    max_images: int,
    seed: int,
    focal: str = "",
) -> Path:
    """Runs `unips estimate` on a folder of photographs.

    Args:
        photographs: the folder.
        command: how unips is called, e.g. "/opt/unips/bin/unips".
        weights: name of shipped weights, or a file.
        max_images: how many of the photographs to draw, with the seed; 0: all.
        seed: of that draw.
        focal: focal length in pixels, or "exif"; empty: an orthographic camera.

    Returns:
        The folder of results, `NAME_unips/NAME` next to the photographs.

    Raises:
        UnipsError: the command's error, or that there is none.
    """
    name = re.sub(r"\.data$", "", photographs.name)
    output = photographs.parent / f"{name}_unips"
    words = [*_words(command), "estimate", str(photographs), "-o", str(output)]
    words += ["--depth", "--base-color", "--lights", "--weights", weights]
    if max_images:
        words += ["--max-images", str(max_images), "--seed", str(seed)]
    if focal:
        words += ["--focal", focal]
    try:
        run = subprocess.run(
            words,
            env={**os.environ, "PYTHONIOENCODING": "utf-8"},
            capture_output=True,
            encoding="utf-8",
            errors="replace",
        )
    except OSError as error:
        raise UnipsError(
            f"{words[0]}: {error.strerror}; name the command of unips_jax in the "
            "add-on's preferences"
        ) from error
    if run.returncode:
        errors = [line for line in run.stderr.splitlines() if line.startswith("error:")]
        raise UnipsError(" ".join(errors) or f"unips ended with {run.returncode}")
    return output / name


def _words(command: str) -> list[str]:
    """A command's words; those with blanks are quoted, unless it is a file's path."""
    if Path(command).is_file():
        return [command]
    if sys.platform == "win32":  # in its paths backslashes are no escapes
        command = command.replace("\\", "\\\\")
    return shlex.split(command)


def build(
    result: Path,
    *,
    roughness: float,
    strength: float,
    solid: bool = False,
    lit: bool = False,
) -> bpy.types.Object:
    """Makes an object of a folder of results.

    Args:
        result: what `unips estimate --depth --base-color --lights` wrote.
        roughness: of the material; photographs are not asked for it.
        strength: of the relief; 1: true to the normals.
        solid: the mesh itself has the relief, not a modifier.
        lit: also the photographs' lights and camera.

    Returns:
        The object, in the scene: two units wide or high, facing +Z, y up.

    Raises:
        UnipsError: if files are missing.
    """
    try:
        surface = json.loads((result / "normals.json").read_bytes())["surface"]
        pictures = {
            name: relief.load(result / f"{name}.png", color=name == "base_color")
            for name in ("normals", "height", "depth", "base_color")
        }
        lamps = lights.read_lights(result / "lights.json") if lit else []
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise UnipsError(f"{result}: {error}") from error
    made = relief.make_object(
        result.name,
        pictures,
        surface,
        roughness=roughness,
        strength=strength,
        solid=solid,
    )
    if lamps:
        size = tuple(pictures["normals"].size)
        focal = surface.get("focal_px") if solid else None  # modifiers have none
        distance = relief.camera_distance(surface, size) if focal else 0
        lights.add_lights(result.name, lamps)
        lights.add_camera(result.name, size, focal=focal, distance=distance)
    return made


class Preferences(bpy.types.AddonPreferences):
    """Where unips is."""

    bl_idname = __package__

    command: StringProperty(
        name="Command",
        description="How unips is called, e.g. /opt/unips/bin/unips",
        default="unips",
    )

    def draw(self, context):
        """Shows the one field."""
        self.layout.prop(self, "command")


class ImportPhotographs(bpy.types.Operator):
    """Make a material and a relief of a folder of photographs under changing light."""

    bl_idname = "import_scene.unips"
    bl_label = "Photographs (UniPS)"
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(subtype="DIR_PATH")
    max_images: IntProperty(
        name="Images", description="How many to draw; 0: all", default=0, min=0
    )
    seed: IntProperty(name="Seed", description="Of that draw", default=0, min=0)
    roughness: FloatProperty(name="Roughness", default=0.5, min=0, max=1)
    strength: FloatProperty(
        name="Strength",
        description="Of the relief; 1: true to the normals",
        default=1,
        min=0,
    )
    relief: EnumProperty(
        name="Relief as",
        items=[
            ("MODIFIER", "Modifier", "Height moves a flat mesh; can be changed later"),
            (
                "MESH",
                "Mesh",
                "Depth places the vertices, by the focal length",
            ),
        ],
    )
    lit: BoolProperty(
        name="Lights",
        description="The photographs' lights, one to a frame, and their camera",
        default=False,
    )
    focal: StringProperty(
        name="Focal length",
        description="In pixels, or exif; empty: a camera from far away",
        default="",
    )
    weights: StringProperty(name="Weights", default="tiny")
    command: StringProperty(
        name="Command", description="Empty: the add-on's preferences", default=""
    )

    def invoke(self, context, event):
        """Asks for the folder."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        """Estimates and builds."""
        addon = context.preferences.addons.get(__package__)
        command = self.command or (addon.preferences.command if addon else "unips")
        folder = Path(bpy.path.abspath(self.directory))
        try:
            result = estimate(
                folder,
                command=command,
                weights=self.weights,
                max_images=self.max_images,
                seed=self.seed,
                focal=self.focal,
            )
            made = build(
                result,
                roughness=self.roughness,
                strength=self.strength,
                solid=self.relief == "MESH",
                lit=self.lit,
            )
        except UnipsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.view_layer.objects.active = made
        made.select_set(True)
        return {"FINISHED"}


def _menu(self, context):
    self.layout.operator(ImportPhotographs.bl_idname)


def register():
    """Called by Blender."""
    bpy.utils.register_class(Preferences)
    bpy.utils.register_class(ImportPhotographs)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister():
    """Called by Blender."""
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    bpy.utils.unregister_class(ImportPhotographs)
    bpy.utils.unregister_class(Preferences)
