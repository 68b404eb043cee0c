"""A subset of the Principled BSDF: base colour, roughness, metallic.

A diffuse lobe plus GGX with height-correlated Smith masking and Schlick's Fresnel; the
diffuse lobe is weighted by what the specular one leaves over on both ways (Kelemen),
which keeps the sum reciprocal and below one.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

DIELECTRIC_F0 = 0.04


class Surface(NamedTuple):
    """Reflectance at every pixel."""

    base_color: Array  # `[3, P]`, linear, in [0, 1]
    roughness: Array  # `[P]`, perceptual (the square root of GGX's alpha)
    metallic: Array  # `[P]`, in [0, 1]
    specular: Array  # scalar in [0, 1], weight of the dielectric lobe; 0 is Lambertian


def fresnel_f0(surface: Surface) -> Array:
    """Reflectance at normal incidence, `[3, P]`."""
    return DIELECTRIC_F0 + surface.metallic * (surface.base_color - DIELECTRIC_F0)


# Least-squares fits to the integrals of `ggx` over the hemisphere, for roughness in
# [0.06, 1]; largest error 0.045 (at grazing angles), standard deviation 0.01.
# Rows: powers of roughness 0..3.
_TOTAL_FIT = (  # columns: powers 0..3 of the cosine
    (0.9882, 0.4726, -1.3685, 0.8656),
    (-0.7182, 0.2868, 5.9688, -4.9373),
    (1.8145, -7.0983, -1.2869, 4.9095),
    (-1.1759, 4.7276, -1.5423, -1.6349),
)
_WHITE_FIT = (  # columns: powers 2, 4, 6, 9 of one minus the cosine
    (0.0952, -0.7093, 3.0041, -1.2498),
    (-0.6195, 7.2503, -13.7069, 3.602),
    (1.2558, -13.8375, 18.728, -2.2377),
    (-0.7358, 7.3725, -7.9934, -0.1806),
)
_MEAN_FIT = (0.0887, -0.0173, -0.1549, 0.1038)


def _polynomial(x: Array, coefficients: tuple[Array | float, ...]) -> Array:
    total: Array | float = 0.0
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total  # type: ignore[return-value]


def environment_brdf(cosine: Array, roughness: Array) -> tuple[Array, Array]:
    """Directional albedo of the specular lobe as F0 * a + b, a + b at most 1."""
    rows = [_polynomial(cosine, row) for row in _TOTAL_FIT]
    total = jnp.clip(_polynomial(roughness, tuple(rows)), 0.0, 1.0)
    m2 = (1 - cosine) ** 2
    powers = (m2, m2 * m2, m2 * m2 * m2, m2 * m2 * m2 * m2 * (1 - cosine))
    rows = [
        sum(c * power for c, power in zip(row, powers, strict=True))  # type: ignore[misc]
        for row in _WHITE_FIT
    ]
    white = jnp.clip(_polynomial(roughness, tuple(rows)), 0.0, total)
    return total - white, white


def dielectric_albedo(cosine: Array, roughness: Array) -> Array:
    """Share of light that the dielectric specular lobe reflects."""
    a, b = environment_brdf(cosine, roughness)
    return jnp.clip(DIELECTRIC_F0 * a + b, 0.0, 1.0)


def mean_dielectric_albedo(roughness: Array) -> Array:
    """Cosine-weighted mean of `dielectric_albedo` over the hemisphere (a fit)."""
    return _polynomial(roughness, _MEAN_FIT)


def ggx(n_h: Array, n_l: Array, n_v: Array, alpha: Array) -> Array:
    """Distribution times visibility, D G / (4 n_l n_v), height-correlated Smith.

    Of the normal's cosines to half vector, light and viewer, and GGX's width, roughness
    squared. In 1/sr, to be multiplied by Fresnel and n_l.
    """
    a2 = alpha * alpha
    d = jnp.maximum(n_h * n_h * (a2 - 1) + 1, a2)  # less by rounding alone
    distribution = a2 / (math.pi * d * d)
    light = n_v * jnp.sqrt(n_l * n_l * (1 - a2) + a2)
    viewer = n_l * jnp.sqrt(n_v * n_v * (1 - a2) + a2)
    return distribution * 0.5 / (light + viewer + 1e-6)


def schlick(cosine: Array) -> Array:
    """Schlick's weight of white: F = F0 + (1 - F0) * weight."""
    m = jnp.clip(1 - cosine, 0.0, 1.0)
    m2 = m * m
    return m2 * m2 * m


def specular_weight(surface: Surface) -> Array:
    """Weight of the specular lobe: 1 for metals, `specular` for the rest."""
    return surface.metallic + (1 - surface.metallic) * surface.specular


def reflectance(
    surface: Surface,
    *,
    n_l: Array,
    n_v: Array,
    n_h: Array,
    v_h: Array,
    widening: Array | float = 0.0,
) -> Array:
    """The bidirectional reflectance, `[3, P]` in 1/sr.

    Of cosines `[P]` in (0, 1] between normal (n), light (l), viewer (v) and half vector
    (h). `widening` is added to GGX's width for lights of some extent.
    """
    rough = surface.roughness
    alpha = jnp.minimum(rough * rough + widening, 1.0)
    left = 1 - surface.specular * dielectric_albedo(n_l, rough)
    left = left * (1 - surface.specular * dielectric_albedo(n_v, rough))
    mean = surface.specular * mean_dielectric_albedo(rough)
    f0, white = fresnel_f0(surface), schlick(v_h)
    lobe = ggx(n_h, n_l, n_v, alpha) * specular_weight(surface)
    diffuse = surface.base_color * (1 - surface.metallic)
    return diffuse * (left / ((1 - mean) * math.pi)) + (f0 + (1 - f0) * white) * lobe


def environment_reflectance(surface: Surface, n_v: Array) -> tuple[Array, Array]:
    """How much of its surroundings' light a surface sends to the viewer.

    Of the cosine `[P]`, in (0, 1], between normal and viewer: factors, `[3, P]` each,
    of the radiance's mean over the hemisphere, weighted by the cosine, and of its mean
    over the lobe around the mirror direction.
    """
    a, b = environment_brdf(n_v, surface.roughness)
    specular = (fresnel_f0(surface) * a + b) * specular_weight(surface)
    dielectric = surface.specular * dielectric_albedo(n_v, surface.roughness)
    diffuse = surface.base_color * (1 - surface.metallic) * (1 - dielectric)
    return diffuse, specular
