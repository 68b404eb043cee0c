"""The estimator as one serialised function, by `jax.export`.

What is loaded needs JAX and `flatbuffers` alone: neither this package nor Flax nor a
weights file. It takes sets of up to N images; flags tell which of the N count.

    python examples/export_round_trip.py estimator.bin
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import Array, export

from unips_jax import UniversalNetwork, estimate_normals


def exported(network: UniversalNetwork, *, num_images: int, size: int) -> bytes:
    """Serialises the estimator for images of one size.

    Args:
        network: becomes part of the function.
        num_images: N.
        size: side of the images in pixels.

    Returns:
        Bytes that `jax.export.deserialize` reads, of a function of images
        `[N, size, size, 3]`, a mask `[size, size]` and flags `[N]`.
    """

    def estimate(images: Array, mask: Array, valid: Array) -> Array:
        return estimate_normals(network, images, mask, valid=valid)

    function = export.export(jax.jit(estimate))(
        jax.ShapeDtypeStruct((num_images, size, size, 3), jnp.float32),
        jax.ShapeDtypeStruct((size, size), jnp.bool_),
        jax.ShapeDtypeStruct((num_images,), jnp.bool_),
    )
    return bytes(function.serialize())


def main() -> None:
    """Writes the shipped network for up to eight images of 128 x 128 pixels."""
    from unips_jax import load_weights

    path = Path(sys.argv[1] if len(sys.argv) > 1 else "estimator.bin")
    path.write_bytes(exported(load_weights("tiny"), num_images=8, size=128))
    print(f"wrote {path}, {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
