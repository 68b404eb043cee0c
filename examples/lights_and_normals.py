"""Lights and normals together: an estimate explains the photographs, and is mended.

`estimate_normals` gives no lights. Under one distant lamp per photograph and a
matt surface, image = albedo * max(normal . light, 0): starting at estimated normals,
gradient descent on the photographs finds every lamp, the albedo, and normals that fit
them, held near the estimate where photographs say little (shadows, highlights).

    python examples/lights_and_normals.py
"""

import jax
import jax.numpy as jnp
import optax
from jax import Array


def explain(
    images: Array,
    mask: Array,
    normals: Array,
    *,
    trust: float = 0.05,
    steps: int = 300,
    learning_rate: float = 0.02,
) -> tuple[Array, Array, Array, Array]:
    """Finds lights, albedo and normals near an estimate that explain photographs.

    Args:
        images: `[N, H, W]`, linear and grey.
        mask: `[H, W]`, bool.
        normals: `[H, W, 3]`, the estimate.
        trust: weight of the squared distance to the estimate, relative to that of the
            images divided by their mean.
        steps: of gradient descent (Adam).
        learning_rate: its.

    Returns:
        Lights `[N, 3]` (their lengths are intensities, of an unknown common scale),
        albedo `[H, W]`, normals `[H, W, 3]` (zero outside the mask), and the losses
        `[steps]`.
    """
    images = images * mask / jnp.mean(images, where=mask)
    # Least squares on what is lit gives the lamps to begin with.
    lit = (images > 0.2 * images.max((1, 2), keepdims=True)) & mask
    gram = jnp.einsum("nhw,hwi,hwj->nij", lit, normals, normals)
    seen = jnp.einsum("nhw,hwi,nhw->ni", lit, normals, images)
    lights = jnp.linalg.solve(gram + 1e-6 * jnp.eye(3), seen[..., None])[..., 0]
    start = {"lights": lights, "albedo": jnp.ones(mask.shape), "normals": normals}
    optimizer = optax.adam(learning_rate)

    def unit(vectors: Array) -> Array:
        return vectors / jnp.sqrt(jnp.sum(vectors**2, -1, keepdims=True) + 1e-12)

    def loss_of(found: dict[str, Array]) -> Array:
        turned = unit(found["normals"])
        shading = jnp.maximum(jnp.einsum("hwk,nk->nhw", turned, found["lights"]), 0)
        unexplained = jnp.square(found["albedo"] * shading - images).mean(0)
        moved = jnp.square(turned - normals).sum(-1)
        return jnp.mean(unexplained + trust * moved, where=mask)

    def step(carry, _):
        found, state = carry
        loss, gradient = jax.value_and_grad(loss_of)(found)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(found, updates), state), loss

    (found, _), losses = jax.jit(
        lambda start: jax.lax.scan(step, (start, optimizer.init(start)), length=steps)
    )(start)
    turned = unit(found["normals"]) * mask[..., None]
    return found["lights"], found["albedo"], turned, losses


def sphere(size: int = 48, count: int = 6) -> tuple[Array, ...]:
    """A matt sphere with a pattern: images, mask, normals and lights `[count, 3]`."""
    y, x = jnp.mgrid[1 : -1 : size * 1j, -1 : 1 : size * 1j]
    mask = x**2 + y**2 < 0.9
    z = jnp.sqrt(jnp.maximum(1 - x**2 - y**2, 0))
    normals = jnp.stack([x, y, z], axis=-1) * mask[..., None]
    lights = jax.random.normal(jax.random.key(0), (count, 3)) * 0.5
    lights = lights + jnp.array([0, 0, 1])
    albedo = 0.6 + 0.3 * jnp.sin(9 * x) * jnp.sin(9 * y)
    shading = jnp.maximum(jnp.einsum("hwk,nk->nhw", normals, lights), 0)
    return albedo * shading, mask, normals, lights


def main() -> None:
    """Estimates a sphere's normals, then explains its photographs."""
    from unips_jax import angular_error_deg, estimate_normals, load_weights

    images, mask, truth, lights = sphere()
    colours = jnp.repeat(images[..., None], 3, axis=-1)
    estimate = estimate_normals(load_weights("tiny"), colours, mask)
    found, _, normals, losses = explain(images, mask, estimate)
    before, after = (
        angular_error_deg(n, truth)[mask].mean() for n in (estimate, normals)
    )
    print(f"loss {losses[0]:.5f} -> {losses[-1]:.5f}")
    print(f"normals {before:.2f} -> {after:.2f} degrees from the truth")
    print(f"lights {angular_error_deg(found, lights).mean():.2f} degrees")


if __name__ == "__main__":
    main()
