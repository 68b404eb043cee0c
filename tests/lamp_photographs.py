"""Photographs of a painted hemisphere under lamps, and readers of texture maps."""

import json

import numpy as np
from PIL import Image
from plain_objects import hemisphere

NORMALS, MASK, _ = hemisphere(40)
DIRECTIONS = np.array(
    [[0.5, 0.2, 0.8], [-0.6, 0.1, 0.7], [0, 0.7, 0.6], [0.1, -0.5, 0.9], [0, 0, 1]]
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
COLORS = np.array([[1, 1, 1], [2, 1.8, 1.5], [0.6, 0.7, 0.9], [1, 0.8, 1], [1.3, 1, 1]])


def texture():
    row, column = np.mgrid[:40, :40]
    stripes = 0.55 + 0.35 * np.sin(row / 3)[..., None] * [1, 0.3, -0.5]
    return np.where(column[..., None] < 20, stripes, 0.4)


def photographs(ambient=0.0, gloss=False):
    cosine = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, DIRECTIONS), 0)
    light = cosine[..., None] * COLORS[:, None, None] + ambient
    images = light * texture()
    if gloss:
        half = DIRECTIONS + [0, 0, 1]
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        images += (
            np.maximum(np.einsum("hwk,nk->nhw", NORMALS, half), 0)[..., None] ** 60
        )
    return (images * MASK[..., None]).astype(np.float32)


def angles(found, truth):
    cosine = (found * truth).sum(-1) / np.linalg.norm(truth, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def read_ptm(path):
    """A reader of its own: a function of the light's x and y that gives an image."""
    data = path.read_bytes()
    lines, place = [], 0
    while len(lines) < 6:
        end = data.index(b"\n", place)
        lines.append(data[place:end].decode())
        place = end + 1
    assert lines[:2] == ["PTM_1.2", "PTM_FORMAT_RGB"]
    width, height = int(lines[2]), int(lines[3])
    scale = [float(x) for x in lines[4].split()]
    bias = [int(x) for x in lines[5].split()]
    assert len(data) - place == 18 * width * height

    def show(x, y):
        image = np.zeros((height, width, 3))
        terms = (x * x, y * y, x * y, x, y, 1)
        for color in range(3):
            for row in range(height):
                start = place + 6 * width * (color * height + height - 1 - row)
                line = np.frombuffer(data, np.uint8, 6 * width, start)
                for k, term in enumerate(terms):
                    image[row, :, color] += (
                        (line[k::6].astype(int) - bias[k]) * scale[k] * term
                    )
        return np.clip(image / 255, 0, 1)

    return show


def read_planes(folder):
    """The same, as web viewers do."""
    info = json.loads((folder / "info.json").read_text())
    assert (info["type"], info["colorspace"], info["nplanes"]) == ("ptm", "rgb", 18)
    (material,) = info["materials"]
    planes = [Image.open(folder / f"plane_{index}.jpg") for index in range(6)]
    assert all(plane.size == (info["width"], info["height"]) for plane in planes)

    def show(x, y):
        image = np.zeros((info["height"], info["width"], 3))
        for index, term in enumerate((1, x, y, x * x, x * y, y * y)):
            for color in range(3):
                level = np.asarray(planes[index])[..., color] / 255
                which = 3 * index + color
                factor = material["scale"][which] * term
                image[..., color] += (level - material["bias"][which]) * factor
        return np.clip(image, 0, 1)

    return show
