"""The light of each photograph, from photographs and normals, in linear light.

A matt surface's pixel is albedo times irradiance; a photograph's irradiance is that of
one lamp, the positive part of the cosine, plus that of smooth surroundings, spherical
harmonics of order two (Ramamoorthi and Hanrahan, SIGGRAPH 2001). Lights and albedos are
found in turns by least squares whose weights spare shadows and highlights.

Directions: least squares explain what is glossy by lights that are too oblique (the
contrast between photographs is larger than a matt surface's). The network's guesses of
the mean directions are far better and are taken as they are; without them directions
are fitted too, which suits matt objects under lamps alone. A photograph's exposure, the
lights' common colour and the albedo have a common factor that nothing settles: lights
are relative to the photographs' mean.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from unips_jax.io.color import Transfer, as_linear, usual_transfer
from unips_jax.lighting.harmonics import BAND, COSINE_LOBE, harmonics
from unips_jax.lighting.near import NearField, cosines

_SAMPLE = 8000  # pixels
_ROUNDS = 8
_STRIP = 2**20  # pixels of all photographs together
_DIRECTION_ROUNDS = 60
_FADE = 0.08  # irradiance: what is darker shows little
_FAINT = 0.1  # pull of albedos to the typical one, as of squared irradiance
_SPREAD = 0.18  # of albedos' logarithms: the pull grows by deviations against this
_BLACK = 1e-3  # of the typical albedo: no albedo is lower
_ABOVE = 0.6  # of the light on a pixel: shadows are more often than highlights
_CUT = 2.0  # deviations, above which residuals lose their weight
_AMBIENT = 0.3  # of the squared albedos: pull of the surroundings to their prior


class Lights(NamedTuple):
    """The lights of N photographs.

    Attributes:
        directions: `[N, 3]`, unit, to the key light; with surroundings, the mean
            direction of all light.
        directness: `[N]`, 1 for one lamp, 0 for light equally from everywhere.
        colors: `[N, 3]`, irradiance of the key light on what faces it. Over the
            photographs the whole light's irradiance there has mean 1 in each colour.
        harmonics: `[N, 9, 3]`, radiance of all light, the key's too; see
            `unips_jax.lighting.harmonics`.
        surroundings: `[N, 9, 3]`, radiance of all but the key.
        near: where lamps and surface are, if the lamps are near; directions and colours
            are then those at the image's middle.
        lamp_shares: `[N]`, a lamp's share of all light, in [0, 1], where the network
            tells kinds of light apart.
    """

    directions: np.ndarray
    directness: np.ndarray
    colors: np.ndarray
    harmonics: np.ndarray
    surroundings: np.ndarray
    near: NearField | None = None
    lamp_shares: np.ndarray | None = None


class Scales(NamedTuple):
    """What is usual among an image's pixels."""

    albedo: np.ndarray  # `[3]`
    # `[N, 1, 3]`, deviations of pixel over albedo from irradiance
    residuals: np.ndarray


def estimate_lights(
    images: np.ndarray,
    normals: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    guesses: np.ndarray | None = None,
    near: NearField | None = None,
    transfer: Transfer | None = None,
) -> Lights:
    """Estimates the light of each photograph.

    Args:
        images: `[N, H, W, 3]`, uint8, uint16 or float32.
        normals: `[H, W, 3]`, x right, y up, z towards the viewer, 0 where there is
            none.
        mask: `[H, W]`, above 0 on the object; None: where there are normals.
        guesses: `[N, 3]`, the lights' mean directions, 1 long for a lamp, shorter for
            scattered light, as `guessed_lights` gives them; None: they are fitted.
        near: where lamps that are near are, and the surface (`lighting.near`).
        transfer: how values encode light; None: "srgb" of 8 bits, else "linear".

    Returns:
        Directions `[N, 3]`, colours and more of each light, float64; see `Lights`.

    Raises:
        ValueError: if shapes do not fit, normals are integers, or no pixel has a
            normal.
    """
    images, normals = np.asarray(images), np.asarray(normals)
    mask = None if mask is None else np.asarray(mask)
    pixels, normal, index = _sample(images, normals, mask, transfer)
    count = len(pixels)
    if guesses is not None and np.shape(guesses) != (count, 3):
        raise ValueError(
            f"guesses: expected [N, 3] = {(count, 3)}, got {np.shape(guesses)}"
        )
    scale = np.maximum(pixels.mean((1, 2)), 1e-12)[:, None, None]
    pixels = pixels / scale
    if guesses is None:
        directions = _fitted_directions(pixels.mean(-1), normal)
        directness = np.ones(count)
    else:
        length = np.linalg.norm(guesses, axis=-1)
        directions = np.where(length[:, None] > 1e-6, guesses, [0.0, 0.0, 1.0])
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        directness = np.clip(length, 0, 1)
    field = () if near is None else (near.distance, near.places[index])
    cosine = cosines(directions, normal, *field)
    coefficients = _fitted_light(pixels, normal, cosine, directness)
    return _lights(coefficients * scale, directions, directness)._replace(near=near)


def irradiance(lights: Lights, normals: np.ndarray, index: Any = None) -> np.ndarray:
    """Irradiance on unit normals `[P, 3]`, without cast shadows: `[N, P, 3]`, >= 0.

    `index` takes their pixels from an image, for lamps that are near.
    """
    near = lights.near if index is not None else None
    field = () if near is None else (near.distance, near.places[index])
    cosine = cosines(lights.directions, normals, *field)
    coefficients = COSINE_LOBE[BAND][:, None] * lights.surroundings
    around = harmonics(normals) @ coefficients  # [N, P, 3]
    return np.maximum(cosine[..., None] * lights.colors[:, None] + around, 0)


def robust_albedo(
    pixels: np.ndarray,
    light: np.ndarray,
    *,
    scales: Scales | None = None,
    rounds: int = 3,
) -> np.ndarray:
    """Albedo that explains pixels best, but for shadows and highlights: `[P, 3]`, > 0.

    Of pixels and irradiance `[N, P, 3]`. With two photographs or fewer nothing is
    spared. `scales` are of more pixels than these, so that parts of an image fit
    together.
    """
    known = np.clip(light / _FADE, 0, 1)
    typical = None if scales is None else scales.albedo
    own, albedo = _quotients(known, pixels, light, typical, _FAINT)
    if len(pixels) < 3:
        return albedo
    own = np.maximum(_usual_ratio(known, pixels, light), _BLACK * albedo)
    for _ in range(rounds):
        # By the pixel's own albedo: one pulled to the typical one would make all
        # photographs of dark paint look wrong, and then the pull alone would count.
        off = pixels / np.maximum(own, 1e-12) - light
        size = _size(off) if scales is None else scales.residuals
        pull = _FAINT + np.square(size / _SPREAD).mean(0)
        weight = known * _spared(off, size)
        own, albedo = _quotients(weight, pixels, light, typical, pull)
    return albedo


def strips(images: np.ndarray) -> Iterator[slice]:
    """Rows of photographs `[N, H, W, ...]`, as many at a time as memory should hold."""
    count, height, width = images.shape[:3]
    step = max(1, _STRIP // (count * width))
    return (slice(top, top + step) for top in range(0, height, step))


def albedo_scales(pixels: np.ndarray, light: np.ndarray) -> Scales:
    """What `robust_albedo` compares pixels with, of the same arguments."""
    albedo = robust_albedo(pixels, light)
    return Scales(np.median(albedo, axis=0), _size(pixels / albedo - light))


def _quotients(
    weight: np.ndarray,
    pixels: np.ndarray,
    light: np.ndarray,
    typical: np.ndarray | None,
    pull: np.ndarray | float,
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels' own albedos, and those that are pulled to the typical one: `[P, 3]`."""
    below = (weight * light * light).sum(0)
    own = (weight * light * pixels).sum(0) / np.maximum(below, 1e-12)
    typical = np.maximum(np.median(own, axis=0) if typical is None else typical, 1e-12)
    own = np.maximum(own, _BLACK * typical)
    # The pull decides where photographs show little; of the logarithms, since what is
    # added to dark paint would be most of it.
    return own, own * (typical / own) ** (pull / (below + pull))


def _usual_ratio(
    known: np.ndarray, pixels: np.ndarray, light: np.ndarray
) -> np.ndarray:
    """Pixel over irradiance as most photographs have it, few of them in shadow."""
    ratio, weight = pixels / np.maximum(light, 1e-12), known * light
    order = np.argsort(ratio, axis=0)
    part = np.cumsum(np.take_along_axis(weight, order, 0), axis=0)
    place = (part >= _ABOVE * part[-1]).argmax(0)
    chosen = np.take_along_axis(order, place[None], 0)
    return np.take_along_axis(ratio, chosen, 0)[0]


def _spared(off: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Weights of pixels, small where the model is far from them: `[N, P, 3]`."""
    return 1 / (1 + (off / (_CUT * size)) ** 2)


def _size(off: np.ndarray) -> np.ndarray:
    """Deviations, robust, of each photograph and colour: `[N, 1, 3]`."""
    return np.median(np.abs(off), axis=1, keepdims=True) * 1.4826 + 1e-9


def _sample(
    images: np.ndarray,
    normals: np.ndarray,
    mask: np.ndarray | None,
    transfer: Transfer | None,
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Some pixels, `[N, P, 3]`, their normals, `[P, 3]`, and places; float64."""
    if images.ndim != 4 or images.shape[-1] != 3:
        raise ValueError(f"images: expected [N, H, W, 3], got {images.shape}")
    size = images.shape[1:3]
    if normals.shape != (*size, 3):
        raise ValueError(
            f"normals: expected {(*size, 3)} as of the images, got {normals.shape}"
        )
    if normals.dtype.kind in "uib":
        raise ValueError(
            f"normals: expected floats of unit length, got {normals.dtype}; "
            "read_normals decodes a normal map"
        )
    if mask is not None and mask.shape != size:
        raise ValueError(f"mask: expected {size} as of the images, got {mask.shape}")
    there = np.isfinite(normals).all(-1) & (normals != 0).any(-1)
    rows, columns = np.nonzero(there if mask is None else there & (mask > 0))
    if not rows.size:
        raise ValueError("normals: expected some inside the mask, got none")
    pick = np.random.default_rng(0).permutation(rows.size)[:_SAMPLE]
    rows, columns = rows[pick], columns[pick]
    encoded = usual_transfer(images.dtype) if transfer is None else transfer
    pixels = as_linear(images[:, rows, columns], encoded).astype(np.float64)
    finite = np.isfinite(pixels).all((0, 2))
    if not finite.any():
        raise ValueError("images: expected some finite pixels, got none")
    pixels, rows, columns = pixels[:, finite], rows[finite], columns[finite]
    normal = normals[rows, columns].astype(np.float64)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return pixels, normal, (rows, columns)


def _fitted_directions(grey: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Directions of lamps, `[N, 3]`, from `grey [N, P]`, in turns with the albedo."""
    # The first albedo: as if all lights together came from the viewer.
    albedo = grey.mean(0) / np.maximum(normal[:, 2], 0.3)
    if len(grey) < 3:
        albedo = np.ones_like(albedo)
    weight = np.ones_like(grey)
    lights = np.zeros((len(grey), 3))
    lit = np.ones_like(grey)
    for _ in range(_DIRECTION_ROUNDS):
        for index, values in enumerate(grey):
            basis = (albedo * lit[index])[:, None] * normal
            gram = basis.T @ (weight[index][:, None] * basis)
            ridge = max(1e-3 * np.trace(gram) / 3, np.finfo(float).tiny)
            gram += np.eye(3) * ridge  # of a black photograph, too
            lights[index] = np.linalg.solve(gram, basis.T @ (weight[index] * values))
        shading = np.maximum(lights @ normal.T, 0)
        lit = (shading > 0).astype(float)
        if len(grey) > 2:
            known = np.clip(shading / _FADE, 0, 1)
            albedo = _quotients(known, grey, shading, None, _FAINT)[0]
        off = grey / np.maximum(albedo, 1e-12) - shading
        weight = _spared(off, _size(off))
    length = np.linalg.norm(lights, axis=-1, keepdims=True)
    return np.where(length > 1e-9, lights / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])


def _fitted_light(
    pixels: np.ndarray, normal: np.ndarray, cosine: np.ndarray, directness: np.ndarray
) -> np.ndarray:
    """The irradiance's key colour and surroundings' coefficients, `[N, 10, 3]`."""
    smooth = harmonics(normal)  # [P, 9]
    # Even light of power 1 gives everything an irradiance of a quarter.
    share = np.clip(directness, 0.05, 1)
    prior = np.zeros((len(pixels), 10))
    prior[:, 0], prior[:, 1] = share, (1 - share) / 4 / smooth[0, 0]
    pull = _AMBIENT * np.array([0.02, *(1 + 2.0 * BAND)])
    found = np.repeat(prior[..., None], 3, -1)
    for _ in range(_ROUNDS):
        light = np.maximum(
            cosine[..., None] * found[:, :1] + smooth @ found[:, 1:], 1e-3
        )
        albedo = robust_albedo(pixels, light, rounds=2)
        if len(pixels) < 3:
            albedo = np.broadcast_to(np.median(albedo, 0), albedo.shape)
        off = pixels / np.maximum(albedo, 1e-12) - light
        weight = _spared(off, _size(off))
        for index, color in np.ndindex(len(pixels), 3):
            basis = np.concatenate([cosine[index][:, None], smooth], 1)
            basis = basis * albedo[:, color, None]
            weighed = basis * weight[index, :, color, None]
            gram = weighed.T @ basis
            strength = pull * np.trace(gram) / 10
            values = weighed.T @ pixels[index, :, color]
            size = found[index, 0, color] / prior[index, 0]
            solution = np.linalg.solve(
                gram + np.diag(strength), values + strength * prior[index] * size
            )
            solution[0] = max(solution[0], 1e-3 * size)
            found[index, :, color] = solution
    return found


def _lights(
    coefficients: np.ndarray, directions: np.ndarray, directness: np.ndarray
) -> Lights:
    """Brings coefficients `[N, 10, 3]` to the mean of the photographs."""
    towards = harmonics(directions)  # [N, 9]
    facing = coefficients[:, 0] + np.einsum("nk,nkc->nc", towards, coefficients[:, 1:])
    coefficients = coefficients / np.maximum(facing.mean(0), 1e-12)
    around = coefficients[:, 1:] / COSINE_LOBE[BAND][:, None]
    colors = coefficients[:, 0]
    whole = around + towards[..., None] * colors[:, None]
    return Lights(directions, directness, colors, whole, around)
