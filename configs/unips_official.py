"""What the authors' released weights need.

Paper: "Universal Photometric Stereo Network using Global Lighting Contexts" (Ikehata,
CVPR 2022); the released network differs from its words in the attention's arithmetic,
four aggregation layers and sampling at pixel corners. Weights:
`python tools/convert_official.py DIR -o unips_official.safetensors`. The authors
trained with batch 4 and weight decay 0.01.
"""

import dataclasses

from unips_jax.models.config import ModelConfig
from unips_jax.training.config import Config, DataConfig, OptimConfig


def get_config() -> Config:
    """The configuration."""
    return Config(
        model=dataclasses.replace(ModelConfig.released(), remat=True),
        data=DataConfig(batch_size=4),
        optim=OptimConfig(weight_decay=0.01, decay_every=7_575),
    )
