"""The colour of a surface from photographs under changing light and its normals.

Each photograph is explained as colour times light, the light linear in the normal: four
numbers per photograph and channel, by least squares in turns with the colour. What no
such light explains, shadows and highlights, is weighed down.
"""

from pathlib import Path

import numpy as np

from . import relief

ROUNDS = 5
SAMPLES = 20_000  # pixels that the lights are fitted to
BRIGHT = 0.8  # what the brightest hundredth of the surface reflects


def base_color(files: list[Path], normal_map: np.ndarray, *, transfer: str):
    """Estimates the colour.

    Args:
        files: the photographs.
        normal_map: `[H, W, 3]`, in [0, 1], OpenGL's convention, row 0 at the bottom;
            near 0.5 in all three where there is no surface.
        transfer: how photographs encode light, "srgb" or "linear".

    Returns:
        `[H, W, 3]`, linear, in [0, 1], row 0 at the bottom; grey if the photographs
        cannot be read in the normals' size. Its scale is arbitrary, and as white
        balance the light is taken to be grey on average.
    """
    normals = normal_map * 2 - 1
    inside = np.linalg.norm(normals, axis=-1) > 0.5
    images = []
    for file in files:
        pixels = relief.pixels_of(relief.load_data(file))
        if pixels.shape == normals.shape:
            images.append(_linear(pixels, transfer)[inside])
    result = np.full(normals.shape, 0.5, np.float32)
    if not images:
        return result
    observed = np.stack(images)  # [N, P, 3]
    observed = observed / np.maximum(observed.mean((1, 2), keepdims=True), 1e-9)
    basis = np.concatenate([normals[inside], np.ones((inside.sum(), 1))], -1)  # [P, 4]
    found = _explain(observed, basis)
    mean = observed.mean(0)  # [P, 3], whose average colour is kept
    found *= mean.mean(0) / np.maximum(found.mean(0), 1e-9)
    result[inside] = found * (BRIGHT / max(np.percentile(found.max(-1), 99), 1e-9))
    return np.clip(result, 0, 1)


def _explain(observed: np.ndarray, basis: np.ndarray) -> np.ndarray:
    chosen = np.random.default_rng(0).permutation(len(basis))[:SAMPLES]
    color = np.median(observed, axis=0)  # [P, 3]
    for _ in range(ROUNDS):
        weighted, weights = np.zeros_like(color), np.full_like(color, 1e-6)
        for image in observed:
            for channel in range(3):
                design = basis[chosen] * color[chosen, channel, None]
                light, *_ = np.linalg.lstsq(design, image[chosen, channel], rcond=None)
                shading = np.maximum(basis @ light, 0)
                error = image[:, channel] - color[:, channel] * shading
                trust = shading / (1 + (error / 0.2) ** 2)
                weighted[:, channel] += trust * image[:, channel]
                weights[:, channel] += trust * shading
        color = weighted / weights
    return color


def _linear(values: np.ndarray, transfer: str) -> np.ndarray:
    if transfer != "srgb":
        return values
    return np.where(values < 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
