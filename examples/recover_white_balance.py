"""Differentiates through the estimator: the white balance of every photograph.

Photographs of an object with known normals got an unknown gain per image and colour.
The gains are found by gradient descent on the distance between the estimated and the
known normals. Each image's overall exposure cannot be found, since the estimator
divides every image by its mean; its colours can.

    python examples/recover_white_balance.py
"""

import jax
import jax.numpy as jnp
import optax
from jax import Array

from unips_jax import UniversalNetwork, angular_error_deg, estimate_normals


def recover_gains(
    network: UniversalNetwork,
    images: Array,
    mask: Array,
    normals: Array,
    *,
    steps: int = 150,
    learning_rate: float = 0.02,
) -> tuple[Array, Array]:
    """Finds the gains under which the estimate fits known normals.

    Args:
        network: what estimates.
        images: `[N, H, W, 3]`, true photographs times unknown gains.
        mask: `[H, W]`.
        normals: `[H, W, 3]`, known.
        steps: of gradient descent (Adam).
        learning_rate: in logarithms of gains.

    Returns:
        Gains `[N, 3]` whose three logarithms sum to zero, and the losses `[steps]`.
    """
    optimizer = optax.adam(learning_rate)

    def loss_of(log_gains: Array) -> Array:
        balanced = images / jnp.exp(log_gains)[:, None, None, :]
        estimated = estimate_normals(network, balanced, mask)
        distance = jnp.sum(jnp.square(estimated - normals), axis=-1)
        return jnp.sum(jnp.where(mask, distance, 0)) / jnp.sum(mask)

    def step(carry, _):
        log_gains, state = carry
        loss, gradient = jax.value_and_grad(loss_of)(log_gains)
        updates, state = optimizer.update(gradient, state)
        log_gains = optax.apply_updates(log_gains, updates)
        return (log_gains - log_gains.mean(1, keepdims=True), state), loss

    start = jnp.zeros((images.shape[0], 3))
    (log_gains, _), losses = jax.jit(
        lambda start: jax.lax.scan(step, (start, optimizer.init(start)), length=steps)
    )(start)
    return jnp.exp(log_gains), losses


def main() -> None:
    """Spoils the colours of a synthetic sphere's photographs and finds them again."""
    from unips_jax import load_weights

    network = load_weights("tiny")
    y, x = jnp.mgrid[1:-1:48j, -1:1:48j]
    mask = x**2 + y**2 < 0.95
    z = jnp.sqrt(jnp.maximum(1 - x**2 - y**2, 0))
    normals = jnp.stack([x, y, z], axis=-1) * mask[..., None]
    lights = jax.random.normal(jax.random.key(0), (6, 3)) * 0.5 + jnp.array([0, 0, 1])
    shading = jnp.maximum(jnp.einsum("hwk,nk->nhw", normals, lights), 0)
    images = shading[..., None] * jnp.array([0.8, 0.6, 0.4])

    target = estimate_normals(network, images, mask)
    gains = jnp.exp(0.1 * jax.random.normal(jax.random.key(1), (6, 3)))
    gains = gains / jnp.prod(gains, axis=1, keepdims=True) ** (1 / 3)
    spoiled = images * gains[:, None, None, :]
    before = estimate_normals(network, spoiled, mask)
    found, losses = recover_gains(network, spoiled, mask, target)
    error = jnp.abs(jnp.log(found / gains)).mean()
    print(f"normals moved by {angular_error_deg(before, target)[mask].mean():.2f} deg")
    print(f"loss {losses[0]:.5f} -> {losses[-1]:.5f}")
    print(
        f"mean error of log gains {jnp.abs(jnp.log(gains)).mean():.3f} -> {error:.3f}"
    )


if __name__ == "__main__":
    main()
