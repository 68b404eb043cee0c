"""A stand-in for Blender: a program that answers as its worker does, with a sphere."""

import stat
import sys
from pathlib import Path

# Answers like blender/worker.py with a sphere; misbehaves for some shapes.
STAND_IN = """
import json, os, sys, time
import numpy as np, OpenEXR
shape = None
def sphere(size):
    c = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(c, -c)
    z2 = 1 - x * x - y * y
    return x, y, np.sqrt(np.maximum(z2, 0)), z2 > 0
for line in sys.stdin:
    request = json.loads(line)
    do, answer = request["do"], None
    if do == "version":
        answer = {"blender": "stand-in"}
    if do == "place":
        answer = "UNFIT" not in os.environ or request["rotation"][0] > 0.5
    if do == "build":
        shape = request["shape"]["kind"]
        if shape == "knot" and "CRASH" in os.environ:
            os._exit(1)
        if shape == "cut" and "FAIL" in os.environ:
            print(json.dumps({"error": "ValueError: no faces"}), flush=True)
            continue
    if do in ("truth", "image"):
        x, y, z, inside = sphere(request["size"])
        one = inside.astype(np.float32)
        if do == "truth":
            channels = {"Combined.A": one, "Depth.Z": 10 - z, "Normal.X": x * one,
                "Normal.Y": y * one, "Normal.Z": z * one, "roughness.X": 0.5 * one,
                "metal.X": 0 * one}
            channels |= {"baseColor." + c: 0.25 * one for c in "RGB"}
        else:
            time.sleep(float(os.environ.get("SLOW", 0)))
            light = np.random.default_rng(request["seed"]).uniform(1, 2)
            channels = {c: light * z * one for c in "RGB"} | {"A": one}
        channels = {k: np.ascontiguousarray(v, np.float32) for k, v in channels.items()}
        OpenEXR.File({}, channels).write(request["path"])
    print(json.dumps({"ok": answer}), flush=True)
"""


def written(folder: Path) -> str:
    """A "Blender" that is this Python and the program above: its path."""
    script = folder / "stand_in.py"
    script.write_text(STAND_IN)
    python = folder / "python"
    python.write_text(f'#!/bin/sh\n[ "$1" = -c ] || exec {sys.executable} {script}\n')
    python.chmod(python.stat().st_mode | stat.S_IEXEC)
    return str(python)
