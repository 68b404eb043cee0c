"""A picture to judge an estimate by: the inputs, the normals, and a turning light.

Left: photographs. Middle: the normals in OpenGL colours. Right: the shape under eight
lights, each tile lying on the side its light comes from; in the middle a sphere, the
key to the normals' colours. Where the true normals are known, a map of the errors.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from unips_jax.io.color import srgb_encode
from unips_jax.io.images import write_image
from unips_jax.pictures.lettering import write_line
from unips_jax.pictures.maps import colours_of, frame

_TILE = 240
_GAP = 8
_BLOCK = 3 * _TILE + 2 * _GAP
_EDGE = 28
_HEADER = 84
_BACKGROUND = (22, 24, 29)
_LIGHT_ELEVATION_DEG = 40.0
_AMBIENT = 0.03
_ERROR_LIMIT_DEG = 30.0
_BAR = 20  # height of the key to the errors' colours


def write_sheet(
    file: Path,
    images: np.ndarray,
    normals: np.ndarray,
    mask: np.ndarray,
    *,
    title: str,
    subtitle: str,
    encoded: bool,
    truth: np.ndarray | None = None,
) -> None:
    """Writes the sheet as an image file, whose suffix gives the format.

    Of images `[N, H, W, 3]`, sRGB if they are `encoded`; with the true normals `[H, W,
    3]` it has a map of the errors.
    """
    view = frame(mask)
    coverage = mask[view].astype(np.float32)[..., None]
    kept = np.where(coverage > 0, normals[view], 0)
    large = (_normalized(_fit(kept, _BLOCK)) + 1) / 2
    blocks = [
        _grid(_inputs(images, view, encoded)),
        _over_background(large, _fit(coverage, _BLOCK)),
        _grid(_lit_tiles(_normalized(_fit(kept)), _fit(coverage))),
    ]
    labels = [
        f"{_shown(len(images))} of {len(images)} photographs",
        "normals (red: right, green: up, blue: towards the viewer)",
        "the shape under a light from each side; colour key",
    ]
    if truth is not None:
        from unips_jax.metrics import angular_error_deg  # with JAX

        errors = np.asarray(angular_error_deg(normals[view], truth[view]))
        blocks.append(_error_block(errors, mask[view]))
        labels.append(
            f"errors, 0 (black) to {_ERROR_LIMIT_DEG:.0f} degrees and more (yellow); "
            f"mean {errors[mask[view]].mean():.2f} degrees"
        )
    canvas = _canvas(blocks)
    low = canvas.shape[0] - _EDGE
    write_line(canvas, (_EDGE, 30), title, size=23.6, colour="#f2f2f2")
    write_line(canvas, (_EDGE, 60), subtitle, size=15.3, colour="#a9adb8")
    for i, label in enumerate(labels):
        place = (_EDGE + i * (_BLOCK + _EDGE), low)
        write_line(canvas, place, label, size=15.3, colour="#a9adb8")
    write_image(file, canvas)


def shade(normals: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Lambertian shading of white material: max(n . l, 0), `[H, W]`."""
    # The light's side: 0 right, 90 above; it stands 40 degrees above the image plane.
    azimuth, elevation = np.deg2rad([azimuth_deg, _LIGHT_ELEVATION_DEG])
    light = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        np.float32,
    )
    return np.maximum(normals @ light, 0)


def _fit(image: np.ndarray, side: int = _TILE) -> np.ndarray:
    """Scales to fit a square, keeping the aspect; zeros around. Float32."""
    height, width = image.shape[:2]
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(image, size, interpolation=how).astype(np.float32)
    small = small.reshape(size[1], size[0], -1)
    result = np.zeros((side, side, small.shape[-1]), np.float32)
    top, left = (side - size[1]) // 2, (side - size[0]) // 2
    result[top : top + size[1], left : left + size[0]] = small
    return result


def _normalized(normals: np.ndarray) -> np.ndarray:
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)


def _shown(count: int) -> int:
    return min(count, 9)


def _inputs(
    images: np.ndarray, view: tuple[slice, slice], encoded: bool
) -> list[np.ndarray]:
    chosen = np.linspace(0, len(images) - 1, _shown(len(images))).round().astype(int)
    within = _fit(np.ones((*images[0][view].shape[:2], 1), np.float32))
    tiles = []
    for i in chosen:
        tile = _fit(images[i][view])
        if images.dtype.kind == "u":
            tile /= np.iinfo(images.dtype).max
        if not encoded:
            tile = srgb_encode(tile / max(float(np.percentile(tile, 99.5)), 1e-12))
        tiles.append(_over_background(tile, within))
    return tiles


def _lit_tiles(normals: np.ndarray, mask: np.ndarray) -> list[np.ndarray]:
    """Nine tiles, row by row: eight lights around the colour key."""
    tiles = []
    for azimuth in (135, 90, 45, 180, None, 0, 225, 270, 315):
        if azimuth is None:
            tiles.append(_colour_key())
        else:
            light = _AMBIENT + (1 - _AMBIENT) * shade(normals, azimuth)
            gray = np.repeat(srgb_encode(light)[..., None], 3, axis=-1)
            tiles.append(_over_background(gray, mask))
    return tiles


def _colour_key() -> np.ndarray:
    axis = (np.arange(_TILE) + 0.5) / _TILE * 2 - 1
    x, y = np.meshgrid(axis / 0.62, -axis / 0.62)
    squared = x**2 + y**2
    z = np.sqrt(np.maximum(1 - squared, 0))
    coverage = np.clip((1 - np.sqrt(squared)) * 0.31 * _TILE + 0.5, 0, 1)
    normals = _normalized(np.stack([x, y, z], axis=-1))
    return _over_background((normals + 1) / 2, coverage[..., None])


def _error_block(errors: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Errors as colours, above a bar from 0 to the limit."""
    share = _fit(np.where(mask, errors, 0)[..., None] / _ERROR_LIMIT_DEG, _BLOCK)
    coverage = _fit(mask.astype(np.float32)[..., None], _BLOCK)
    share = np.clip(share / np.maximum(coverage, 1e-6), 0, 1)[..., 0]
    block = _over_background(colours_of(share), coverage)
    bar = colours_of(np.linspace(0, 1, _BLOCK))[None]
    block[-_BAR:] = _over_background(bar, np.ones((_BAR, _BLOCK, 1)))
    return block


def _over_background(colours: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] laid over the background: uint8."""
    mixed = colours * 255 * coverage + np.array(_BACKGROUND) * (1 - coverage)
    return np.clip(mixed + 0.5, 0, 255).astype(np.uint8)


def _grid(tiles: Sequence[np.ndarray]) -> np.ndarray:
    """At most nine tiles in as few rows and columns as hold them, row by row."""
    side = max(1, int(np.ceil(len(tiles) ** 0.5)))
    block = np.full((_BLOCK, _BLOCK, 3), _BACKGROUND, np.uint8)
    tile_side = (_BLOCK - (side - 1) * _GAP) // side
    for i, tile in enumerate(tiles):
        top = (i // side) * (tile_side + _GAP)
        left = (i % side) * (tile_side + _GAP)
        if tile_side != _TILE:
            tile = cv2.resize(
                tile, (tile_side, tile_side), interpolation=cv2.INTER_CUBIC
            )
        block[top : top + tile_side, left : left + tile_side] = tile
    return block


def _canvas(blocks: Sequence[np.ndarray]) -> np.ndarray:
    height = _HEADER + _BLOCK + 2 * _EDGE
    width = len(blocks) * (_BLOCK + _EDGE) + _EDGE
    canvas = np.full((height, width, 3), _BACKGROUND, np.uint8)
    for i, block in enumerate(blocks):
        left = _EDGE + i * (_BLOCK + _EDGE)
        canvas[_HEADER : _HEADER + _BLOCK, left : left + _BLOCK] = block
    return canvas
