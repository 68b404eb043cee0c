"""GCNet and LCNet: lights estimated by a network, then any calibrated method.

The published rows use PS-FCN for the normals, here `ps_fcn`. Source: Chen et al.,
"What is learned in deep uncalibrated photometric stereo?" (ECCV 2020); "PS-FCN: a
flexible learning framework for photometric stereo" (ECCV 2018); "Self-calibrating
deep photometric stereo networks" (CVPR 2019). A re-implementation of the authors'
architecture, checked against their networks' numbers. Their weights are not part of
this package: the user supplies and converts them (`gcnet_weights.from_official`).
Without weights the methods raise `Unsupported`; nothing runs untrained.

The networks are not indifferent to exposure. The UniPS paper rescales each image
linearly "so that values lie between 0 and 0.1" while dividing by 0.1 of its maximum,
which gives [0, 10]; `norm` offers both readings ("range01" and "literal10"), and
`per` whether each image or the whole stack has its maximum there. `per="image"`
erases the exposures' ratios for the network; estimated intensities are multiplied
back, so they always refer to the images as given.
"""

import functools
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.baselines.calibrated import check_lights
from unips_jax.baselines.gcnet import model
from unips_jax.baselines.gcnet.lights import hard_lights, light_errors, soft_lights
from unips_jax.baselines.gcnet.model import Params
from unips_jax.baselines.gcnet.weights import Network, load_params
from unips_jax.baselines.method import Estimated, Lights, Method, Observed, Unsupported
from unips_jax.baselines.pixels import object_pixels

Norm = Literal["range01", "literal10", "none"]
Per = Literal["image", "stack"]
Weights = Params | Path | str | None

_PEAK = {"range01": 0.1, "literal10": 10.0}
_MIN_IMAGES = 2


def gcnet(
    weights: Weights = None,
    *,
    normals: Method | None = None,
    norm: Norm = "range01",
    per: Per = "image",
    margin: int | None = 15,
    side: int = 128,
) -> Method:
    """GCNet's lights, then a calibrated method's normals.

    Args:
        weights: GCNet's parameters, or a file written by `save_params`.
        normals: the calibrated method, `ps_fcn(...)` in the published rows.
        norm: where the images' maximum is put: at 0.1 ("range01"), at 10
            ("literal10"), or left ("none").
        per: whether that maximum is each image's or the whole stack's.
        margin: crop to the mask's box with so many pixels around it, as in the
            authors' evaluations; None to use the images as they come.
        side: of the images that the lighting networks see; they were trained for it.

    Returns:
        The method; it needs no lights, and measures those it finds by them if given.
    """
    options = {"norm": norm, "per": per, "margin": margin, "side": side}
    return _uncalibrated("gcnet", weights, normals, options)


def lcnet(
    weights: Weights = None,
    *,
    normals: Method | None = None,
    norm: Norm = "range01",
    per: Per = "image",
    margin: int | None = 15,
) -> Method:
    """LCNet's lights (SDPS-Net's first stage), then a calibrated method's normals.

    The arguments are those of `gcnet`.
    """
    options = {"norm": norm, "per": per, "margin": margin}
    return _uncalibrated("lcnet", weights, normals, options)


def ps_fcn(
    weights: Weights = None, *, margin: int | None = 15, chunk: int = 8
) -> Method:
    """PS-FCN: normals under known lights, at the images' own size.

    The network expects images of about [0, 1] under lights of about unit intensity:
    16-bit values over 65535 on DiLiGenT.

    Args:
        weights: PS-FCN's parameters, or a file written by `save_params`.
        margin: crop around the mask, as in `gcnet`.
        chunk: images in memory at a time.

    Returns:
        The method; it needs lights.
    """
    loaded = _loader("ps_fcn", weights)

    def method(observed: Observed) -> np.ndarray:
        params = loaded()
        _, mask = object_pixels(observed, name="ps_fcn", minimum=1)
        directions, intensities = check_lights("ps_fcn", observed, coplanar=True)
        rows, columns = _box(mask, margin)
        inside = mask[rows, columns]
        crop = _masked(observed.images[:, rows, columns], inside)
        height, width = inside.shape
        pad = ((0, 0), (0, -height % 4), (0, -width % 4), (0, 0))
        estimate = _normals(params, np.pad(crop, pad), directions, intensities, chunk)
        normals = np.zeros((*mask.shape, 3), np.float32)
        normals[rows, columns] = np.asarray(estimate)[:height, :width]
        return normals * mask[..., None]

    return method


def estimate_lights(
    params: Params,
    observed: Observed,
    *,
    norm: Norm = "range01",
    per: Per = "image",
    margin: int | None = 15,
    side: int = 128,
) -> Lights:
    """Light directions and intensities of an object's images.

    Args:
        params: parameters of GCNet or of LCNet.
        observed: the images and the mask.
        norm: as in `gcnet`.
        per: as in `gcnet`.
        margin: as in `gcnet`.
        side: as in `gcnet`.

    Returns:
        Directions `[N, 3]`, unit, z >= 0; intensities `[N, 3]`, equal over the
        channels, for the images as given: dividing by them brings all images to one
        exposure. Their common scale has no meaning.

    Raises:
        Unsupported: if there are fewer than two images, or no object.
    """
    _, mask = object_pixels(observed, name="estimate_lights", minimum=_MIN_IMAGES)
    rows, columns = _box(mask, margin)
    crop, inside = observed.images[:, rows, columns], mask[rows, columns]
    scaled, gain = normalise(crop, inside, norm=norm, per=per)
    network = _gcnet_lights if "light_1" in params else _lcnet_lights
    small, soft = _resized(_masked(scaled, inside), inside.astype(np.float32), side)
    directions, intensities = network(params, small, soft)
    intensities = np.asarray(intensities) / gain[:, None]
    return Lights(np.asarray(directions), np.repeat(intensities, 3, axis=1))


def normalise(
    images: np.ndarray, mask: np.ndarray, *, norm: Norm, per: Per
) -> tuple[np.ndarray, np.ndarray]:
    """Scales images so that their maximum over the mask is where `norm` puts it.

    Args:
        images: `[N, H, W, 3]`.
        mask: `[H, W]`, bool, not empty.
        norm: maximum at 0.1 ("range01"), at 10 ("literal10"), or as it is ("none").
        per: one maximum for each image, or one for the stack. An image that is black
            inside the mask is left as it is.

    Returns:
        The images, and the factor of each, `[N]`.

    Raises:
        ValueError: if `norm` or `per` is none of these.
    """
    if norm not in (*_PEAK, "none") or per not in ("image", "stack"):
        raise ValueError(
            f"expected norm in {(*_PEAK, 'none')} and per in ('image', 'stack'), got "
            f"{norm!r} and {per!r}"
        )
    gain = np.ones(len(images), np.float32)
    if norm != "none":
        peaks = images[:, mask].max(axis=(1, 2)).astype(np.float32)
        if per == "stack":
            peaks = np.full_like(peaks, peaks.max())
        gain = np.where(peaks > 0, _PEAK[norm] / np.where(peaks > 0, peaks, 1), 1)
        gain = gain.astype(np.float32)
    return images * gain[:, None, None, None], gain


def _uncalibrated(
    name: Network,
    weights: Weights,
    normals: Method | None,
    options: dict[str, Any],
) -> Method:
    loaded = _loader(name, weights)

    def method(observed: Observed) -> Estimated:
        params = loaded()
        if normals is None:
            raise Unsupported(
                f"{name}: needs a calibrated method for the normals, such as ps_fcn "
                "with converted PS-FCN_B_S_32.pth weights, or woodham"
            )
        object_pixels(observed, name=name, minimum=_MIN_IMAGES)
        found = estimate_lights(params, observed, **options)
        estimate = normals(observed._replace(lights=found))
        if isinstance(estimate, Estimated):
            estimate = estimate.normals
        true = observed.lights
        return Estimated(estimate, light_errors(found, true) if true else {})

    return method


_FILES = {
    "gcnet": "GCNet.pth",
    "ps_fcn": "PS-FCN_B_S_32.pth",
    "lcnet": "LCNet_CVPR2019.pth",
}


def _loader(name: Network, weights: Weights) -> Any:
    """A function that returns the parameters, read at its first call."""

    @functools.cache
    def loaded() -> Params:
        if weights is None:
            raise Unsupported(
                f"{name}: needs weights; supply the authors' {_FILES[name]}, converted "
                "(they cannot be shipped with this package)"
            )
        if not isinstance(weights, (str, Path)):
            return weights
        params, network = load_params(weights)
        if network != name:
            raise Unsupported(f"{name}: {weights} holds the weights of {network}")
        return params

    return loaded


def _box(mask: np.ndarray, margin: int | None) -> tuple[slice, slice]:
    """The mask's bounding box and a margin, within the image."""
    if margin is None:
        return slice(0, mask.shape[0]), slice(0, mask.shape[1])
    sides = []
    for axis, size in ((1, mask.shape[0]), (0, mask.shape[1])):
        inside = np.flatnonzero(mask.any(axis=axis))
        sides.append(
            slice(max(inside[0] - margin, 0), min(inside[-1] + 1 + margin, size))
        )
    return sides[0], sides[1]


def _masked(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None], images, 0).astype(np.float32)


@functools.partial(jax.jit, static_argnames="side")
def _resized(images: Array, mask: Array, side: int) -> tuple[Array, Array]:
    """Images `[N, H, W, 3]` and mask `[H, W]` at another size, half-pixel bilinear."""
    resize = functools.partial(jax.image.resize, method="linear", antialias=False)
    return (
        resize(images, (len(images), side, side, 3)),
        resize(mask, (side, side)),
    )


@jax.jit
def _gcnet_lights(params: Params, images: Array, mask: Array) -> tuple[Array, Array]:
    variables = {"params": params}
    stages: Any = model.gcnet_of(params).apply(variables, images[None], mask[None])
    directions, intensities = soft_lights(stages.second)
    return directions[0], intensities[0]


@jax.jit
def _lcnet_lights(params: Params, images: Array, mask: Array) -> tuple[Array, Array]:
    masks = jnp.broadcast_to(mask[..., None], (*images.shape[:-1], 1))
    x = jnp.concatenate([images, masks], axis=-1)[None]
    logits: Any = model.light_net_of(params).apply({"params": params}, x)
    directions, intensities = hard_lights(logits)
    return directions[0], intensities[0]


@functools.partial(jax.jit, static_argnums=4)
def _normals(
    params: Params, images: Array, directions: Array, intensities: Array, chunk: int
) -> Array:
    return model.normals_by_chunks(
        model.normal_net_of(params),
        params,
        images,
        directions,
        intensities,
        chunk=chunk,
    )
