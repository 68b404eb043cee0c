"""The one face of both networks: encode a set of images, read contexts, decode pixels.

What estimates or trains goes through here, and need not know which network it has.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.traverse_util import flatten_dict
from jax import Array

from unips_jax.errors import InputError
from unips_jax.models import ops, self_calibrating, unips
from unips_jax.models.config import ModelConfig, SelfCalibratingConfig
from unips_jax.models.encoding import Encoded, Pieces, whole
from unips_jax.models.heads import Heads, Maps


class Network(nn.Module):
    """Either network, as its configuration says.

    Its parameters have two halves, "encoder" and "decoder"; `encode` needs only the one
    and `decode` the other. `decode_maps` also needs "heads", if it has them.

    Attributes:
        config: the network's configuration.
    """

    config: ModelConfig

    def setup(self) -> None:
        """Makes the halves, and the heads if there are any."""
        ours = isinstance(self.config, SelfCalibratingConfig)
        network: Any = self_calibrating if ours else unips
        self.encoder = network.Encoder(self.config)
        self.decoder = network.Decoder(self.config)
        if isinstance(self.config, SelfCalibratingConfig) and self.config.has_maps:
            self.heads = Heads(self.config.head_dim, jnp.dtype(self.config.dtype))

    def encode(
        self,
        images: Array,
        valid: Array | None = None,
        deterministic: bool = True,
        *,
        by_image: Pieces = whole,
        by_place: Pieces = whole,
    ) -> Encoded:
        """Computes the contexts of sets of images, and guesses if the network has them.

        Args:
            images: `[..., N, s, s, 4]`, of canonical size: normalised RGB and mask.
            valid: `[N]`, bool, or None where all images count.
            deterministic: no dropout.
            by_image: how to run what treats every image alone (see `models.encoding`).
            by_place: how to run what treats every place of the maps alone.
        """
        return self.encoder(
            images, valid, deterministic, by_image=by_image, by_place=by_place
        )

    def decode(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Predicts the normals of pixels from their sets.

        Args:
            pixels: `[..., N, 3]`, normalised RGB.
            contexts: `[..., N, context_dim]`, from `read_contexts`.
            valid: `[N]`, bool, or None.
            deterministic: no dropout.

        Returns:
            Unit normals, `[..., 3]`, float32.
        """
        normals, _ = self.decoder(pixels, contexts, valid, deterministic)
        return normals

    def decode_maps(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, Maps]:
        """Predicts normals, and what else is said of pixels; arguments as in `decode`.

        Only for networks that have heads (`ModelConfig.has_maps`).

        Returns:
            Unit normals, `[..., 3]`, float32, as from `decode`, and the maps.
        """
        normals, features = self.decoder(pixels, contexts, valid, deterministic)
        return normals, self.heads(features, pixels, valid)

    def __call__(
        self,
        images: Array,
        pixels: Array,
        rows: Array,
        columns: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Predicts the normals of some pixels of one object.

        Args:
            images: `[N, s, s, 4]`, see `encode`.
            pixels: `[P, N, 3]`, normalised RGB at the pixels.
            rows: `[P]`, the pixels' rows in cells of the contexts' grid.
            columns: `[P]`, likewise.
            valid: `[N]`, bool, or None.
            deterministic: no dropout.

        Returns:
            Unit normals, `[P, 3]`.
        """
        contexts = self.encode(images, valid, deterministic).contexts
        read = read_contexts(contexts, rows, columns, config=self.config)
        sets = pixels, jnp.swapaxes(read, 0, 1), valid, deterministic
        if self.is_initializing() and self.config.has_maps:
            return self.decode_maps(*sets)[0]
        return self.decode(*sets)


def read_contexts(
    contexts: Array, rows: Array, columns: Array, *, config: ModelConfig
) -> Array:
    """Reads contexts between the cells of their grid.

    Args:
        contexts: `[N, h, w, C]`.
        rows: `[P]`, in cells of the grid; 0 is the centre of the first cell.
        columns: `[P]`, likewise.
        config: the network's configuration.

    Returns:
        `[N, P, C]`.
    """
    zeros = config.reads_at_corners
    return ops.bilinear_sample(contexts, rows, columns, zeros=zeros)


def init_params(config: ModelConfig, key: Array) -> dict[str, Any]:
    """Initialises a network; pure, so that it can be jitted or shape-evaluated."""
    # No parameter depends on the images' size: the smallest costs least.
    images, pixels = jnp.zeros((1, 4, 4, 4)), jnp.zeros((1, 1, 3))
    places = jnp.zeros(1)
    return Network(config).init(key, images, pixels, places, places)["params"]


def param_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """The shapes of a network's parameters, by their paths joined by dots."""
    shapes = jax.eval_shape(lambda key: init_params(config, key), jax.random.key(0))
    return {k: v.shape for k, v in flatten_dict(shapes, sep=".").items()}


def raise_misfits(
    source: str, missing: list[str], unexpected: list[str], misshapen: list[str]
) -> None:
    """Raises `InputError` naming all parameters that do not fit, if there are any."""
    problems = {"missing": missing, "unexpected": unexpected, "misshapen": misshapen}
    found = [f"{len(v)} {k}: {', '.join(v)}" for k, v in problems.items() if v]
    if found:
        raise InputError(f"{source}: parameters do not fit. {'; '.join(found)}")
