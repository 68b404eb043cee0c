"""Fits the light of a photograph by gradient descent through the renderer.

One lamp and surroundings of nine spherical harmonics, each with colours of its own, are
sought so that normals and base colours, known or estimated, look like the photograph.

    python examples/fit_light.py
"""

import importlib.resources
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

from unips_jax import DistantLights, Materials, relight


class Light(NamedTuple):
    """What lights a photograph.

    Attributes:
        direction: `[3]`, to the lamp, of any length.
        log_color: `[3]`, logarithms of the lamp's irradiance.
        harmonics: `[9, 3]`, the surroundings.
    """

    direction: Array
    log_color: Array
    harmonics: Array


def show(light: Light, normals: Array, materials: Materials) -> Array:
    """The image under a light, `[H, W, 3]`."""
    lamp = DistantLights(light.direction[None], jnp.exp(light.log_color)[None])
    return relight(normals, materials, lamp, light.harmonics)


def fit_light(
    photograph: Array,
    normals: Array,
    materials: Materials,
    *,
    steps: int = 300,
    learning_rate: float = 0.03,
) -> tuple[Light, Array]:
    """Finds the light under which a surface looks like its photograph.

    Args:
        photograph: `[H, W, 3]`, linear.
        normals: `[H, W, 3]`, 0 outside the object.
        materials: its reflectance.
        steps: of gradient descent (Adam).
        learning_rate: of all parameters.

    Returns:
        The light and the losses `[steps]`, mean absolute differences.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(learning_rate, steps))
    inside = jnp.any(normals != 0, -1, keepdims=True)

    def loss_of(light: Light) -> Array:
        # Not squared: a cast shadow or two shall not matter.
        distance = jnp.abs(show(light, normals, materials) - photograph)
        return jnp.sum(distance * inside) / jnp.sum(inside) / 3

    def step(carry, _):
        light, state = carry
        loss, gradient = jax.value_and_grad(loss_of)(light)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(light, updates), state), loss

    start = Light(jnp.array([0.0, 0, 1]), jnp.zeros(3), jnp.full((9, 3), 0.01))
    (light, _), losses = jax.jit(
        lambda start: jax.lax.scan(step, (start, optimizer.init(start)), length=steps)
    )(start)
    direction = light.direction / jnp.linalg.norm(light.direction)
    return light._replace(direction=direction), losses


def main() -> None:
    """Fits the light of a photograph of the bundled object."""
    from unips_jax.io.color import as_linear
    from unips_jax.io.normals import has_unit_length, read_normals
    from unips_jax.io.photographs import read_photographs

    sample = Path(str(importlib.resources.files("unips_jax"))) / "assets" / "sample"
    folder = sample / "obj000.data"
    images, mask, transfer = read_photographs(folder)
    normals = read_normals(next(folder.glob("normal.*")))
    normals = normals * (has_unit_length(normals) & mask)[..., None]
    linear = jnp.stack([jnp.asarray(as_linear(image, transfer)) for image in images])
    # Under many lights the mean is about the base colour.
    color = linear.mean(0) / jnp.quantile(linear.mean(0)[mask], 0.99)
    light, losses = fit_light(
        linear[0], jnp.asarray(normals), Materials(jnp.clip(0.8 * color, 0, 1))
    )
    print(f"mean absolute difference {losses[0]:.4f} -> {losses[-1]:.4f}")
    print("lamp from", ", ".join(f"{x:.2f}" for x in light.direction))


if __name__ == "__main__":
    main()
