"""The examples do what they say."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from small_networks import SMALL, lively_weights

from unips_jax import estimate_normals

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_white_balance_is_recovered():
    recover = runpy.run_path(str(EXAMPLES / "recover_white_balance.py"))[
        "recover_gains"
    ]
    params = lively_weights()
    images = jax.random.uniform(jax.random.key(0), (3, 16, 16, 3))
    mask = jnp.ones((16, 16), bool).at[:3].set(False)
    target = estimate_normals(params, images, mask, config=SMALL)
    gains = jnp.exp(0.1 * jax.random.normal(jax.random.key(1), (3, 3)))
    gains = gains / jnp.prod(gains, axis=1, keepdims=True) ** (1 / 3)
    found, losses = recover(
        params,
        images * gains[:, None, None, :],
        mask,
        target,
        config=SMALL,
        steps=150,
        learning_rate=0.02,
    )
    assert losses[-1] < 1e-3 * losses[0]
    assert np.abs(np.log(found / gains)).mean() < 0.1 * np.abs(np.log(gains)).mean()
