"""A network, and its one pass: encode a set of images, decode pixels.

What estimates, exports or trains need not know which network it has.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict
from jax import Array

from unips_jax.errors import InputError
from unips_jax.models import ops, self_calibrating, unips
from unips_jax.models.config import ModelConfig, SelfCalibratingConfig
from unips_jax.models.encoding import Encoded, Guesses, Pieces, whole
from unips_jax.models.known_lights import moved_to_known
from unips_jax.models.views import Frame, Views, context_cells

Params = dict[str, Any]

_NAMED = 8  # parameters of one kind in an error's line


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["params"], meta_fields=["config"]
)
@dataclasses.dataclass(frozen=True, eq=False)
class UniversalNetwork:
    """A network: its configuration and its parameters.

    A pytree whose leaves are the parameters; the configuration is static. So it can be
    an argument of functions under `jit`, `grad` and `vmap`, and a gradient with respect
    to it is a `UniversalNetwork` again.

    Attributes:
        config: which network, and its sizes.
        params: nested dictionaries of float32 arrays, "encoder" and "decoder".
    """

    config: ModelConfig
    params: Any


class EncoderDecoder(nn.Module):
    """The Flax module of either network, as its configuration says."""

    config: ModelConfig

    def setup(self) -> None:
        ours = isinstance(self.config, SelfCalibratingConfig)
        network: Any = self_calibrating if ours else unips
        self.encoder = network.Encoder(self.config)
        self.decoder = network.Decoder(self.config)

    def encode(
        self,
        images: Array,
        valid: Array | None = None,
        deterministic: bool = True,
        **options: Any,
    ) -> Encoded:
        """Contexts of sets of images `[..., N, s, s, 4]`; see `encode`."""
        return self.encoder(images, valid, deterministic, **options)

    def decode(
        self,
        pixels: Array,
        contexts: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Unit normals `[..., 3]` of sets; see `decode_sets`."""
        return self.decoder(pixels, contexts, valid, deterministic)

    def __call__(
        self,
        images: Array,
        pixels: Array,
        rows: Array,
        columns: Array,
        valid: Array | None = None,
        deterministic: bool = True,
    ) -> Array:
        """Normals `[P, 3]` of pixels `[P, N, 3]` of one view `[N, s, s, 4]`."""
        contexts = self.encode(images, valid, deterministic).contexts
        cells = jnp.moveaxis(contexts, 0, 2)
        read = read_contexts(cells, rows, columns, config=self.config)
        return self.decode(pixels, read, valid, deterministic)


class Encoding(NamedTuple):
    """What V views of an object are encoded to, for its pixels to be decoded with."""

    # [V, s/4, s/4, N, context_dim]: what a pixel reads lies in one place
    contexts: Array
    frame: Frame  # this and the next two: see `Views`
    mirrored: Array
    width: Array
    guesses: Guesses | None = None  # of each view


class Lamps(NamedTuple):
    """The lamps of N images, guessed by a network with tokens for kinds of light."""

    directions: Array | np.ndarray  # [N, 3], unit; of no meaning where there is no lamp
    shares: Array | np.ndarray  # [N], of all light, in [0, 1]


def encode(
    network: UniversalNetwork,
    views: Views,
    valid: Array | None = None,
    *,
    by_image: Pieces = whole,
    by_place: Pieces = whole,
    dropout: Array | None = None,
) -> Encoding:
    """Encodes views `[V, N, s, s, 4]`; in training, V objects of one view each.

    Needs the network's "encoder" alone. `valid [N]`: which images count (None: all);
    `by_image`, `by_place`: how to run what treats every image, and every place of the
    maps, alone; `dropout`: a key, in training.
    """
    lights: Any = {} if views.lights is None else {"lights": views.lights}
    encoded: Any = EncoderDecoder(network.config).apply(
        {"params": network.params},
        views.images,
        valid,
        dropout is None,
        **lights,
        by_image=by_image,
        by_place=by_place,
        rngs=None if dropout is None else {"dropout": dropout},
        method="encode",
    )
    contexts = jnp.moveaxis(encoded.contexts, 1, 3)
    return Encoding(contexts, *views[1:4], guesses=encoded.guesses)


def decode(
    network: UniversalNetwork,
    encoding: Encoding,
    pixels: Array,
    places: tuple[Array, Array],
    valid: Array | None = None,
) -> Array:
    """Unit normals `[P, 3]` of an object's pixels; of two views the mean.

    Needs the network's "decoder" alone. `pixels [P, N, 3]` are normalised RGB, `places`
    their rows and columns in the image; `valid [N]`: which images count (None: all).
    """
    rows, columns = places
    read: list[Array] = []
    for view, mirrored in zip(encoding.contexts, encoding.mirrored, strict=True):
        top, left, side = (x[len(read)] for x in encoding.frame)
        across = jnp.where(mirrored, encoding.width - 1 - columns, columns)
        cells = context_cells(rows, across, Frame(top, left, side), network.config)
        read.append(read_contexts(view, *cells, config=network.config))
    normals = decode_sets(network, pixels[None], jnp.stack(read), valid)  # [V, P, 3]
    normals = _mirrored_back(normals, encoding.mirrored)
    return normals[0] if len(read) == 1 else ops.normalize(jnp.sum(normals, axis=0))


def decode_sets(
    network: UniversalNetwork,
    pixels: Array,
    contexts: Array,
    valid: Array | None = None,
    *,
    dropout: Array | None = None,
) -> Array:
    """Unit normals `[..., 3]`, float32, of pixels `[..., N, 3]` with their contexts.

    Needs the network's "decoder" alone. Contexts `[..., N, C]` are from
    `read_contexts`; `dropout` is a key, in training.
    """
    decoded: Any = EncoderDecoder(network.config).apply(
        {"params": network.params},
        pixels,
        contexts,
        valid,
        dropout is None,
        rngs=None if dropout is None else {"dropout": dropout},
        method="decode",
    )
    return decoded


def with_uniform_contexts(encoding: Encoding, views: Views) -> Encoding:
    """Contexts as their mean over the mask, an ablation (UniPS, Table 5)."""
    contexts = encoding.contexts
    size = (contexts.shape[1], contexts.shape[2])
    inside = ops.resize_mask_nearest(views.images[..., 3], size)  # [V, N, h, w]
    inside = jnp.moveaxis(inside, 1, 3)[..., None].astype(contexts.dtype)
    total = jnp.sum(contexts * inside, axis=(1, 2), keepdims=True)
    count = jnp.maximum(jnp.sum(inside, axis=(1, 2), keepdims=True), 1)
    return encoding._replace(contexts=jnp.broadcast_to(total / count, contexts.shape))


def guessed_lights(encoding: Encoding) -> Array | None:
    """Mean directions of an object's lights, `[N, 3]`, the mean over the views.

    Weighted by power: about 1 long for one lamp, 0 for light that comes equally from
    everywhere (see `scenes.Scene.light_means`). None where the network makes no
    guesses.
    """
    if encoding.guesses is None:
        return None
    lights = _mirrored_back(encoding.guesses.lights, encoding.mirrored)
    return jnp.mean(lights, axis=0)


def guessed_lamps(encoding: Encoding, lights: Array | None = None) -> Lamps | None:
    """The lamps of an object's N images, the mean over the V views.

    They turn to known `lights [V, N, 3]` (see `models.known_lights`), those that the
    views have. None where the network has no tokens for kinds of light.
    """
    if encoding.guesses is None or encoding.guesses.kinds is None:
        return None
    kinds = encoding.guesses.kinds
    shares = [jax.nn.sigmoid(x) for x in (kinds.near_share, kinds.distant_share)]
    towards = ops.normalize(
        shares[0][..., None] * ops.normalize(kinds.near)
        + shares[1][..., None] * ops.normalize(kinds.distant)
    )
    if lights is not None:
        towards = towards + moved_to_known(towards, lights)
    towards = jnp.mean(_mirrored_back(towards, encoding.mirrored), axis=0)
    share = jnp.clip(jnp.mean(shares[0] + shares[1], axis=0), 0, 1)
    return Lamps(ops.normalize(towards), share)


def _mirrored_back(vectors: Array, mirrored: Array) -> Array:
    """Vectors `[V, K, 3]` of each view, in the frame of the images."""
    signs = jnp.where(mirrored[:, None], jnp.array([[-1, 1, 1]]), 1)
    return vectors * signs[:, None].astype(vectors.dtype)


def read_contexts(
    contexts: Array, rows: Array, columns: Array, *, config: ModelConfig
) -> Array:
    """Reads contexts `[h, w, N, C]` between their cells, at P places: `[P, N, C]`."""
    zeros = config.reads_at_corners
    return ops.bilinear_sample(contexts, rows, columns, zeros=zeros)


def init_params(config: ModelConfig, key: Array) -> Params:
    """Initialises a network; pure, so that it can be jitted or shape-evaluated."""
    # No parameter depends on the images' size: the smallest costs least.
    images, pixels = jnp.zeros((1, 4, 4, config.input_channels)), jnp.zeros((1, 1, 3))
    places = jnp.zeros(1)
    return EncoderDecoder(config).init(key, images, pixels, places, places)["params"]


@functools.lru_cache(maxsize=8)  # laying a network out takes longer than reading it
def param_shapes(config: ModelConfig) -> Mapping[str, tuple[int, ...]]:
    """The shapes of a network's parameters, by their paths joined by dots."""
    shapes = jax.eval_shape(lambda key: init_params(config, key), jax.random.key(0))
    return {k: v.shape for k, v in flatten_dict(shapes, sep=".").items()}


def raise_misfits(
    source: str, missing: list[str], unexpected: list[str], misshapen: list[str]
) -> None:
    """Raises `InputError` naming parameters that do not fit, if there are any."""
    problems = {"missing": missing, "unexpected": unexpected, "misshapen": misshapen}
    found = [
        f"{len(v)} {k}: {', '.join(v[:_NAMED])}{', ...' * (len(v) > _NAMED)}"
        for k, v in problems.items()
        if v
    ]
    if found:
        raise InputError(f"{source}: parameters do not fit. {'; '.join(found)}")


def check_images(network: UniversalNetwork, shape: tuple[int, ...]) -> None:
    """Raises `TypeError` unless it is a network, `ValueError` for a wrong shape."""
    if not isinstance(network, UniversalNetwork):
        raise TypeError(
            "network: expected a UniversalNetwork, as load_weights gives, got "
            f"{type(network).__name__}"
        )
    if len(shape) != 4 or shape[-1] != 3 or 0 in shape:
        raise ValueError(
            f"images: expected [N, H, W, 3] with at least one image and pixel, got "
            f"{shape}; {_hint(shape)}"
        )


def _hint(shape: tuple[int, ...]) -> str:
    """What to do about images of a wrong shape."""
    if len(shape) == 5:
        return "take one object at a time, or jax.vmap or jax.lax.map over them"
    if len(shape) == 4 and shape[1] == 3:
        return "channels come last: images.transpose(0, 2, 3, 1)"
    if len(shape) == 4 and shape[-1] == 4:
        return "leave alpha out: images[..., :3]"
    if len(shape) == 3 and shape[-1] == 3:
        return "of one image alone, images[None]"
    return "grey images must be repeated over three channels"


def check_mask(shape: tuple[int, ...], images: tuple[int, ...]) -> None:
    """Raises `ValueError` unless a mask has the size of images of a shape."""
    if shape != images[1:3]:
        raise ValueError(
            f"mask: expected the images' [H, W] = {images[1:3]}, got {shape}"
        )
