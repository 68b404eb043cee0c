"""Renders on request: one JSON object per line on standard input, one per answer.

Requests: `{"do": NAME, ...}` with the keyword arguments of `Studio.NAME`. Answers:
`{"ok": RESULT}` or `{"error": TEXT}`. Pictures are EXR files at the request's `path`.

World axes are the camera's: x right, y up, z towards the viewer; the object is around
the origin and its outline reaches the frame's edge at +-1. `Studio` keeps the object
between requests.
"""

import json
import os
import sys
import traceback
from typing import Any

# Blender prints from C++ to file descriptor 1, some versions while they are imported.
_ANSWERS = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)

import bpy  # noqa: E402
import numpy as np  # noqa: E402
from mathutils import Matrix, Quaternion, Vector  # noqa: E402

from . import framing, materials, shapes  # noqa: E402

PASSES = ("baseColor", "roughness", "metal")


class Studio:
    """One object, one camera, and lights that change from picture to picture."""

    def __init__(self, threads: int = 0) -> None:
        """Waits for `build`; 0 threads are all cores."""
        self.threads = threads

    def version(self) -> dict[str, str]:
        """Names of what renders."""
        return {"blender": bpy.app.version_string, "numpy": np.__version__}

    def environments(self) -> list[str]:
        """The environment pictures that come with Blender (CC0)."""
        folder = os.path.join(bpy.utils.system_resource("DATAFILES"), "studiolights")
        folder = os.path.join(folder, "world")
        return sorted(
            os.path.join(folder, n) for n in os.listdir(folder) if n.endswith(".exr")
        )

    def build(self, shape: dict[str, Any], material: dict[str, Any]) -> int:
        """Starts an empty file with one object; returns its number of vertices."""
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        mesh = shapes.build(**shape)
        self.object = bpy.data.objects.new("object", mesh)
        scene.collection.objects.link(self.object)
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        self.points = points.reshape(-1, 3).astype(np.float64)
        if not (len(self.points) and np.isfinite(self.points).all()):
            raise ValueError("the mesh has no vertices, or some are not finite")
        self.points -= (self.points.min(0) + self.points.max(0)) / 2
        self.points /= np.linalg.norm(self.points, axis=1).max()
        mesh.vertices.foreach_set("co", self.points.astype(np.float32).ravel())
        mesh.update()
        mesh.materials.clear()
        mesh.materials.append(materials.build(mesh=mesh, **material))
        for polygon in mesh.polygons:
            polygon.material_index = 0
        world = scene.world = bpy.data.worlds.new("world")
        world.use_nodes = True
        camera = bpy.data.cameras.new("camera")
        camera.sensor_width = framing.FRAME_MM
        scene.camera = bpy.data.objects.new("camera", camera)
        scene.collection.objects.link(scene.camera)
        _settings(scene, self.threads)
        return len(self.points)

    def place(self, rotation: list[float], focal_mm: float | None) -> bool:
        """Turns the object (w first) and fits it to the frame; whether that works."""
        turned = self.points @ np.array(Quaternion(rotation).to_matrix()).T
        camera = bpy.context.scene.camera
        if focal_mm is None:
            camera.data.type, camera.data.ortho_scale = "ORTHO", 2.0
        else:
            camera.data.type, camera.data.lens = "PERSP", focal_mm
        camera.data.clip_start, camera.data.clip_end = 0.01, 100.0
        camera.location = (0, 0, framing.camera_distance(focal_mm))
        scale, offset, fits = framing.fit(turned, focal_mm)
        matrix = Quaternion(rotation).to_matrix().to_4x4()
        self.object.matrix_world = (
            Matrix.Translation(Vector(offset)) @ matrix @ Matrix.Scale(scale, 4)
        )
        return fits

    def truth(self, path: str, size: int) -> None:
        """Writes normals, depth and material at pixels' centres, as a layered EXR."""
        scene = bpy.context.scene
        layer = scene.view_layers[0]
        layer.use_pass_normal = layer.use_pass_z = True
        scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
        _file_format(scene, "OPEN_EXR_MULTILAYER")
        self._world(None)
        self._lamps([])
        _render(path, size=size, samples=1, denoise=False, seed=0)
        layer.use_pass_normal = layer.use_pass_z = False

    def image(
        self,
        path: str,
        size: int,
        samples: int,
        denoise: bool,
        seed: int,
        lamps: list[dict[str, Any]],
        environment: dict[str, Any] | None = None,
    ) -> None:
        """Writes one photograph, linear RGBA, premultiplied.

        Args:
            path: of an EXR file.
            size: side in pixels.
            samples: paths per pixel.
            denoise: with Open Image Denoise.
            seed: of the paths.
            lamps: `{"kind": "sun", "direction", "irradiance"}` (towards the lamp; W/m^2
                per channel on a surface that faces it) or `{"kind": "area",
                "position", "power", "side"}` (W per channel, facing the origin).
            environment: `{"file", "rotation", "strength"}`, Euler angles in radians
                from the world to the picture's axes; or `{"color"}`, the same from
                everywhere.
        """
        scene = bpy.context.scene
        scene.cycles.pixel_filter_type = "BLACKMAN_HARRIS"
        scene.cycles.filter_width = 1.5
        _file_format(scene, "OPEN_EXR")
        self._world(environment)
        self._lamps(lamps)
        _render(path, size=size, samples=samples, denoise=denoise, seed=seed)

    def _lamps(self, lamps: list[dict[str, Any]]) -> None:
        for old in [o for o in bpy.data.objects if o.type == "LIGHT"]:
            bpy.data.lights.remove(old.data)
        for lamp in lamps:
            sun = lamp["kind"] == "sun"
            light = bpy.data.lights.new("lamp", "SUN" if sun else "AREA")
            power = np.array(lamp["irradiance" if sun else "power"], float)
            light.energy = max(power.max(), 1e-12)
            light.color = power / light.energy
            towards = Vector(lamp["direction" if sun else "position"])
            if sun:
                light.angle = 0.0
            else:
                light.size = lamp["side"]
            item = bpy.data.objects.new("lamp", light)
            item.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()
            if not sun:
                item.location = towards
            bpy.context.scene.collection.objects.link(item)

    def _world(self, environment: dict[str, Any] | None) -> None:
        world = bpy.context.scene.world
        tree = world.node_tree
        tree.nodes.clear()
        background = tree.nodes.new("ShaderNodeBackground")
        output = tree.nodes.new("ShaderNodeOutputWorld")
        tree.links.new(background.outputs[0], output.inputs[0])
        color = (environment or {}).get("color", (0, 0, 0))
        background.inputs["Color"].default_value = (*color, 1)
        if environment and "file" in environment:
            where = tree.nodes.new("ShaderNodeTexCoord")
            turn = tree.nodes.new("ShaderNodeMapping")
            picture = tree.nodes.new("ShaderNodeTexEnvironment")
            picture.image = bpy.data.images.load(
                environment["file"], check_existing=True
            )
            picture.image.colorspace_settings.name = "Linear Rec.709"
            turn.inputs["Rotation"].default_value = environment["rotation"]
            background.inputs["Strength"].default_value = environment["strength"]
            tree.links.new(where.outputs["Generated"], turn.inputs["Vector"])
            tree.links.new(turn.outputs[0], picture.inputs["Vector"])
            tree.links.new(picture.outputs["Color"], background.inputs["Color"])
        # A table of fixed size for sampling the lights; the automatic one costs more
        # than a small picture, for every rotation again.
        world.cycles.sampling_method = "MANUAL"
        world.cycles.sample_map_resolution = 2048
        world.update_tag()


def _settings(scene: Any, threads: int) -> None:
    if threads:
        scene.render.threads_mode, scene.render.threads = "FIXED", threads
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.max_bounces = 10
    scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = 10
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.sample_clamp_direct = 0.0
    scene.cycles.sample_clamp_indirect = 10.0
    scene.render.film_transparent = True
    scene.render.use_compositing = scene.render.use_sequencer = False
    scene.render.resolution_percentage = 100
    scene.render.use_file_extension = False
    scene.view_settings.view_transform = "Raw"
    layer = scene.view_layers[0]
    for name in PASSES:
        aov = layer.aovs.add()
        aov.name, aov.type = name, "COLOR" if name == "baseColor" else "VALUE"


def _file_format(scene: Any, name: str) -> None:
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):  # Blender 5 asks for this one first
        layered = name == "OPEN_EXR_MULTILAYER"
        settings.media_type = "MULTI_LAYER_IMAGE" if layered else "IMAGE"
    settings.file_format = name
    if hasattr(settings, "use_exr_interleave"):  # else a part for each pass
        settings.use_exr_interleave = True


def _render(path: str, *, size: int, samples: int, denoise: bool, seed: int) -> None:
    scene = bpy.context.scene
    scene.cycles.samples, scene.cycles.seed = samples, seed
    scene.cycles.use_denoising = denoise
    if denoise:
        scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)
    if not os.path.exists(path):
        raise RuntimeError(f"{path}: was not rendered")


def main() -> None:
    """Answers requests until standard input ends."""
    studio = Studio(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            result = getattr(studio, request.pop("do"))(**request)
            answer = {"ok": result}
        except Exception as error:  # the driver decides; the next object may be fine
            traceback.print_exc()
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=_ANSWERS, flush=True)


if __name__ == "__main__":
    main()
