"""How an object is shown to every method, and compared.

`crop`: the seed paper's comparison (UniPS, CVPR 2022, Sec. 5): the same square centre
crop around the mask for every method, 256 x 256, the mask given to all. The paper does
not print its box or its resampling. Here the box is the mask's bounding box and 4
pixels on each side, made square about its centre (black where it leaves the image). The
box is brought to 256 x 256 by area averages over the masked pixels alone (bilinear
where it is smaller than that), truth included, and a pixel belongs to the object if at
least half of it does. A box of 256 x 256 passes unchanged.

`native`: the images as they are.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np

from unips_jax.baselines.method import Lights, Observed
from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks import Item
from unips_jax.io.masks import mask_box

_MARGIN = 4


@dataclasses.dataclass(frozen=True)
class Protocol:
    """A protocol, "crop" or "native"; `size` is the crop's side in pixels."""

    name: Literal["crop", "native"]
    size: int = 256

    def __post_init__(self) -> None:
        if self.name not in ("crop", "native"):
            raise InputError(f"protocol: expected crop or native, got {self.name!r}")
        if self.size < 8:
            raise InputError(f"crop size: expected at least 8 pixels, got {self.size}")

    @property
    def label(self) -> str:
        """A word for tables and result keys, such as `crop256`."""
        return f"crop{self.size}" if self.name == "crop" else "native"


class Case(NamedTuple):
    """What methods get, and what their estimate is compared with."""

    observed: Observed  # all that methods see; images of integer files are in [0, 1]
    # the truth, `[h, w, 3]`, float32; None where it is withheld
    normals: np.ndarray | None


class Box(NamedTuple):
    """A square in an image; it may reach beyond the borders."""

    top: int
    left: int
    side: int


def choose_images(count: int, total: int, *, seed: int) -> np.ndarray:
    """A subset of the images: `[count]` increasing indices below `total`.

    Subsets of one seed are nested: the 4 images are among the 8. The draw is the same
    for every object with as many images.
    """
    order = np.random.default_rng([seed, total]).permutation(total)
    return np.sort(order[:count])


def square_box(mask: np.ndarray) -> Box:
    """The crop's box: that of a mask `[H, W]`, 4 pixels around, made square."""
    rows, columns = mask_box(mask)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    side = max(height, width) + 2 * _MARGIN
    top, left = rows.start - (side - height) // 2, columns.start - (side - width) // 2
    return Box(top, left, side)


def show(
    item: Item,
    protocol: Protocol,
    chosen: Sequence[int] | np.ndarray,
    *,
    crop_focal_ratio: float | None = None,
) -> Case:
    """Prepares an object, shown by the images whose indices are chosen.

    `crop_focal_ratio`: focal length over the crop's side, where no camera is known.
    """
    chosen = np.asarray(chosen)
    lights = item.lights
    if lights is not None:
        lights = Lights(lights.directions[chosen], lights.intensities[chosen])
    if protocol.name == "native":
        shape = (len(chosen), *item.images.shape[1:])
        images = _filled(shape, (_unit_range(item.images[i]) for i in chosen))
        return Case(Observed(images, item.mask, lights, item.focal), item.normals)
    crop = _Crop.around(item.mask, protocol.size)
    focal = item.focal
    if focal is not None:
        focal *= protocol.size / crop.box.side
    elif crop_focal_ratio is not None:
        focal = crop_focal_ratio * protocol.size
    shape = (len(chosen), *crop.shown.shape, item.images.shape[-1])
    images = _filled(shape, (crop.of(_unit_range(item.images[i])) for i in chosen))
    normals = None if item.normals is None else unit_length(crop.of(item.normals))
    return Case(Observed(images, crop.shown, lights, focal), normals)


def shown_mask(mask: np.ndarray, protocol: Protocol) -> np.ndarray:
    """The mask that methods are given, of the mask as published."""
    if protocol.name == "native":
        return mask
    return _Crop.around(mask, protocol.size).shown


def shown_normals(
    normals: np.ndarray, mask: np.ndarray, protocol: Protocol
) -> np.ndarray:
    """Normals of the photographs' size, brought to what methods are given."""
    if protocol.name == "native":
        return normals
    return unit_length(_Crop.around(mask, protocol.size).of(normals))


class _Crop(NamedTuple):
    """The square around an object, brought to one size."""

    box: Box
    mask: np.ndarray  # the object's pixels before
    shown: np.ndarray  # those after
    weight: np.ndarray  # how much of each pixel after is the object's

    @classmethod
    def around(cls, mask: np.ndarray, size: int) -> "_Crop":
        box = square_box(mask)
        weight = _resize(_cut(mask, box).astype(np.float32), size)
        return cls(box, mask, weight >= min(0.5, weight.max()), weight)

    def of(self, image: np.ndarray) -> np.ndarray:
        """An image `[H, W, C]` in the square: averages over the object's pixels."""
        # Not a product: what is not finite outside the object must not reach it.
        masked = np.where(self.mask[..., None], image, 0)
        part = _resize(_cut(masked, self.box), len(self.shown))
        inside = self.shown[..., None]
        return np.where(inside, part / np.where(inside, self.weight[..., None], 1), 0)


def _filled(shape: tuple[int, ...], images: Iterable[np.ndarray]) -> np.ndarray:
    """One array of the images; stacking a list would hold them twice."""
    stack = np.empty(shape, np.float32)
    for place, image in zip(stack, images, strict=True):
        place[...] = image
    return stack


def _unit_range(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.dtype.kind == "f":
        return image.astype(np.float32)
    return image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)


def _cut(array: np.ndarray, box: Box) -> np.ndarray:
    """The box's pixels `[side, side, ...]`, zero beyond the borders."""
    result = np.zeros((box.side, box.side, *array.shape[2:]), array.dtype)
    top, left = max(box.top, 0), max(box.left, 0)
    part = array[top : box.top + box.side, left : box.left + box.side]
    rows, columns = part.shape[:2]
    result[
        top - box.top : top - box.top + rows,
        left - box.left : left - box.left + columns,
    ] = part
    return result


def _resize(image: np.ndarray, size: int) -> np.ndarray:
    shrinks = image.shape[0] > size
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(image, (size, size), interpolation=interpolation)


def unit_length(normals: np.ndarray) -> np.ndarray:
    """Vectors `[..., 3]` at unit length, float32; 0 where they have none."""
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = np.isfinite(length) & (length > 1e-6)
    unit = np.where(known, normals / np.where(known, length, 1), 0)
    return unit.astype(np.float32)
