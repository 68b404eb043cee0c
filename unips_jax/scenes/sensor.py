"""The camera's electronics: exposure, colour, blur, noise, response, quantisation."""

import jax
import jax.numpy as jnp
from jax import Array

from unips_jax.scenes.config import SceneConfig
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.noise import pixel_noise
from unips_jax.scenes.rims import Rims, band, draw_rims, miss, mix


def exposure(radiance: Array, mask: Array, target: Array, spare: Array | bool) -> Array:
    """The factor that brings each image `[N, 3, H, W]` to a target brightness, `[N]`.

    The measure lies between the bright end (mean plus two standard deviations) and the
    typical value (from the mean root), so that neither highlights nor shadows alone
    decide. For a matt sphere it is about the brightest value. With `spare` it is the
    mean plus six standard deviations, so that highlights are seldom clipped. `target`
    `[N]` is a share of the sensor's range.
    """
    weight = mask.astype(jnp.float32)
    total = 3 * jnp.maximum(jnp.sum(weight), 1.0)

    def mean(values: Array) -> Array:
        return jnp.sum(values * weight, (1, 2, 3), keepdims=True) / total

    middle, square = mean(radiance), mean(radiance * radiance)
    root = mean(jnp.sqrt(jnp.maximum(radiance, 0.0)))
    deviation = jnp.sqrt(jnp.maximum(square - middle * middle, 0.0))
    usual = jnp.sqrt((middle + 2 * deviation) * 2.2 * root * root)
    measure = jnp.where(spare, middle + 6 * deviation, usual) + 1e-6
    return target / measure[:, 0, 0, 0]


def blur(images: Array, mask: Array, amount: Array) -> Array:
    """Averages with the masked neighbours, weight `amount` for each of four."""
    # Products with banded matrices: shifted copies would make the compiler evaluate
    # everything before them several times.
    weight = mask.astype(jnp.float32)
    rows, columns = (band(size, amount) for size in mask.shape)
    return (rows @ images @ columns) / (rows @ weight @ columns + 1e-6)


def erode(mask: Array, uniform: Array, rate: Array) -> Array:
    """Drops border pixels, each with a probability, but none at the frame."""
    around = jnp.pad(mask, 1, constant_values=True)
    across = around[1:-1, :-2] & around[1:-1, 2:]
    inside = mask & across & around[:-2, 1:-1] & around[2:, 1:-1]
    return inside | (mask & (uniform >= rate))


def _response(x: Array, curve: Array, gamma: Array) -> Array:
    """0 linear, 1 sRGB, 2 gamma, 3 a contrast curve on top of a gamma."""
    x = jnp.maximum(x, 1e-6)
    power = jnp.where(curve == 1, 1 / 2.4, 1 / gamma)
    raised = jnp.exp(power * jnp.log(x))
    srgb = jnp.where(x < 0.0031308, 12.92 * x, 1.055 * raised - 0.055)
    contrast = raised * raised * (3 - 2 * raised)
    contrast = raised + 0.5 * (contrast - raised)
    return jnp.where(
        curve == 0,
        x,
        jnp.where(curve == 1, srgb, jnp.where(curve == 2, raised, contrast)),
    )


def _from_srgb(x: Array) -> Array:
    raised = jnp.exp(2.4 * jnp.log((x + 0.055) / 1.055))
    return jnp.where(x <= 0.04045, x / 12.92, raised)


def _rims(key: Array, images: Array, mask: Array) -> Rims:
    key_draws, key_uniform = jax.random.split(key)
    weight = mask / jnp.maximum(jnp.sum(mask), 1)
    return draw_rims(
        Draws(key_draws, 48 + 3 * images.shape[0]),
        jax.random.uniform(key_uniform, mask.shape),
        jnp.sum(images * weight, (2, 3)),
        mask,
    )


def record(
    key: Array, radiance: Array, mask: Array, config: SceneConfig
) -> tuple[Array, Array, Array]:
    """What the camera records of linear radiance `[N, 3, H, W]`.

    Returns images `[N, 3, H, W]`, at most 1, zero outside the mask; the mask, which
    with `rim_rate` may be `rims.REACH` pixels larger than the object; and the factor of
    exposure and white balance, `[N, 3]`, before response and clipping.
    """
    key_draws, key_noise, key_mask = jax.random.split(key, 3)
    draws = Draws(key_draws, 32 + radiance.shape[0])
    target = draws.log_uniform(0.3, 0.9, radiance.shape[0])
    if not config.sensor:
        gain = exposure(radiance, mask, jnp.full_like(target, 0.8), False)[:, None]
        gain = jnp.broadcast_to(gain, radiance.shape[:2])
        return radiance * gain[..., None, None] * mask, mask, gain
    balance = jnp.exp(draws.uniform(-0.2, 0.2, 3)).at[1].set(1.0)
    balanced = radiance * balance[:, None, None]
    spare = draws.chance(config.spare_rate)
    gain = exposure(balanced, mask, target, spare)[:, None] * balance
    images = radiance * gain[..., None, None] * mask
    amount = jnp.where(draws.chance(config.blur_rate), draws.uniform(0.0, 0.35), 0.0)
    images = blur(images, mask, amount)
    rims = None
    rimmed = jnp.bool_(False)
    if config.rim_rate or config.mixed_rate:
        rims = _rims(jax.random.fold_in(key, 1), images, mask)
        rimmed = jax.random.uniform(jax.random.fold_in(key, 2)) < config.rim_rate
        mixed = jax.random.uniform(jax.random.fold_in(key, 3)) < config.mixed_rate
        rims = rims._replace(mixed=rims.mixed | ~rimmed)
        images = jnp.where(rimmed | mixed, mix(rims, images, mask), images)
    noisy = draws.chance(config.noise_rate)
    shot = jnp.where(noisy, draws.log_uniform(1e-5, 1e-3), 1e-7)
    read = jnp.where(noisy, draws.log_uniform(1e-4, 5e-3), 1e-5)
    seed = jax.random.bits(key_noise, (), jnp.uint32)
    noise = pixel_noise(seed, images.shape)
    images = images + noise * jnp.sqrt(shot * jnp.maximum(images, 0.0) + read**2)
    images = jnp.clip(images, 0.0, 1.0)
    curved = 1 - config.linear_rate
    # Mostly sRGB's: what remains of others is hard to tell from slopes.
    weights = [config.linear_rate, 0.7 * curved, 0.2 * curved, 0.1 * curved]
    curve = draws.choice(weights)
    images = _response(images, curve, draws.uniform(1.9, 2.5))
    coarse = draws.chance(jnp.where(curve == 0, config.eight_bit_rate, 0.8))
    levels = jnp.where(coarse, 255.0, 65535.0)
    images = jnp.round(images * levels) / levels
    # Photographs of 8 bits are taken as sRGB: of other curves a part remains.
    images = jnp.where(coarse & (curve != 0), _from_srgb(images), images)
    rate = jnp.where(draws.chance(config.mask_error_rate), draws.uniform(0.2, 1.0), 0)
    eroded = erode(mask, jax.random.uniform(key_mask, mask.shape), rate)
    mask = eroded if rims is None else jnp.where(rimmed, miss(rims, mask), eroded)
    return images * mask, mask, gain
