"""The paper's network and recipe, on PS-Wild folders.

Paper: "Universal Photometric Stereo Network using Global Lighting Contexts" (Ikehata,
CVPR 2022). Command: `python -m unips_jax.train --config configs/unips.py --workdir
runs/unips --data.root PS-Wild`. Hardware of the paper: one Quadro RTX 8000, 48 hours.
Not trained here: neither that data set nor that time were at hand.
"""

import dataclasses

from unips_jax.models.config import ModelConfig
from unips_jax.training.config import Config


def get_config() -> Config:
    """The configuration: the defaults are the paper's."""
    return Config(model=dataclasses.replace(ModelConfig.paper(), remat=True))
