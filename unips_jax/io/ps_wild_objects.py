"""PS-Wild training folders, read object by object. Nothing is ever written to them.

A folder `X.data/` holds photographs `0*` (training) or `L*` (test), linear, and
`normal.tif`, 16 bit, n = 2 v / 65535 - 1; the object is where | 1 - |n| | < 1e-3.
"""

import glob
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.color import as_float
from unips_jax.io.images import SUFFIXES, read_image


class TrainingObject(NamedTuple):
    """Where an object's files are.

    Attributes:
        photographs: sorted by name.
        normals: the true normals.
    """

    photographs: tuple[Path, ...]
    normals: Path


class PSWildFolders:
    """All objects below a root; a random-access source for grain."""

    def __init__(self, root: Path, *, min_images: int) -> None:
        """Finds the objects.

        Args:
            root: holds `X.data` folders, directly or below folders of lightings.
            min_images: photographs every object must have.

        Raises:
            InputError: if there are none, or one lacks files.
        """
        below = glob.glob("**/*.data", root_dir=root, recursive=True)  # through links
        folders = sorted(path for name in below if (path := root / name).is_dir())
        if not folders:
            raise InputError(
                f"--data.root {str(root)!r}: expected folders X.data with photographs "
                "0* or L* and normal.tif, found none; `unips render` makes some"
            )
        self._objects = [_find_files(folder, min_images) for folder in folders]

    def __len__(self) -> int:
        """Number of objects."""
        return len(self._objects)

    def __getitem__(self, index: int) -> TrainingObject:
        """Where object number `index` is."""
        return self._objects[index]


def _find_files(folder: Path, min_images: int) -> TrainingObject:
    normals = folder / "normal.tif"
    if not normals.is_file():
        raise InputError(f"{normals}: expected the object's true normals, found none")
    photographs = tuple(
        path
        for path in sorted(folder.iterdir())
        if path.name[0] in "0L" and path.suffix.lower() in SUFFIXES
    )
    if len(photographs) < min_images:
        raise InputError(
            f"{folder}: expected at least {min_images} photographs 0* or L*, found "
            f"{len(photographs)}; lower the largest of --data.num-images"
        )
    return TrainingObject(photographs, normals)


def read_object(
    files: TrainingObject, chosen: np.ndarray, size: int
) -> dict[str, np.ndarray]:
    """Reads some of an object's photographs, averaged down to a square size.

    Zeros below or to the right make squares of those that are none.

    Args:
        files: of the object.
        chosen: which photographs, in order.
        size: side of the result, in pixels.

    Returns:
        `images [N, size, size, 3]`, float32 linear light, zero outside the mask;
        `mask [size, size]`, bool; `normals [size, size, 3]`, unit length inside.

    Raises:
        InputError: if a file is damaged or has another size than the normals.
    """
    encoded = _read(files.normals)
    normals = 2 * encoded - 1
    mask = abs(1 - np.linalg.norm(normals, axis=-1)) < 1e-3
    if not mask.any():
        raise InputError(f"{files.normals}: expected unit normals, found no pixel")
    share = _resize(mask.astype(np.float32), size)
    small_mask = share > 0.5
    small = _resize(normals * mask[..., None], size) * small_mask[..., None]
    length = np.linalg.norm(small, axis=-1, keepdims=True)
    images = np.zeros((len(chosen), size, size, 3), np.float32)
    for i, index in enumerate(chosen):
        path = files.photographs[index]
        image = _read(path)
        if image.shape != encoded.shape:
            raise InputError(
                f"{path}: expected {encoded.shape[:2]} pixels as in "
                f"{files.normals.name}, got {image.shape[:2]}"
            )
        image = _resize(image * mask[..., None], size)
        images[i] = image / np.maximum(share, 0.5)[..., None] * small_mask[..., None]
    return {
        "images": images,
        "mask": small_mask,
        "normals": (small / np.maximum(length, 1e-6)).astype(np.float32),
    }


def _read(path: Path) -> np.ndarray:
    """An image `[H, W, 3]`, float32; integers become [0, 1]."""
    image = as_float(read_image(path))
    return np.broadcast_to(image, (*image.shape[:2], 3))


def _resize(image: np.ndarray, size: int) -> np.ndarray:
    """Makes a square, with zeros, and averages it down, or interpolates it up."""
    height, width = image.shape[:2]
    if height == width == size:
        return image
    side = max(height, width)
    bottom, right = side - height, side - width
    image = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_CONSTANT)
    method = cv2.INTER_AREA if side >= size else cv2.INTER_LINEAR
    return cv2.resize(image, (size, size), interpolation=method)
