"""A result whose every value is known: a hemisphere, lit from three sides."""

import base64
import json

import cv2
import numpy as np

from unips_jax.io.images import write_image
from unips_jax.io.normals import write_normals
from unips_jax.io.results import file_hash, write_record
from unips_jax.viewer.result import Result, photographs_of

SIZE, RADIUS = 96, 36
LIGHTS = {
    "right.png": (0.8, 0, 0.6),
    "left.png": (-0.8, 0, 0.6),
    "up.png": (0, 0.8, 0.6),
}


def hemisphere():
    """Normals `[S, S, 3]`, and depth `[S, S]`, NaN outside."""
    middle = (SIZE - 1) / 2
    y, x = np.mgrid[:SIZE, :SIZE]
    x, y = (x - middle) / RADIUS, -(y - middle) / RADIUS
    inside = x**2 + y**2 < 0.98
    z = np.sqrt(np.where(inside, 1 - x**2 - y**2, 1))
    normals = np.stack([x, y, z], -1) * inside[..., None]
    return normals.astype(np.float32), np.where(inside, -RADIUS * z, np.nan)


def photographs():
    """`[3, S, S, 3]`, uint8, as of a linear camera."""
    normals, _ = hemisphere()
    shading = [np.clip(normals @ np.array(light), 0, 1) for light in LIGHTS.values()]
    return np.rint(200 * np.stack(shading)[..., None] * [1, 0.8, 0.6]).astype(np.uint8)


def result(**changes):
    """The hemisphere in memory."""
    normals, depth = hemisphere()
    images = photographs_of(photographs(), tuple(LIGHTS), "linear")
    given = {"title": "hemisphere", "normals": normals, "depth": depth}
    return Result(**{**given, "photographs": images, **changes})


def decoded(address):
    """A picture of the page: `[H, W, C]`."""
    data = np.frombuffer(base64.b64decode(address.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)[..., ::-1]


def write_folder(folder, photographs_folder):
    """The hemisphere as `unips estimate` writes it, without a depth."""
    for name, image in zip(LIGHTS, photographs(), strict=True):
        write_image(photographs_folder / name, image)
    folder.mkdir()
    write_normals(folder, hemisphere()[0])
    record = {
        "folder": str(photographs_folder),
        "images": {name: file_hash(photographs_folder / name) for name in LIGHTS},
        "options": {"reader": "plain"},
        "transfer": "linear",
        "transfer_rule": "--transfer",
        "weights": {"name": "tiny", "hash": "0123456789", "trained": True},
        "warnings": ["<b>bright</b>"],
    }
    write_record(folder, json.loads(json.dumps(record)))


def ripples(*, size, length, slope):
    """A flat result with waves from left to right; no photographs, no depth.

    Args:
        size: of its sides, in pixels.
        length: of a wave, in pixels.
        slope: tangent of the steepest angle.
    """
    x = slope * np.sin(2 * np.pi * (np.arange(size) + 0.5) / length)
    normals = np.stack([x, 0 * x, 0 * x + 1], -1) / np.hypot(x, 1)[:, None]
    normals = np.broadcast_to(normals, (size, size, 3)).astype(np.float32)
    return Result("ripples", np.ascontiguousarray(normals))
