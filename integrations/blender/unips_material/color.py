"""The colour of a surface from photographs under changing light and its normals.

Each photograph is explained as colour times light, the light linear in the normal: four
numbers per photograph and channel. Two photographs i and j of a pixel with the vector
b = (normal, 1) give an equation without the colour, I_i (b . l_j) = I_j (b . l_i); all
lights together are the eigenvector of the smallest eigenvalue. What no such light
explains, shadows and highlights, is then left out.
"""

from pathlib import Path

import numpy as np

from . import relief

ROUNDS = 4
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
    """Colours `[P, 3]` from images `[N, P, 3]` and vectors `[P, 4]`."""
    chosen = np.random.default_rng(0).permutation(len(basis))[:SAMPLES]
    colors = []
    for channel in range(3):
        images = observed[..., channel].T  # [P, N]
        trust = (images > 0.1 * np.median(images)).astype(np.float32)
        for _ in range(ROUNDS):
            lights = _lights(images[chosen], trust[chosen], basis[chosen])
            shading = np.maximum(basis @ lights, 1e-3)  # [P, N]
            color = (trust * images * shading).sum(1)
            color = color / ((trust * shading**2).sum(1) + 1e-9)
            error = np.abs(images - color[:, None] * shading)
            trust = 1 / (1 + (error / (0.1 * images.mean())) ** 2)
            trust *= shading > 0.05 * shading.mean()
        colors.append(color)
    return np.stack(colors, axis=-1)


def _lights(images: np.ndarray, trust: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Lights `[4, N]` of a mean shading of 1; see the module."""
    count = images.shape[1]
    outer = (basis[:, :, None] * basis[:, None]).reshape(-1, 16)
    rated = trust * images
    off = np.einsum("pi,pj,pk->ijk", rated, rated, outer, optimize=True)
    squares = (rated * images).sum(1, keepdims=True) - rated * images
    own = (trust * squares).T @ outer  # [N, 16]
    energy = trust.T @ outer
    system = -off.reshape(count, count, 4, 4).transpose(0, 2, 1, 3)
    unit = np.zeros((count, 4, count, 4))  # shadings of no energy explain nothing
    for i in range(count):
        system[i, :, i] = own[i].reshape(4, 4)
        root = np.linalg.cholesky(energy[i].reshape(4, 4) + 1e-6 * np.eye(4))
        unit[i, :, i] = np.linalg.inv(root).T
    unit = unit.reshape(4 * count, 4 * count)
    _, vectors = np.linalg.eigh(unit.T @ system.reshape(unit.shape) @ unit)
    lights = (unit @ vectors[:, 0]).reshape(count, 4).T
    return lights / (basis @ lights).mean()


def _linear(values: np.ndarray, transfer: str) -> np.ndarray:
    if transfer != "srgb":
        return values
    return np.where(values < 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
