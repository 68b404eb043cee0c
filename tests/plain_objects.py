"""Photographs of made-up objects on plain backgrounds, with their true masks."""

import cv2
import numpy as np

SIZE = 180, 220


def blob(seed, size=SIZE):
    """A rounded object with a wavy outline: its mask and normals."""
    height, width = size
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    radius = 0.3 * height
    u = (x - width * rng.uniform(0.45, 0.55)) / radius
    v = (y - height * rng.uniform(0.45, 0.55)) / radius
    angle = np.arctan2(v, u)
    outline = 1 + sum(
        rng.uniform(-0.25, 0.25) / k * np.cos(k * angle + rng.uniform(0, 6))
        for k in (2, 3, 5)
    )
    distance = np.hypot(u, v) / outline
    depth = np.sqrt(np.maximum(1 - distance**2, 0)) * radius
    dy, dx = np.gradient(cv2.GaussianBlur(depth, (0, 0), 2))
    normals = np.stack([-dx, dy, np.ones_like(dx)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return distance < 1, normals


def lights(count, azimuths=None, elevation=45):
    """Directions `[count, 3]`, around the lens unless azimuths (degrees) are given."""
    if azimuths is None:
        azimuths = 360 * np.arange(count) / count + 17
    phi, theta = np.radians(azimuths), np.radians(elevation)
    flat = np.stack([np.cos(phi), np.sin(phi)], axis=-1) * np.cos(theta)
    return np.concatenate([flat, np.full((len(flat), 1), np.sin(theta))], axis=-1)


def photographs(
    seed=0,
    *,
    albedo=(0.7, 0.6, 0.5),
    second=None,
    gloss=0.0,
    background=0.0,
    vignette=0.0,
    noise=0.004,
    shadow=False,
    cable=False,
    texture=0.0,
    count=8,
    directions=None,
    srgb=True,
    size=SIZE,
    objects=True,
):
    """Photographs `[count, H, W, 3]`, uint8, one lamp each, and the object's mask."""
    rng = np.random.default_rng(seed + 100)
    mask, normals = blob(seed, size)
    if not objects:
        mask = np.zeros_like(mask)
    height, width = size
    y, x = np.mgrid[:height, :width].astype(np.float32)
    colours = np.ones((height, width, 3), np.float32) * np.float32(albedo)
    if second is not None:
        colours[np.sin(x / 13 + y / 29) > 0.2] = second
    behind = np.ones((height, width, 3), np.float32) * np.float32(background)
    if texture:
        drawn = rng.standard_normal((height, width)).astype(np.float32)
        drawn = cv2.GaussianBlur(drawn, (0, 0), 3)
        behind *= (1 + texture * drawn / drawn.std())[..., None]
    if cable:
        end = width, int(0.85 * height)
        cv2.line(behind, (width // 2, height // 2), end, (0.5, 0.5, 0.5), 3)
    falloff = 1 - 2 * vignette * ((x / width - 0.5) ** 2 + (y / height - 0.5) ** 2)
    cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7)[..., None]
    images = []
    for light in lights(count) if directions is None else directions:
        shading = np.maximum(normals @ light, 0) + 0.02
        half = light + [0, 0, 1]
        shine = gloss * np.maximum(normals @ (half / np.linalg.norm(half)), 0) ** 60
        around = np.full((height, width), light[2] + 0.02)
        if shadow:
            move = np.float32([[1, 0, -25 * light[0]], [0, 1, 25 * light[1]]])
            cast = cv2.warpAffine(mask.astype(np.float32), move, (width, height))
            around *= 1 - 0.85 * cv2.GaussianBlur(cast, (0, 0), 5)
        image = (colours * shading[..., None] + shine[..., None]) * cover
        image += behind * around[..., None] * (1 - cover)
        image = np.clip(0.9 * image * falloff[..., None], 0, 1)
        image += 3 * noise * rng.standard_normal(image.shape) * np.sqrt(image + 0.02)
        image = np.clip(image, 0, 1)
        if srgb:
            high = 1.055 * image ** (1 / 2.4) - 0.055
            image = np.where(image < 0.0031308, 12.92 * image, high)
        images.append(np.rint(image * 255).astype(np.uint8))
    return np.stack(images), mask


PLAIN = {
    "white on black": {},
    "coloured on black": {"albedo": (0.6, 0.15, 0.1)},
    "dark on black": {"albedo": (0.08, 0.08, 0.09)},
    "dark backdrop": {"background": 0.03, "vignette": 0.6},
    "noise": {"background": 0.02, "noise": 0.015},
    "two colours": {"second": (0.15, 0.3, 0.1), "background": 0.01},
    "black stripes": {"second": (0.04, 0.03, 0.03), "background": 0.004},
    "glossy": {"albedo": (0.25, 0.2, 0.2), "gloss": 3.0, "background": 0.005},
    "bronze": {"albedo": (0.2, 0.12, 0.05), "gloss": 2.0, "background": 0.004},
    "cable": {"background": 0.01, "cable": True},
    "vignetted grey": {"albedo": (0.8,) * 3, "background": 0.12, "vignette": 0.8},
    "shadows on grey": {"albedo": (0.85,) * 3, "background": 0.1, "shadow": True},
    "dark on white": {"albedo": (0.1,) * 3, "background": 0.8, "vignette": 0.3},
    "shadows on white": {"albedo": (0.15,) * 3, "background": 0.75, "shadow": True},
    "orange on blue": {"albedo": (0.7, 0.35, 0.05), "background": (0.03, 0.06, 0.3)},
    "linear": {"srgb": False, "background": 0.01},
    "three photographs": {"count": 3, "background": 0.02, "vignette": 0.5},
}
"""Backgrounds whose difference alone tells the object."""

HARD = {
    "wood": {
        "albedo": (0.5, 0.35, 0.2),
        "background": (0.45, 0.3, 0.2),
        "texture": 0.35,
    },
    "strong texture": {"background": 0.2, "texture": 0.6},
    "black on black": {"albedo": (0.012,) * 3, "background": 0.01, "noise": 0.01},
    "mirror on black": {"albedo": (0.004,) * 3, "gloss": 4.0, "background": 0.004},
}
"""Backgrounds on which it does not."""


def hemisphere(size=48):
    row, column = np.mgrid[:size, :size]
    radius = 0.45 * size
    x, y = (column - (size - 1) / 2) / radius, -(row - (size - 1) / 2) / radius
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 0))
    normals = np.stack([x, y, z], -1) * mask[..., None]
    return normals.astype(np.float32), mask, -radius * z


def rippled_dome(size=64):
    """A dome with fine ripples: depth, normals, colours."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    height = 12 * np.cos(np.hypot(x, y) / 30) + 0.6 * np.sin(x) * np.cos(y / 2)
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(x)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    inside = np.hypot(x, y) < 0.45 * size
    colors = np.random.default_rng(0).integers(1, 256, (size, size, 3), np.uint8)
    depth = np.where(inside, -height, np.nan).astype(np.float32)
    return depth, (normals * inside[..., None]).astype(np.float32), colors


def ellipse_photographs(n=3, height=23, width=31):
    """Images of a tilted ellipse that leaves part of the frame empty."""
    generator = np.random.default_rng(5)
    y, x = np.mgrid[:height, :width]
    mask = ((x - 13) / 11) ** 2 + ((y - 12) / 8) ** 2 + (x - 13) * (y - 12) / 200 < 1
    images = generator.random((n, height, width, 3)).astype(np.float32)
    return images, mask
