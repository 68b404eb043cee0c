"""Environments to light objects with: procedural ones, and how bright a file's is."""

from pathlib import Path

import cv2
import numpy as np

from unips_jax.io.images import read_image

HEIGHT, WIDTH = 256, 512


def _cosine_to(azimuth: float, height: float) -> np.ndarray:
    """Cosine between every pixel's direction and one direction."""
    v = (np.arange(HEIGHT)[:, None] + 0.5) / HEIGHT * np.pi
    u = (np.arange(WIDTH)[None] + 0.5) / WIDTH * 2 * np.pi
    ring = np.sqrt(max(1 - height**2, 0))
    return np.sin(v) * np.cos(u - azimuth) * ring + np.cos(v) * height


def _clouds(rng: np.random.Generator) -> np.ndarray:
    """Smooth noise about 0 that closes around the azimuth."""
    total = np.zeros((HEIGHT, WIDTH))
    for level in range(2, 6):
        rows, columns = 2**level, 2 ** (level + 1)
        coarse = rng.normal(size=(rows, columns))
        wrapped = np.concatenate([coarse, coarse[:, :1]], 1)
        step = WIDTH // columns
        size = (WIDTH + step, HEIGHT)
        fine = cv2.resize(wrapped, size, interpolation=cv2.INTER_CUBIC)
        total += fine[:, step // 2 : step // 2 + WIDTH] / 2 ** (level - 2)
    return total


def _sky(rng: np.random.Generator) -> np.ndarray:
    up = np.cos((np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi)[:, None, None]
    zenith = np.array([0.25, 0.45, 0.9]) * rng.uniform(0.5, 1.5)
    horizon = np.array([0.9, 0.85, 0.8]) * rng.uniform(0.5, 1.5)
    ground = rng.uniform(0.03, 0.3) * rng.uniform(0.7, 1.0, 3)
    sky = horizon + (zenith - horizon) * np.sqrt(np.maximum(up, 0))
    cover = np.clip(0.5 + 0.4 * _clouds(rng) + rng.uniform(-0.5, 0.3), 0, 1)[..., None]
    sky = sky + cover * rng.uniform(0.3, 1.0)
    picture = np.where(up > 0, sky, ground * np.ones((HEIGHT, WIDTH, 1)))
    cosine = _cosine_to(rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.9))[..., None]
    radius = np.deg2rad(rng.uniform(1.0, 4.0))
    power = rng.uniform(0.0, 6.0) / radius**2  # irradiance over the disc's solid angle
    sun = power / np.pi * (cosine > np.cos(radius)) * np.array([1.0, 0.92, 0.8])
    return picture + sun * (1 - 0.9 * cover)


def _room(rng: np.random.Generator) -> np.ndarray:
    wall = rng.uniform(0.1, 0.5) * rng.uniform(0.75, 1.0, 3)
    picture = wall * np.ones((HEIGHT, WIDTH, 1))
    v = (np.arange(HEIGHT)[:, None] + 0.5) / HEIGHT
    u = (np.arange(WIDTH)[None] + 0.5) / WIDTH
    floor = rng.uniform(0.3, 1.0, 3)
    picture = picture * np.where(v[..., None] > rng.uniform(0.6, 0.75), floor, 1.0)
    for _ in range(int(rng.integers(1, 4))):  # windows
        side = np.abs((u - rng.uniform() + 0.5) % 1 - 0.5) < rng.uniform(0.02, 0.08)
        height = np.abs(v - rng.uniform(0.35, 0.5)) < rng.uniform(0.05, 0.14)
        light = rng.uniform(3, 20) * np.array([0.8, 0.9, 1.0])
        picture = np.where((side & height)[..., None], light, picture)
    for _ in range(int(rng.integers(0, 5))):  # lamps
        cosine = _cosine_to(rng.uniform(0, 2 * np.pi), rng.uniform(-0.2, 1.0))
        light = rng.uniform(10, 100) * np.array([1.0, 0.8, 0.55])
        disc = cosine > np.cos(np.deg2rad(rng.uniform(2, 6)))
        picture = np.where(disc[..., None], light, picture)
    return picture * (1 + 0.15 * np.clip(_clouds(rng), -2, 2)[..., None])


def draw_environment(rng: np.random.Generator) -> np.ndarray:
    """A sky, or a room: radiance `[256, 512, 3]`, equirectangular, zenith in row 0."""
    picture = _sky(rng) if rng.random() < 0.5 else _room(rng)
    return np.maximum(picture, 0).astype(np.float32)


def mean_radiance(picture: np.ndarray) -> float:
    """Mean of an equirectangular picture over the sphere, all channels."""
    height = picture.shape[0]
    weight = np.sin((np.arange(height) + 0.5) / height * np.pi)
    return float((picture.mean((1, 2)) * weight).sum() / weight.sum())


def read_mean_radiance(path: Path) -> float:
    """The same of a file."""
    image = read_image(path)
    scale = 1.0 if image.dtype == np.float32 else np.iinfo(image.dtype).max
    return mean_radiance(image.astype(np.float32) / scale)
