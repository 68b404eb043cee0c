"""Universal photometric stereo (UniPS) in JAX.

Normals from photographs of one object under arbitrary, unknown, changing light:
"Universal Photometric Stereo Network using Global Lighting Contexts" (Ikehata,
CVPR 2022).

Conventions everywhere: arrays are channels-last, row 0 is the top of the image;
normals are unit vectors in the camera frame, x right, y up, z towards the viewer, and
zero outside the mask.
"""

from unips_jax.config import ModelConfig
from unips_jax.estimation.pure import estimate_normals
from unips_jax.metrics import angular_error_deg
from unips_jax.weights import load_weights

__version__ = "0.1.0"

__all__ = [
    "ModelConfig",
    "__version__",
    "angular_error_deg",
    "estimate_normals",
    "load_weights",
]
