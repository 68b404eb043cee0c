"""Where the light comes from, roughly, and whether values are linear.

A solid is laid under the mask that is round towards its outline. The light of a
photograph is the direction whose shading of it fits best: on real objects it is right
by some twenty degrees of azimuth, which is enough to see that a side is missing.
"""

from typing import NamedTuple

import cv2
import numpy as np

from unips_jax.capture.findings import Finding
from unips_jax.io.color import Transfer, as_linear
from unips_jax.io.masks import mask_box

_SIDE = 160  # pixels of the longer side of the mask's box
_TOUCHING = 0.25  # of the outline along the image's border: no outline of an object
_FEW = 4
_ONE_SIDE = 0.27  # of the mean direction, across the view
_OPPOSITE = 0.05
_ROUND = 0.3  # correlation from which on an object is somewhat round
_LIT = 0.4  # share of the near side's light from which on the far one is lit too
_ALONG = 10.0  # degrees from the lens' axis
_ALONG_MOST = 15.0
_SIDES = (
    *("right", "upper right", "top", "upper left"),
    *("left", "lower left", "bottom", "lower right"),
)
_RANK = 3
_MATTE = 0.01
_CLEARLY = 2.7
_LINEAR_LEAST = 6


class RoughLights(NamedTuple):
    """Where the light of photographs comes from, as a round solid would show it."""

    directions: np.ndarray  # `[N, 3]`, unit: x right, y up, z to the viewer
    normals: np.ndarray  # `[P, 3]` of the solid
    values: np.ndarray  # `[N, P]`, linear, without highlights

    @property
    def fit(self) -> float:
        """The correlation of shading and photographs, the middle one."""
        shading = self.directions @ self.normals.T
        pairs = zip(shading, self.values, strict=True)
        found = [np.corrcoef(s, v)[0, 1] for s, v in pairs if np.ptp(v) > 0]
        return float(np.median(found)) if found else 0.0


def rough_lights(
    images: np.ndarray, mask: np.ndarray, transfer: Transfer
) -> RoughLights | None:
    """The lights of photographs `[N, H, W, 3]`, roughly; of one whole object alone."""
    touching = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).sum()
    outline = mask.sum() - cv2.erode(mask.astype(np.uint8), np.ones((3, 3))).sum()
    if touching > _TOUCHING * max(outline, 1) or not mask.any():
        return None
    box = mask_box(mask, 1)
    images, mask = images[:, *box], mask[box]
    scale = min(1.0, _SIDE / max(mask.shape))
    small = _reduced(mask.astype(np.float32), scale) > 0.99
    if small.sum() < 100:
        return None
    normals = _round_solid(small)[small]
    stack = np.stack(
        [
            as_linear(_reduced(image, scale), transfer).mean(axis=-1)[small]
            for image in images
        ]
    )
    values = np.minimum(stack, np.percentile(stack, 95, axis=1, keepdims=True))
    found = np.linalg.lstsq(normals, values.T, rcond=None)[0].T
    found /= np.maximum(np.linalg.norm(found, axis=-1, keepdims=True), 1e-12)
    return RoughLights(found, normals, values)


def look_at_light(
    images: np.ndarray, mask: np.ndarray, transfer: Transfer
) -> list[Finding]:
    """Reports light that comes from one side only, or along the lens."""
    if len(images) < _FEW:
        return []
    rough = rough_lights(images, mask, transfer)
    if rough is None or not rough.fit > _ROUND:
        return []
    lights = rough.directions
    tilts = np.degrees(np.arccos(np.clip(lights[:, 2], -1, 1)))
    if np.median(tilts) < _ALONG and tilts.max() < _ALONG_MOST:
        return [
            Finding(
                "light along the lens",
                "light along the lens in all photographs (about "
                f"{np.median(tilts):.0f} degrees off it): they hardly show the "
                "shape; hold the lamp well to the left, right, top and bottom",
                figures={"median tilt": float(np.median(tilts))},
            )
        ]
    mean = lights[:, :2].mean(axis=0)
    towards = mean / max(float(np.hypot(*mean)), 1e-12)
    if np.hypot(*mean) < _ONE_SIDE or (lights[:, :2] @ towards).min() < -_OPPOSITE:
        return []
    if _far_side(rough, towards) > _LIT:
        return []
    azimuth = float(np.degrees(np.arctan2(mean[1], mean[0])))
    side = round(azimuth / 45)
    return [
        Finding(
            "light from one side",
            f"light from one side only, the {_side(side)}: the other side is "
            f"badly known; add photographs with light from the {_side(side + 4)}",
            figures={"azimuth": azimuth, "mean": float(np.hypot(*mean))},
        )
    ]


def _far_side(rough: RoughLights, towards: np.ndarray) -> float:
    """How bright the side away from the light is, as a share of the near one's."""
    # Skies are brighter above, but light all of an object.
    turned = rough.normals[:, :2] @ towards
    far, near = turned < -0.4, turned > 0.4
    if not (far.any() and near.any()):
        return 0.0
    shares = np.median(rough.values[:, far], axis=1) / np.maximum(
        np.median(rough.values[:, near], axis=1), 1e-9
    )
    return float(np.median(shares))


def look_at_encoding(images: np.ndarray, mask: np.ndarray) -> list[Finding]:
    """Reports 8-bit values without a tag that fit better as linear ones."""
    # Matte surfaces under N lamps are of rank 3 in linear light, but for shadows.
    # Objects that are not matte show nothing.
    if len(images) < _LINEAR_LEAST or images.dtype != np.uint8:
        return []
    step = max(1, int((mask.sum() / 4000) ** 0.5))
    values = images[:, ::step, ::step][:, mask[::step, ::step]].max(axis=-1)
    lit = (values.max(axis=0) < 250) & (values.max(axis=0) > 25)
    if lit.sum() < 200:
        return []
    values = values[:, lit]
    share = values.min(axis=0) / values.max(axis=0)
    values = values[:, share >= np.percentile(share, 70)]
    linear, srgb = (_beyond_rank(as_linear(values, t)) for t in ("linear", "srgb"))
    if linear > _MATTE or srgb < _CLEARLY * linear:
        return []
    return [
        Finding(
            "probably linear",
            "values are probably linear, though 8 bit and without a tag: as such "
            f"{linear:.1%} of their variation is no matte shading, as sRGB {srgb:.1%}; "
            "if they were exported so, give --transfer linear",
            figures={"linear": linear, "srgb": srgb},
        )
    ]


def _beyond_rank(values: np.ndarray) -> float:
    """The share of what is beyond rank 3 in what is beyond rank 1."""
    energy = np.linalg.svd(values, compute_uv=False).astype(np.float64) ** 2
    return float(energy[_RANK:].sum() / max(energy[1:].sum(), 1e-12))


def _side(index: int) -> str:
    return _SIDES[index % 8]


def _reduced(image: np.ndarray, scale: float) -> np.ndarray:
    height, width = (max(round(scale * side), 1) for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _round_solid(mask: np.ndarray) -> np.ndarray:
    """Normals `[h, w, 3]` of a solid that is round towards the mask's outline."""
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)
    depth = depth[1:-1, 1:-1]
    height = np.sqrt(np.maximum(depth * (2 * depth.max() - depth), 0))
    height = cv2.GaussianBlur(height, (0, 0), max(2.0, 0.15 * float(depth.max())))
    down, right = np.gradient(height)
    normals = np.stack([-right, down, np.ones_like(right)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)
