"""Where the object is on any background: a network for salient objects.

U2-Net's small version (Qin et al., "U2-Net: Going Deeper with Nested U-Structure for
Salient Object Detection", Pattern Recognition 2020; `assets/LICENSES.md`) looks at the
square root of the mean photograph, which has soft shadows only, and at its mirror
image. The outline is laid anew at full resolution by a guided filter (He et al., TPAMI
2013; its coefficients from a reduced picture, as in "Fast Guided Filter", 2015), and
holes open through which the background is seen.
"""

import functools
import importlib.resources
from typing import Any

import cv2
import numpy as np

from unips_jax.capture.background import disc, overlap
from unips_jax.io.color import Transfer, as_linear

_INPUT = 320  # pixels: that the network was trained with, and knows best
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_SIDE = 1024  # pixels of the longer side, where outline and holes are sought
_RADIUS, _SMOOTH = 0.012, 5e-4  # of the guided filter: of the longer side; of 1 squared
_LEAST = 0.03  # of the picture: smaller things are not what was photographed
_PART = 0.02  # of the largest part
_HOLE = 0.003  # of the object
_ENCLOSED = 0.75  # of its rim is object: others are edges of the object in shadow
_NEARBY = 0.06  # of the longer side: whose colours count
_ALIKE = 1.7  # standard deviations of the background
_LEAST_VARIANCE = 4e-4  # of the background
_MUCH = 0.3  # of the object
_APART = 0.03  # of the object: more looks like background where their colours agree
_ROWS = 512  # at a time


def mask_of_salient_object(
    images: np.ndarray, *, transfer: Transfer
) -> tuple[np.ndarray, float] | None:
    """The object's mask, `[H, W]`, and how sure the network is, or None."""
    # How sure: the overlap of the masks at 30 and 70 % of saliency.
    scale = min(1.0, _SIDE / max(images.shape[1:3]))
    picture, top = _mean_picture(images, transfer, scale)
    salient = saliency(picture)
    sure = overlap(salient > 0.3, salient > 0.7)
    inside = salient > 0.5
    border = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    if inside.mean() < _LEAST or border.mean() > 0.5:
        return None
    height, width = picture.shape[:2]
    salient = cv2.resize(salient, (width, height), interpolation=cv2.INTER_LINEAR)
    hole = _holes(_brightest(images, transfer, picture.shape), salient)
    slopes, offset = _guided(picture, salient)
    if scale < 1:
        mask = _full_size(images, transfer, top, slopes, offset)
        hole = cv2.resize(hole.astype(np.float32), mask.shape[::-1]) > 0.5
    else:
        mask = (slopes * picture).sum(axis=-1) + offset > 0.5
    mask = _large_parts(mask & ~hole)
    return (mask, sure) if mask.any() else None


def saliency(picture: np.ndarray) -> np.ndarray:
    """How salient is what is seen in a picture, in [0, 1]: `[320, 320]`.

    The picture's values are the square root of light, or sRGB, in [0, 1].
    """
    small = cv2.resize(picture, (_INPUT, _INPUT), interpolation=cv2.INTER_AREA)
    scaled = (small / max(float(small.max()), 1e-6) - _MEAN) / _DEVIATION
    values: Any = scaled.transpose(2, 0, 1)[None].astype(np.float32)
    network = _network()
    network.setInput(values)
    seen = network.forward()[0, 0].copy()
    network.setInput(np.ascontiguousarray(values[..., ::-1]))
    mirrored = network.forward()[0, 0, :, ::-1]
    return (seen + mirrored) / 2


def _network() -> cv2.dnn.Net:
    return cv2.dnn.readNetFromONNX(_file())


@functools.cache
def _file() -> np.ndarray:
    path = importlib.resources.files("unips_jax") / "assets" / "salient_object.onnx"
    return np.frombuffer(path.read_bytes(), np.uint8)


def _mean_picture(
    images: np.ndarray, transfer: Transfer, scale: float
) -> tuple[np.ndarray, float]:
    """Square root of the reduced mean photograph, and what light is 1 in it."""
    size = [max(1, round(scale * n)) for n in images.shape[2:0:-1]]
    if scale < 1:
        images = np.stack(
            [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
        )
    mean = _mean_light(images, transfer)
    top = float(np.percentile(mean, 99.5)) or 1.0
    return np.sqrt(np.clip(mean / top, 0, 1)), top


def _brightest(
    images: np.ndarray, transfer: Transfer, shape: tuple[int, ...]
) -> np.ndarray:
    """Square root of the brightest of all photographs, reduced, `[h, w, 3]`."""
    brightest = images.max(axis=0)
    if brightest.shape != shape:
        brightest = cv2.resize(brightest, shape[1::-1], interpolation=cv2.INTER_AREA)
    light = as_linear(brightest, transfer)
    top = float(np.percentile(light, 99.5)) or 1.0
    return np.sqrt(np.clip(light / top, 0, 1))


def _mean_light(images: np.ndarray, transfer: Transfer) -> np.ndarray:
    """The mean of linear light, `[H, W, 3]`; of integers by a table, in less time."""
    mean = np.zeros(images.shape[1:], np.float32)
    table = None
    if images.dtype.kind == "u":
        values = np.arange(np.iinfo(images.dtype).max + 1, dtype=images.dtype)
        table = as_linear(values, transfer)
    for image in images:
        mean += as_linear(image, transfer) if table is None else table[image]
    return mean / len(images)


def _guided(picture: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values as a local linear function of colours: slopes `[h, w, 3]`, offset."""
    radius = max(2, round(_RADIUS * max(values.shape)))
    size = (2 * radius + 1,) * 2

    def mean(array: np.ndarray) -> np.ndarray:
        return cv2.blur(array, size, borderType=cv2.BORDER_REFLECT)

    centre, level = mean(picture), mean(values)
    shared = mean(picture * values[..., None]) - centre * level[..., None]
    spread = np.empty((*values.shape, 3, 3), np.float32)
    for i in range(3):
        products = mean(picture * picture[..., i : i + 1])
        spread[..., i] = products - centre * centre[..., i : i + 1]
    spread += _SMOOTH * np.eye(3, dtype=np.float32)
    slopes = np.linalg.solve(spread, shared[..., None])[..., 0]
    offset = level - (slopes * centre).sum(axis=-1)
    return mean(slopes), mean(offset)


def _full_size(
    images: np.ndarray,
    transfer: Transfer,
    top: float,
    slopes: np.ndarray,
    offset: np.ndarray,
) -> np.ndarray:
    """The guided filter's mask of the photographs' own pixels."""
    height, width = images.shape[1:3]

    def full(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)

    filtered, slopes = full(offset), full(slopes)
    for start in range(0, height, _ROWS):
        rows = slice(start, start + _ROWS)
        light = _mean_light(images[:, rows], transfer)
        picture = np.sqrt(np.clip(light / top, 0, 1))
        filtered[rows] += (slopes[rows] * cv2.blur(picture, (3, 3))).sum(axis=-1)
    radius = max(1, round(max(height, width) / _SIDE / 2))
    return cv2.medianBlur((filtered > 0.5).astype(np.uint8), 2 * radius + 1) > 0


def _holes(brightest: np.ndarray, salient: np.ndarray) -> np.ndarray:
    """Large parts inside that look like the background nearby."""
    # The brightest of all photographs has no shadows of a moving lamp. Where much of
    # the object looks like the background too, such as a dark robe on black, only parts
    # that are not quite salient count.
    inside, around = salient > 0.5, salient < 0.05
    if not inside.any() or not around.any():
        return np.zeros(salient.shape, bool)
    alike = (_deviations(brightest, around) < _ALIKE) & (salient > 0.05)
    thick = disc(max(2, round(_RADIUS * max(salient.shape))))
    parts = cv2.morphologyEx(alike.astype(np.uint8), cv2.MORPH_OPEN, thick)
    count, labels = cv2.connectedComponents(parts)
    hole = np.zeros(salient.shape, bool)
    for part in range(1, count):
        here = labels == part
        rim = cv2.dilate(here.astype(np.uint8), disc(2)).astype(bool) & ~here
        likely, share = np.median(salient[here]), here.sum() / inside.sum()
        enclosed = inside[rim].mean() > _ENCLOSED or likely < 0.7
        # Much of the object that surely is salient is white on white, no hole.
        white = likely >= 0.9 and share > _MUCH
        if enclosed and not white and share >= _HOLE:
            hole |= here
    if (alike & inside & ~hole).sum() > _APART * inside.sum():
        hole &= salient < 0.9
    return hole


def _deviations(picture: np.ndarray, background: np.ndarray) -> np.ndarray:
    """How many standard deviations colours are from the background nearby."""
    weight = background.astype(np.float32)[..., None]
    sums = np.concatenate([weight, picture * weight, picture**2 * weight], axis=-1)
    near = _NEARBY * max(weight.shape)
    # Deep inside an object nothing of the background is near: further ones count.
    blurred: Any = cv2.GaussianBlur(sums, (0, 0), near)
    blurred += 1e-3 * cv2.GaussianBlur(sums, (0, 0), 4 * near)
    blurred += 1e-6 * sums.mean(axis=(0, 1))
    means = blurred[..., 1:] / blurred[..., :1]
    variance = np.maximum(means[..., 3:] - means[..., :3] ** 2, 0) + _LEAST_VARIANCE
    return np.sqrt(((picture - means[..., :3]) ** 2 / variance).max(axis=-1))


def _large_parts(mask: np.ndarray) -> np.ndarray:
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas >= _PART * areas.max())[parts] if count > 1 else mask
