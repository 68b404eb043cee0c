"""The examples do what they say."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from small_networks import SMALL, lively_weights
from test_surface_command import hemisphere

from unips_jax import Materials, estimate_normals

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


def test_the_light_of_a_photograph_is_found():
    example = runpy.run_path(str(EXAMPLES / "fit_light.py"))
    normals, _, _ = hemisphere(20)
    materials = Materials(jnp.array([0.6, 0.4, 0.2]), 0.5)
    direction = jnp.array([0.5, 0.3, 0.8])
    harmonics = jnp.zeros((9, 3)).at[0].set(0.5).at[1].set(0.2)
    truth = example["Light"](direction, jnp.log(jnp.array([2.0, 1.8, 1.5])), harmonics)
    photograph = example["show"](truth, jnp.asarray(normals), materials)
    found, losses = example["fit_light"](photograph, jnp.asarray(normals), materials)
    assert losses[-1] < 0.05 * losses[0]
    cosine = found.direction @ direction / jnp.linalg.norm(direction)
    assert np.degrees(np.arccos(cosine)) < 5
    # Surroundings may take a part of the lamp's light: they look alike when smooth.
    redder = jnp.exp(found.log_color[0] - found.log_color[2])
    assert 1.1 < redder < 2.0 / 1.5 + 0.2
