"""A result as the page's pictures: cropped, scaled, and each in one image of 8 bits.

Normals are a PNG of 8 bits a component, half a degree at most from what they were;
depth is one of 16 bits, the high byte in red, the low one in green, 0 where there is
none. Smooth surfaces stay small: PNG's filters work on each byte by itself. What is
scaled down is averaged over the object's pixels alone.
"""

import base64
import dataclasses
import math
from typing import Any

import cv2
import numpy as np

from unips_jax.io.color import srgb_encode
from unips_jax.pictures.maps import colours_of, frame
from unips_jax.viewer.result import Photograph, Result

MOST_PHOTOGRAPHS = 24
MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_JPEG = 82
_PHOTOGRAPH_SIDES = (1024, 768, 512, 384, 256)
_WHITE = 99.5  # percentile of the object's brightest channel
_TOP = 65535


@dataclasses.dataclass(frozen=True)
class View:
    """Which part of a result is shown, and how large in the page's pixels."""

    rows: slice
    columns: slice
    width: int
    height: int

    @property
    def scale(self) -> float:
        """Pixels of the result per pixel of the page."""
        rows, columns = self.rows, self.columns
        # Of the longer side, which rounding changes least.
        return max(rows.stop - rows.start, columns.stop - columns.start) / max(
            self.height, self.width
        )

    def shrink(self, values: np.ndarray) -> np.ndarray:
        """The part's values, `[height, width, ...]`, float32: means over areas."""
        part = np.ascontiguousarray(values[self.rows, self.columns], np.float32)
        if part.shape[:2] == (self.height, self.width):
            return part
        size = (self.width, self.height)
        return cv2.resize(part, size, interpolation=cv2.INTER_AREA)

    def shrink_inside(self, values: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """The same, over the pixels inside alone; 0 where there are none."""
        where = inside if values.ndim == 2 else inside[..., None]
        total = self.shrink(np.where(where, values, 0))
        share = self.shrink(inside)
        share = share if values.ndim == 2 else share[..., None]
        return total / np.maximum(share, 1e-6)


def view_of(inside: np.ndarray, side: int) -> View:
    """The object with a margin, on a page of at most `side` pixels."""
    rows, columns = frame(inside)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    scale = max(1.0, max(height, width) / side)
    return View(
        rows, columns, max(round(width / scale), 1), max(round(height / scale), 1)
    )


def layers_of(result: Result, view: View) -> dict[str, Any]:
    """Everything but the photographs, as JSON values."""
    kept = view.shrink(result.inside) > 0.5
    shape = result.normals.shape
    column = ((shape[1] - 1) / 2 - view.columns.start + 0.5) / view.scale - 0.5
    row = ((shape[0] - 1) / 2 - view.rows.start + 0.5) / view.scale - 0.5
    focal = None if result.focal is None else result.focal / view.scale
    return {
        "width": view.width,
        "height": view.height,
        "scale": view.scale,
        "first": [view.columns.start, view.rows.start],
        "unit_mm": unit_mm(result),
        "camera": {
            "focal": focal,
            "column": column,
            "row": row,
            "distance": result.pixel_size,
        },
        "normals": png(normals_as_bytes(result, view)),
        "depth": None if result.depth is None else _depth(result, view),
        "confidence": _spread(result, view, kept),
        "palettes": {"depth": _palette("viridis"), "confidence": _palette("inferno")},
    }


def unit_mm(result: Result) -> float | None:
    """Millimetres per unit of depth: a pixel, or the mean distance; None: not known."""
    if result.pixel_mm is None:
        return MILLIMETRES.get(result.unit)
    side = result.pixel_size  # of a pixel; with a focal length: the mean distance
    return result.pixel_mm / (side if result.focal is None else side / result.focal)


def normals_as_bytes(result: Result, view: View) -> np.ndarray:
    """Unit normals as 127.5 (n + 1), `[height, width, 3]`, uint8."""
    kept = view.shrink(result.inside) > 0.5
    normals = view.shrink_inside(result.normals, result.inside)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(kept[..., None], normals / np.maximum(length, 1e-6), 0)
    return np.rint(normals * 127.5 + 127.5).astype(np.uint8)


def _depth(result: Result, view: View) -> dict[str, Any] | None:
    assert result.depth is not None
    there = np.isfinite(result.depth)
    kept = view.shrink(there) > 0.5
    if not kept.any():
        return None
    depth = view.shrink_inside(result.depth, there)
    near, far = float(depth[kept].min()), float(depth[kept].max())
    share = (depth - near) / ((far - near) or 1.0)
    levels = np.where(kept, 1 + np.rint(share * (_TOP - 1)), 0).astype(np.uint16)
    bytes_ = np.stack([levels >> 8, levels & 255, np.zeros_like(levels)], -1)
    return {
        "image": png(bytes_.astype(np.uint8)),
        "near": near,
        "far": far,
        "unit": result.unit,
        "pixel": result.pixel_size * view.scale,
    }


def _spread(result: Result, view: View, kept: np.ndarray) -> dict[str, Any] | None:
    if result.spread is None:
        return None
    there = result.inside & np.isfinite(result.spread)
    spread = view.shrink_inside(np.nan_to_num(result.spread), there)
    top = max(float(np.percentile(spread[kept], 99)), 1.0) if kept.any() else 1.0
    levels = np.rint(255 * np.clip(spread / top, 0, 1) * kept).astype(np.uint8)
    return {"image": png(np.repeat(levels[..., None], 3, -1)), "top": top}


def color_of(result: Result, view: View, mean: np.ndarray | None) -> dict | None:
    """The object's colours: base colour if there is one, else the mean photograph."""
    if result.base_color is not None:
        linear, kind = view.shrink_inside(result.base_color, result.inside), "base"
    elif mean is not None:
        inside = view.shrink(result.inside) > 0.5
        linear, kind = mean / white_of(mean, inside), "mean"
    else:
        return None
    return {"image": jpeg(encoded(linear)), "kind": kind}


def photographs_as_pictures(
    photographs: tuple[Photograph, ...], view: View, inside: np.ndarray
) -> tuple[list[tuple[str, np.ndarray]], np.ndarray | None]:
    """Names and pictures `[height, width, 3]`, uint8, of at most 24; and all's mean."""
    if not photographs:
        return [], None
    shown = shown_photographs(len(photographs))
    object_ = view.shrink(inside) > 0.5
    mean = np.zeros((view.height, view.width, 3), np.float32)
    pictures = []
    for index, photograph in enumerate(photographs):
        linear = view.shrink(photograph.read())
        if photograph.bright:
            linear = linear / white_of(linear, object_)
        mean += linear / len(photographs)
        if index in shown:
            pictures.append((photograph.name, encoded(linear)))
    return pictures, mean


def shown_photographs(count: int) -> list[int]:
    """Which of `count` photographs are shown: at most 24, evenly chosen."""
    if not count:
        return []
    chosen = np.linspace(0, count - 1, min(count, MOST_PHOTOGRAPHS)).round()
    return chosen.astype(int).tolist()


def packed_photographs(
    pictures: list[tuple[str, np.ndarray]], budget: int
) -> list[dict[str, str]]:
    """Photographs as JPEG, as large as a budget of bytes allows."""
    packed: list[dict[str, str]] = []
    for side in _PHOTOGRAPH_SIDES:
        packed = [{"name": n, "image": jpeg(p, side)} for n, p in pictures]
        if sum(len(p["image"]) for p in packed) <= budget:
            break
    return packed


def png(pixels: np.ndarray) -> str:
    """An image `[H, W, 3]`, uint8, as a PNG in a `data:` address."""
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6]  # 9 takes ten times as long
    data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]), options)[1]
    return _address("png", data.tobytes())


def jpeg(pixels: np.ndarray, side: int | None = None) -> str:
    """An image as a JPEG in a `data:` address, its longer side at most `side`."""
    scale = 1.0 if side is None else side / max(pixels.shape[:2])
    if scale < 1:
        size = [max(1, math.floor(length * scale)) for length in pixels.shape[1::-1]]
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG]
    data = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), options)[1]
    return _address("jpeg", data.tobytes())


def _address(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def encoded(linear: np.ndarray) -> np.ndarray:
    """Linear values as sRGB, uint8."""
    return np.rint(255 * srgb_encode(np.clip(linear, 0, 1))).astype(np.uint8)


def white_of(linear: np.ndarray, inside: np.ndarray) -> float:
    """The value that is to be white, so that the object is well exposed."""
    values = linear[inside] if inside.any() else linear.reshape(-1, 3)
    return max(float(np.percentile(values.max(axis=-1), _WHITE)), 1e-12)


def _palette(name: str) -> list[list[float]]:
    return np.round(colours_of(np.linspace(0, 1, 16), name), 4).tolist()
