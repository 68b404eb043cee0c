"""The one signature every method has, UniPS included."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from unips_jax.errors import InputError


class Lights(NamedTuple):
    """Known lights, one distant light per image."""

    # `[N, 3]`, unit vectors from the surface to the light, camera frame
    directions: np.ndarray
    intensities: np.ndarray  # `[N, 3]`, per colour channel


class Observed(NamedTuple):
    """What is known of an object before its normals are: a method's input."""

    images: np.ndarray  # `[N, H, W, 3]`, linear RGB of any scale, float32
    mask: np.ndarray  # `[H, W]`, bool, True on the object
    lights: Lights | None = None  # None where unknown
    # focal length in pixels of these images, principal point at their centre (of those
    # that were cropped, beside it); infinite for an orthographic camera, None where
    # unknown
    focal: float | None = None


class Estimated(NamedTuple):
    """Normals, and what a method reports of how they came about."""

    normals: np.ndarray  # as in `Method`
    # figures by name, unit included, such as the share of failed patches
    measures: Mapping[str, float]


class Unsupported(InputError):
    """The method cannot work on this input; one line names what it lacks."""


Method = Callable[[Observed], np.ndarray | Estimated]
"""Estimates an object's normals.

Returns:
    Normals `[H, W, 3]`, float32: unit length inside the mask (x right, y up, z to the
    viewer), zero outside; as `Estimated` where the method has figures too. Methods
    that need no lights ignore them, or measure their own estimate by them.

Raises:
    Unsupported: if the input lacks something the method needs.
"""
