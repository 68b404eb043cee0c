"""Blender in a process of its own, asked for a sphere and photographs of it."""

import contextlib
import os

import numpy as np
import pytest

from unips_jax.cycles import run
from unips_jax.cycles.blender_process import Blender, find_python
from unips_jax.errors import InputError

SIZE = 64
LAMBERTIAN = {"diffuse": [0.8, 0.5, 0.2]}


@contextlib.contextmanager
def opened():
    """Blender's process; the test is skipped where there is no `bpy`."""
    try:
        python = find_python()
    except InputError as error:
        if os.environ.get("UNIPS_REQUIRE_BPY"):
            raise
        pytest.skip(f"bpy not importable: {error}")
    with Blender(python) as process:
        yield process


def sphere(size=SIZE):
    """Normals and mask of the unit sphere in its frame."""
    c = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(c, -c)
    z2 = 1 - x * x - y * y
    normals = np.stack([x, y, np.sqrt(np.maximum(z2, 0))], -1)
    return normals * (z2 > 0)[..., None], z2 > 0


def build(blender, material, size=SIZE):
    blender.ask("build", shape={"kind": "sphere"}, material={"uniform": material})
    blender.ask("place", rotation=[1, 0, 0, 0], focal_mm=None)
    return run.read_truth(blender.picture("truth", size=size))


def photograph(blender, mask, *lamps, seed=1, environment=None, samples=64):
    given = {"lamps": lamps, "environment": environment, "denoise": False}
    size = mask.shape[0]
    return run.read_photograph(
        blender.picture("image", size=size, samples=samples, seed=seed, **given), mask
    )


def sun(direction, irradiance=np.pi):
    direction = np.asarray(direction) / np.linalg.norm(direction)
    return {
        "kind": "sun",
        "direction": direction.tolist(),
        "irradiance": [irradiance] * 3,
    }
