"""The map's list of the files that photographs pass through, held against a run."""

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from small_networks import SHALLOW_OURS, lively_network

from unips_jax.weights import save_weights

ROOT = Path(__file__).parents[2]
# Small, with the parts of the shipped network.
AS_SHIPPED = dataclasses.replace(SHALLOW_OURS, light_tokens=True, known_lights=True)

# Prints the files whose functions are called (bodies of classes and modules are none),
# in the order of their first calls.
_TRACE = """
import json, sys, threading
from unips_jax.cli.main import main
called = {}
def note(frame, event, _):
    code = frame.f_code
    if event == "call" and "unips_jax/" in code.co_filename and code.co_flags & 1:
        called.setdefault(code.co_filename.rpartition("unips_jax/")[2])
sys.setprofile(note), threading.setprofile(note)
status = main(sys.argv[1:])
sys.setprofile(None)
print(json.dumps([status, [file for file in called if file[0] != "<"]]))
"""


def files_called(tmp_path):
    folder = tmp_path / "ball"
    folder.mkdir()
    y, x = (np.mgrid[:64, :64] - 31.5) / 28
    inside = x**2 + y**2 < 1
    z = np.sqrt(np.where(inside, 1 - x**2 - y**2, 0))
    for i, (right, down) in enumerate([(0.6, 0), (-0.3, 0.5), (-0.3, -0.5), (0, 0)]):
        light = np.clip((x * right + y * down + z) * 200, 0, 255) * inside
        cv2.imwrite(str(folder / f"{i}.png"), light.astype(np.uint8))
    cv2.imwrite(str(folder / "mask.png"), inside.astype(np.uint8) * 255)
    save_weights(tmp_path / "small.safetensors", lively_network(AS_SHIPPED))
    asked = [str(folder), "-o", str(tmp_path / "out")]
    asked += ["--weights", str(tmp_path / "small.safetensors")]
    run = subprocess.run(
        [sys.executable, "-c", _TRACE, "estimate", *asked],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled")},
    )
    assert run.returncode == 0, run.stderr
    status, called = json.loads(run.stdout.splitlines()[-1])
    assert status == 0, run.stderr
    return called


def test_the_map_lists_what_photographs_pass_through(tmp_path):
    text = (ROOT / "docs" / "architecture.md").read_text()
    section = text.split("## From photographs to normals")[1].split("\n## ")[0]
    steps = re.split(r"\n\d+\. ", section)[1:]
    files = [re.findall(r"`([\w/]+\.py)`", step) for step in steps]
    called = files_called(tmp_path)
    assert sorted(called) == sorted(file for step in files for file in step)
    begun = [called.index(step[0]) for step in files]
    assert begun == sorted(begun), called
