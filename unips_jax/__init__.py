"""Universal photometric stereo (UniPS) in JAX.

Normals from photographs of one object under arbitrary, unknown, changing light:
"Universal Photometric Stereo Network using Global Lighting Contexts" (Ikehata,
CVPR 2022).

    network = unips_jax.load_weights("tiny")
    images, mask, transfer = unips_jax.read_photographs("photographs/")
    normals = unips_jax.estimate_photographs(network, images, mask, transfer=transfer)

Conventions everywhere: arrays are channels-last, row 0 is the top of the image;
normals are unit vectors in the camera frame, x right, y up, z towards the viewer, and
zero outside the mask.

The names below are imported when they are first used, each with what it needs alone:
reading photographs needs no JAX, estimating normals no scene renderer.
"""

import importlib
from typing import TYPE_CHECKING, Any

from unips_jax.version import __version__

if TYPE_CHECKING:
    from unips_jax.console import cache_compilations
    from unips_jax.estimation.nnx_module import NnxNetwork
    from unips_jax.estimation.pure import estimate_normals
    from unips_jax.estimation.streaming import estimate_photographs
    from unips_jax.evaluation.figures import load_results
    from unips_jax.io.normals import read_normals, write_normals
    from unips_jax.io.photographs import read_photographs
    from unips_jax.lighting.light_fit import estimate_lights
    from unips_jax.lighting.relight import DistantLights, Materials, relight
    from unips_jax.metrics import angular_error_deg
    from unips_jax.models.config import ModelConfig
    from unips_jax.models.network import UniversalNetwork
    from unips_jax.scenes.render import render_scene
    from unips_jax.surface.images import integrate_image
    from unips_jax.surface.integrate import integrate_normals
    from unips_jax.weights import load_weights, save_weights

__all__ = [
    "DistantLights",
    "Materials",
    "ModelConfig",
    "NnxNetwork",
    "UniversalNetwork",
    "__version__",
    "angular_error_deg",
    "cache_compilations",
    "estimate_lights",
    "estimate_normals",
    "estimate_photographs",
    "integrate_image",
    "integrate_normals",
    "load_results",
    "load_weights",
    "read_normals",
    "read_photographs",
    "relight",
    "render_scene",
    "save_weights",
    "write_normals",
]

_MODULES = {
    "DistantLights": "lighting.relight",
    "Materials": "lighting.relight",
    "ModelConfig": "models.config",
    "NnxNetwork": "estimation.nnx_module",
    "UniversalNetwork": "models.network",
    "angular_error_deg": "metrics",
    "cache_compilations": "console",
    "estimate_lights": "lighting.light_fit",
    "estimate_normals": "estimation.pure",
    "estimate_photographs": "estimation.streaming",
    "integrate_image": "surface.images",
    "integrate_normals": "surface.integrate",
    "load_results": "evaluation.figures",
    "load_weights": "weights",
    "read_normals": "io.normals",
    "read_photographs": "io.photographs",
    "relight": "lighting.relight",
    "render_scene": "scenes.render",
    "save_weights": "weights",
    "write_normals": "io.normals",
}


def __getattr__(name: str) -> Any:
    """Imports a public name from its module, once."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The module's names, those not yet imported too."""
    return sorted({*globals(), *_MODULES})
