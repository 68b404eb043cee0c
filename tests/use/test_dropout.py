"""Dropout: rate, mean, independence of entries and of keys, gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.models.dropout import dropout


def kept(seed, rate=0.1, shape=(400, 500)):
    return np.asarray(dropout(jnp.ones(shape), rate, jax.random.key(seed)) > 0)


@pytest.mark.parametrize("rate", [0.001, 0.1, 0.5, 0.9])
def test_share_and_mean(rate):
    x = dropout(jnp.ones((400, 500)), rate, jax.random.key(1))
    assert set(np.unique(x).round(4)) == {0, np.float32(1 / (1 - rate)).round(4)}
    spread = (rate * (1 - rate) / x.size) ** 0.5
    assert abs(float((x == 0).mean()) - rate) < 4 * spread
    # Rows and columns too, each a sum of independent entries.
    for axis in (0, 1):
        share = np.asarray(x == 0).mean(axis)
        spread = (rate * (1 - rate) / x.shape[axis]) ** 0.5
        assert share.std() == pytest.approx(spread, rel=0.15)


def test_entries_and_keys_are_independent():
    """Correlations of neighbours, at many distances, and of other keys' masks."""
    first = kept(0, 0.5).ravel() - 0.5
    limit = 5 * 0.25 / first.size**0.5
    for distance in (1, 2, 3, 4, 7, 8, 16, 64, 128, 500, 512, 1024, 4096, 65536):
        assert abs(np.mean(first[distance:] * first[:-distance])) < limit, distance
    for seed in range(1, 30):
        assert abs(np.mean(first * (kept(seed, 0.5).ravel() - 0.5))) < limit, seed


def test_same_key_same_mask():
    np.testing.assert_array_equal(kept(3), kept(3))
    assert (kept(3) != kept(4)).any()


def test_gradient_passes_where_kept():
    x, key = jnp.arange(1.0, 101.0), jax.random.key(2)
    gradient = jax.grad(lambda x: jnp.sum(dropout(x, 0.3, key)))(x)
    np.testing.assert_allclose(gradient, dropout(x, 0.3, key) / x, rtol=1e-6)


def test_keys_in_a_batch_give_their_own_masks():
    keys = jax.random.split(jax.random.key(0), 3)
    x = jnp.ones((3, 100))
    batch = jax.vmap(lambda x, key: dropout(x, 0.5, key))(x, keys)
    for row, key in zip(batch, keys, strict=True):
        np.testing.assert_array_equal(row, dropout(x[0], 0.5, key))
