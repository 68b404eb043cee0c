"""Angular errors of normal maps."""

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def angular_error_deg(predicted: ArrayLike, true: ArrayLike) -> Array:
    """Angle between two fields of vectors; their lengths do not matter.

    Computed as atan2(|a x b|, a . b), which keeps full precision near 0 and 180
    degrees where the arc cosine loses half of the digits.

    Args:
        predicted: `[..., 3]`.
        true: `[..., 3]`, broadcast against `predicted`.

    Returns:
        Angles in degrees, `[...]`, in [0, 180]; 90 where either vector is zero, as
        DiLiGenT's published table counts it, and where both are: average inside the
        mask alone (`mean_angular_error_deg`). The gradient is 0 there, and where the
        vectors are parallel.

    Raises:
        ValueError: if the last axis is not of 3, or for unsigned integers, as of a
            normal map that `read_normals` decodes.
    """
    predicted = _of_unit_size(_vectors("predicted", predicted))
    true = _of_unit_size(_vectors("true", true))
    squared = jnp.sum(jnp.cross(predicted, true) ** 2, axis=-1)
    parallel = squared == 0
    # Both arguments of a `where` are differentiated: the one not taken must be finite.
    cross = jnp.where(parallel, 0.0, jnp.sqrt(jnp.where(parallel, 1.0, squared)))
    dot = jnp.sum(predicted * true, axis=-1)
    zero = parallel & (dot == 0)
    angle = jnp.rad2deg(jnp.arctan2(cross, jnp.where(zero, 1.0, dot)))
    return jnp.where(zero, 90.0, angle)


def _vectors(name: str, values: ArrayLike) -> Array:
    values = jnp.asarray(values)
    unsigned = jnp.issubdtype(values.dtype, jnp.unsignedinteger)
    if values.shape[-1:] != (3,) or unsigned:
        raise ValueError(
            f"{name}: expected vectors [..., 3], got {values.dtype} of {values.shape}; "
            "read_normals decodes a normal map"
        )
    return values.astype(jnp.float32)


def _of_unit_size(vectors: Array) -> Array:
    """Scaled, so that no square leaves float32's range; angles stay."""
    largest = jnp.max(jnp.abs(vectors), axis=-1, keepdims=True)
    return vectors / jax.lax.stop_gradient(jnp.where(largest > 0, largest, 1.0))


def mean_angular_error_deg(
    predicted: ArrayLike, true: ArrayLike, mask: ArrayLike
) -> Array:
    """Mean angle over the mask, in degrees; NaN if the mask is empty.

    The mask, `[...]`, and the fields of vectors, `[..., 3]`, broadcast. What is outside
    counts for nothing, and has no gradient, if it is NaN, too. `ValueError` as of
    `angular_error_deg`, or for shapes that do not fit.
    """
    mask = jnp.asarray(mask)
    inside = mask > jnp.zeros_like(mask)  # of its type, for strict promotion
    predicted, true = _vectors("predicted", predicted), _vectors("true", true)
    shapes = mask.shape, predicted.shape[:-1], true.shape[:-1]
    try:
        jnp.broadcast_shapes(*shapes)
    except ValueError:
        raise ValueError(
            f"mask: expected the shape of the vectors, {shapes[1]} and {shapes[2]}, "
            f"got {shapes[0]}"
        ) from None
    # What has no gradient must be finite all the same: 0 times NaN is NaN.
    predicted = jnp.where(inside[..., None], predicted, 0)
    true = jnp.where(inside[..., None], true, 0)
    inside, error = jnp.broadcast_arrays(inside, angular_error_deg(predicted, true))
    count = jnp.sum(inside).astype(error.dtype)
    return jnp.sum(jnp.where(inside, error, 0.0)) / count
