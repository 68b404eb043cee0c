"""The Blender add-on, in Blender without a window: a hemisphere, rendered by Cycles.

Needs a Python with `bpy` (`UNIPS_BPY_PYTHON`); skipped without, unless
`UNIPS_REQUIRE_BPY` is set.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from unips_jax.cli.estimate import Options
from unips_jax.console import parse
from unips_jax.cycles.blender_process import find_python
from unips_jax.errors import InputError
from unips_jax.io.normals import write_normals
from unips_jax.surface.depth_files import write_depth

ADDON = Path(__file__).resolve().parents[2] / "integrations" / "blender"
SIZE = 64

# Called by the add-on in place of `unips`: it hands out what is prepared.
COMMAND = """
import json, shutil, sys
from pathlib import Path
folder = Path(__file__).parent
(folder / "argv.json").write_text(json.dumps(sys.argv[1:]))
words = sys.argv
if "3" in words:
    sys.exit("error: something about the photographs")
output = Path(words[words.index("-o") + 1])
kind = "deep" if words[1] == "deep" else "prepared"
shutil.copytree(folder / kind, output / "ball", dirs_exist_ok=True)
"""

SCENE = """
import json, os, sys
import bpy
import numpy as np
from mathutils import Vector
addon, folder, command, output = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
sys.path.insert(0, addon)
import unips_material
unips_material.register()
try:
    bpy.ops.import_scene.unips(directory=folder, command=command, max_images=3)
    refusal = ""
except RuntimeError as error:
    refusal = str(error)
done = bpy.ops.import_scene.unips(directory=folder, command=command, roughness=1)
scene = bpy.context.scene
camera = bpy.data.cameras.new("camera")
camera.type, camera.ortho_scale = "ORTHO", 2
scene.camera = bpy.data.objects.new("camera", camera)
scene.camera.location = (0, 0, 5)
sun = bpy.data.lights.new("sun", "SUN")
sun.angle, sun.energy = 0, 2
lamp = bpy.data.objects.new("sun", sun)
turn = Vector((1, 0.5, 1)).to_track_quat("Z", "Y")
lamp.rotation_euler = turn.to_euler()
for thing in (scene.camera, lamp):
    scene.collection.objects.link(thing)
scene.world = bpy.data.worlds.new("dark")
scene.render.engine, scene.cycles.samples = "CYCLES", 4
scene.cycles.use_denoising = False
scene.render.resolution_x = scene.render.resolution_y = 64
scene.view_settings.view_transform = "Raw"
scene.render.image_settings.color_depth = "16"
scene.render.filepath = output
bpy.ops.render.render(write_still=True)
ball = bpy.context.object
moved = ball.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
heights = [vertex.co.z for vertex in moved.vertices]
facts = {"done": sorted(done), "refusal": refusal}
facts["heights"] = [min(heights), max(heights)]
facts["name"], facts["faces"] = ball.name, len(ball.data.polygons)
facts["up"] = bool(all(polygon.normal.z > 0 for polygon in ball.data.polygons))
for thing in (ball, lamp):
    bpy.data.objects.remove(thing)
facts["solid"] = []
for kind in ("flat", "deep"):
    bpy.ops.import_scene.unips(
        directory=folder, command=command + " " + kind, roughness=1, relief="MESH",
        lit=True,
    )
    scene.render.filepath = output.replace(".png", "-" + kind)
    solid = bpy.context.object
    places = np.array([vertex.co for vertex in solid.data.vertices])
    facts["solid"].append({
        "low": places.min(0).tolist(), "high": places.max(0).tolist(),
        "modifiers": len(solid.modifiers), "frames": scene.frame_end,
        "lens": scene.camera.data.type,
    })
    for frame in (1, 2):
        scene.frame_set(frame)
        scene.render.filepath = output.replace(".png", f"-{kind}-{frame}.png")
        bpy.ops.render.render(write_still=True)
    for thing in list(scene.objects):
        bpy.data.objects.remove(thing)
print("FACTS" + json.dumps(facts), flush=True)
os._exit(0)  # bpy may hang when it ends
"""


@pytest.fixture
def python():
    try:
        return find_python()
    except InputError as error:
        if os.environ.get("UNIPS_REQUIRE_BPY"):
            raise
        pytest.skip(f"bpy not importable: {error}")


def ball():
    """Normals and mask of a hemisphere of radius 0.9, as seen."""
    c = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    x, y = np.meshgrid(c / 0.9, -c / 0.9)
    mask = x * x + y * y < 0.95
    normals = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], -1)
    return np.float32(normals * mask[..., None]), mask


def prepare(folder):
    """What `unips estimate --depth --base-color` writes, half of it red."""
    normals, mask = ball()
    result, photographs = folder / "prepared", folder / "ball.data"
    result.mkdir()
    photographs.mkdir()
    write_normals(result, normals)
    depth = np.where(mask, -normals[..., 2] * 0.9 * SIZE / 2, np.nan)
    surface = write_depth(result, np.float32(depth), unit="pixels")
    color = np.where(np.arange(SIZE)[:, None, None] < SIZE // 2, [0.6, 0.2, 0.2], 0.4)
    color = np.broadcast_to(color, (SIZE, SIZE, 3))
    encoded = 1.055 * color ** (1 / 2.4) - 0.055
    cv2.imwrite(str(result / "base_color.png"), np.uint16(65535 * encoded)[..., ::-1])
    (result / "normals.json").write_text(json.dumps({"surface": surface}))
    lamps = [
        # A lamp from the right, and one from above with as much from all around.
        {"file": "a.png", "direction": [0.6, 0, 0.8], "color": [0.8, 0.8, 0.8]},
        {"file": "b.png", "direction": [0, 0.6, 0.8], "color": [0.5, 0.5, 0.5]},
    ]
    for lamp, around in zip(lamps, (0, 0.1), strict=True):
        mean = lamp["color"][0] / (4 * np.pi) + around
        lamp["harmonics"] = [[mean / 0.282095] * 3] + [[0, 0, 0]] * 8
    (result / "lights.json").write_text(json.dumps({"photographs": lamps}))
    # The same seen through a lens: a pixel at the middle depth is as large.
    shutil.copytree(result, folder / "deep")
    focal = 100.0
    deep = (depth - np.nanmean([np.nanmin(depth), np.nanmax(depth)])) / focal + 1
    surface = write_depth(folder / "deep", np.float32(deep), unit="mean distances")
    surface |= {"focal_px": focal, "scale": 1.0}
    (folder / "deep" / "normals.json").write_text(json.dumps({"surface": surface}))
    return photographs


def test_photographs_become_a_material_and_a_relief(python, tmp_path):
    photographs = prepare(tmp_path)
    (tmp_path / "command.py").write_text(COMMAND)
    (tmp_path / "scene.py").write_text(SCENE)
    command = f"{sys.executable} {tmp_path / 'command.py'}"
    picture = tmp_path / "render.png"
    run = subprocess.run(
        [python, tmp_path / "scene.py", ADDON, photographs, command, picture],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert "FACTS" in run.stdout, run.stdout[-2000:] + run.stderr[-2000:]
    facts = json.loads(run.stdout.split("FACTS")[1].splitlines()[0])
    assert facts["done"] == ["FINISHED"] and facts["name"] == "ball"
    assert "something about the photographs" in facts["refusal"]
    assert facts["up"] and facts["faces"] > 2000

    # Two units are 64 pixels; the edge of the mask is at 0.2 of the radius.
    low, high = facts["heights"]
    assert high - low == pytest.approx(0.9 * (1 - 0.05**0.5), abs=0.05)
    argv = json.loads((tmp_path / "argv.json").read_text())
    given = parse(Options, argv[argv.index("estimate") + 1 :], prog="", description="")
    assert given.how.depth and given.how.base_color and given.how.lights
    assert given.weights == "tiny"

    # The light comes from the right and above, and reaches what faces it.
    normals, mask = ball()
    image = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)[..., :3] / 65535
    light = np.array([1, 0.5, 1]) / 1.5
    shading = normals @ light
    inner = mask & (normals[..., 2] > 0.5) & (shading > 0.2)
    top = np.broadcast_to(np.arange(SIZE)[:, None] < SIZE // 2, mask.shape)
    ratios = [
        image[..., 1][inner & half] / shading[inner & half] for half in (top, ~top)
    ]
    for ratio in ratios:
        assert np.std(ratio) / np.mean(ratio) < 0.1
    assert np.mean(ratios[0]) / np.mean(ratios[1]) == pytest.approx(0.5, abs=0.03)
    red, blue = image[..., 2], image[..., 0]
    rows = inner & top
    assert np.median(red[rows] / blue[rows]) == pytest.approx(3, abs=0.5)

    # The mesh itself has the relief, and the lens sees it grow towards the edge.
    flat, deep = facts["solid"]
    assert (flat["modifiers"], flat["frames"], flat["lens"]) == (0, 2, "ORTHO")
    assert deep["lens"] == "PERSP"
    relief = 0.9 * (1 - 0.05**0.5)
    for solid in (flat, deep):
        height = np.subtract(solid["high"], solid["low"])[2]
        assert height == pytest.approx(relief, abs=0.02)
    widths = [np.subtract(solid["high"], solid["low"])[0] for solid in (flat, deep)]
    assert widths[0] == pytest.approx(2 * 0.9 * 0.95**0.5, abs=0.05)
    # The edge is half the relief behind the middle, which is 3.125 from the lens.
    assert widths[1] / widths[0] == pytest.approx(1 + relief / 2 / 3.125, abs=0.02)

    # Frames are the photographs' lights: lamps, and what comes from all around.
    grey = np.broadcast_to(np.arange(SIZE)[:, None] >= SIZE // 2, mask.shape)
    for kind in ("flat", "deep"):
        for frame, towards, key, around in (
            (1, [0.6, 0, 0.8], 0.8, 0),
            (2, [0, 0.6, 0.8], 0.5, 0.1),
        ):
            file = picture.with_name(f"render-{kind}-{frame}.png")
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., 1] / 65535
            expected = 0.4 * (key * np.maximum(normals @ towards, 0) + np.pi * around)
            where = mask & (normals[..., 2] > 0.6) & (normals @ towards > 0.2) & grey
            found = image[where] / expected[where]
            assert np.median(found) == pytest.approx(1, abs=0.06)
            assert np.std(found) < 0.1
