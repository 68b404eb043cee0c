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

from typing import TYPE_CHECKING

from unips_jax.lazy import attributes
from unips_jax.version import __version__

if TYPE_CHECKING:
    from unips_jax.console import cache_compilations
    from unips_jax.errors import InputError
    from unips_jax.estimation.nnx_module import NnxNetwork
    from unips_jax.estimation.pure import estimate_normals
    from unips_jax.estimation.streaming import estimate_photographs
    from unips_jax.evaluation.figures import load_results
    from unips_jax.io.normals import read_normals, write_normals
    from unips_jax.io.photographs import read_photographs
    from unips_jax.lighting.light_fit import estimate_lights
    from unips_jax.lighting.relight import DistantLights, Materials, relight
    from unips_jax.metrics import angular_error_deg, mean_angular_error_deg
    from unips_jax.models.config import ModelConfig
    from unips_jax.models.network import UniversalNetwork
    from unips_jax.scenes.render import render_scene
    from unips_jax.surface.images import integrate_image
    from unips_jax.surface.integrate import integrate_normals
    from unips_jax.weights import load_weights, save_weights

__all__ = [
    "DistantLights",
    "InputError",
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
    "mean_angular_error_deg",
    "read_normals",
    "read_photographs",
    "relight",
    "render_scene",
    "save_weights",
    "write_normals",
]

__getattr__ = attributes(
    __name__,
    {
        "console": "cache_compilations",
        "errors": "InputError",
        "estimation.nnx_module": "NnxNetwork",
        "estimation.pure": "estimate_normals",
        "estimation.streaming": "estimate_photographs",
        "evaluation.figures": "load_results",
        "io.normals": "read_normals write_normals",
        "io.photographs": "read_photographs",
        "lighting.light_fit": "estimate_lights",
        "lighting.relight": "DistantLights Materials relight",
        "metrics": "angular_error_deg mean_angular_error_deg",
        "models.config": "ModelConfig",
        "models.network": "UniversalNetwork",
        "scenes.render": "render_scene",
        "surface.images": "integrate_image",
        "surface.integrate": "integrate_normals",
        "weights": "load_weights save_weights",
    },
)


def __dir__() -> list[str]:
    """The module's names, those not yet imported too."""
    return sorted({*globals(), *__all__})
