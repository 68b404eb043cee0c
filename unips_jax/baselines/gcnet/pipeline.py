"""GCNet and LCNet: lights estimated by a network, then any calibrated method.

The published rows use PS-FCN for the normals, here `ps_fcn`. Source: Chen et al.,
"What is learned in deep uncalibrated photometric stereo?" (ECCV 2020); "PS-FCN: a
flexible learning framework for photometric stereo" (ECCV 2018); "Self-calibrating deep
photometric stereo networks" (CVPR 2019). A re-implementation of the authors'
architecture, checked against their networks' numbers. Their weights are not part of
this package: the user supplies and converts them (`gcnet.parameters.from_official`).
Without weights the methods raise `Unsupported`; nothing runs untrained.

The networks are not indifferent to exposure. The UniPS paper rescales each image
linearly "so that values lie between 0 and 0.1" while dividing by 0.1 of its maximum,
which gives [0, 10]; `norm` offers both readings ("range01" and "literal10"), and `per`
whether each image or the whole stack has its maximum there. `per="image"` erases the
exposures' ratios for the network; estimated intensities are multiplied back, so they
always refer to the images as given.
"""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from unips_jax.baselines.calibrated import check_lights
from unips_jax.baselines.gcnet import networks
from unips_jax.baselines.gcnet.crops import Norm, Per, box, masked, normalise, resized
from unips_jax.baselines.gcnet.lights import hard_lights, light_errors, soft_lights
from unips_jax.baselines.gcnet.networks import Params
from unips_jax.baselines.gcnet.parameters import Network, load_params
from unips_jax.baselines.method import Estimated, Lights, Method, Observed, Unsupported
from unips_jax.baselines.pixels import object_pixels

Weights = Params | Path | str | None

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
    """GCNet's lights, measured by the known ones if given; then a method's normals.

    Args:
        weights: GCNet's parameters, or a file written by `save_params`.
        normals: the calibrated method, `ps_fcn(...)` in the published rows.
        norm: where the images' maximum is put: at 0.1 ("range01"), at 10
            ("literal10"), or left ("none").
        per: whether that maximum is each image's or the whole stack's.
        margin: pixels around the mask's box, to which images are cropped, as in the
            authors' evaluations; None to use the images as they come.
        side: of the images that the lighting networks see; they were trained for it.
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
    """LCNet's lights (SDPS-Net's first stage), then a method's normals; as `gcnet`."""
    options = {"norm": norm, "per": per, "margin": margin}
    return _uncalibrated("lcnet", weights, normals, options)


def ps_fcn(
    weights: Weights = None, *, margin: int | None = 15, chunk: int = 8
) -> Method:
    """PS-FCN: normals under known lights, at the images' own size.

    The network expects images of about [0, 1] under lights of about unit intensity:
    16-bit values over 65535 on DiLiGenT. `margin` as in `gcnet`; `chunk` images are in
    memory at a time.
    """
    loaded = _loader("ps_fcn", weights)

    def method(observed: Observed) -> np.ndarray:
        params = loaded()
        _, mask = object_pixels(observed, name="ps_fcn", minimum=1)
        directions, intensities = check_lights("ps_fcn", observed, coplanar=True)
        rows, columns = box(mask, margin)
        inside = mask[rows, columns]
        crop = masked(observed.images[:, rows, columns], inside)
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
    """Light directions and intensities of an object's images, by GCNet or LCNet.

    Options are those of `gcnet`. Directions `[N, 3]` are unit, z >= 0; intensities
    `[N, 3]`, equal over the channels, are for the images as given: dividing by them
    brings all images to one exposure. Their common scale has no meaning.
    """
    _, mask = object_pixels(observed, name="estimate_lights", minimum=_MIN_IMAGES)
    rows, columns = box(mask, margin)
    crop, inside = observed.images[:, rows, columns], mask[rows, columns]
    scaled, gain = normalise(crop, inside, norm=norm, per=per)
    network = _gcnet_lights if "light_1" in params else _lcnet_lights
    small, soft = resized(masked(scaled, inside), inside.astype(np.float32), side)
    directions, intensities = network(params, small, soft)
    intensities = np.asarray(intensities) / gain[:, None]
    return Lights(np.asarray(directions), np.repeat(intensities, 3, axis=1))


def _uncalibrated(
    name: Network, weights: Weights, normals: Method | None, options: dict[str, Any]
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


@jax.jit
def _gcnet_lights(params: Params, images: Array, mask: Array) -> tuple[Array, Array]:
    variables = {"params": params}
    stages: Any = networks.gcnet_of(params).apply(variables, images[None], mask[None])
    directions, intensities = soft_lights(stages.second)
    return directions[0], intensities[0]


@jax.jit
def _lcnet_lights(params: Params, images: Array, mask: Array) -> tuple[Array, Array]:
    masks = jnp.broadcast_to(mask[..., None], (*images.shape[:-1], 1))
    x = jnp.concatenate([images, masks], axis=-1)[None]
    logits: Any = networks.light_net_of(params).apply({"params": params}, x)
    directions, intensities = hard_lights(logits)
    return directions[0], intensities[0]


@functools.partial(jax.jit, static_argnums=4)
def _normals(
    params: Params, images: Array, directions: Array, intensities: Array, chunk: int
) -> Array:
    return networks.normals_by_chunks(
        networks.normal_net_of(params),
        params,
        images,
        directions,
        intensities,
        chunk=chunk,
    )
