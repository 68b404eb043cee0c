"""Photographs of a pot, and `unips estimate` run on them in this process."""

import cv2
import numpy as np

from unips_jax.cli import main as cli

HEIGHT, WIDTH = 60, 80
EXAMPLES = 6


def photograph(index, dtype=np.uint8):
    """A bright spot that moves from picture to picture."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    angle = 2 * np.pi * index / EXAMPLES
    distance = np.hypot(x - 40 - 25 * np.cos(angle), y - 30 - 20 * np.sin(angle))
    picture = np.repeat(0.1 + 0.8 * np.exp(-((distance / 25) ** 2))[..., None], 3, -1)
    return (picture * np.iinfo(dtype).max).astype(dtype)


def write(path, image):
    assert cv2.imwrite(str(path), image)


def pot(place):
    """Six photographs, a mask that touches a border, and a normal map."""
    folder = place / "pot.data"
    folder.mkdir()
    for i in range(EXAMPLES):
        write(folder / f"L_{i}.png", photograph(i))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:50, 10:70] = 255
    write(folder / "mask.png", mask)
    write(folder / "normal.tif", photograph(0))
    return folder


def replace(path, image):
    path.unlink()
    write(path, image)


def run(*arguments):
    return cli.main(["estimate", *map(str, arguments)])
