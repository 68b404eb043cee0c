"""The networks of GCNet, PS-FCN and LCNet, as Flax modules and pure functions.

Two lighting networks around a coarse normal network (GCNet: Chen et al., ECCV 2020),
a normal network for known lights (PS-FCN: Chen et al., ECCV 2018) and the earlier
lighting network LCNet (SDPS-Net: Chen et al., CVPR 2019). Channels last; images fuse
by the maximum of their features, so their order does not matter and they can be
processed a few at a time. All arithmetic is float32 at the highest matrix precision.

The released networks' widths are the modules' defaults; the `*_of` functions read
the widths from parameters, so smaller networks of the same design work too.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import Array, lax

from unips_jax.baselines.gcnet.lights import (
    NUM_ANGLES,
    NUM_INTENSITIES,
    Logits,
    soft_lights,
)

Params = Mapping[str, Any]

_STRIDES = (2, 2, 1, 2, 1, 2, 1)


class Stages(NamedTuple):
    """All of GCNet's intermediate answers; the last lighting is its result."""

    first: Logits
    normals: Array  # `[B, h, w, 3]`, the coarse normals times the mask
    # `[B, N, h, w]`, coarse normals under the first directions, in [0, 1]
    shading: Array
    second: Logits


class Conv(nn.Module):
    """Convolution padded by half the kernel, then LeakyReLU(0.1) unless linear."""

    features: int
    size: int = 3
    stride: int = 1
    use_bias: bool = True
    linear: bool = False

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """`[..., H, W, C]` -> `[..., H/stride, W/stride, features]`."""
        pad = self.size // 2
        x = nn.Conv(
            self.features,
            (self.size, self.size),
            strides=self.stride,
            padding=((pad, pad), (pad, pad)),
            use_bias=self.use_bias,
            kernel_init=nn.initializers.he_normal(),
            precision=lax.Precision.HIGHEST,
            name="conv",
        )(x)
        return x if self.linear else nn.leaky_relu(x, 0.1)


class _Twice(nn.Module):
    """Transposed convolution, kernel 4, stride 2: four convolutions with kernel 2."""

    # Each gives every second pixel. The sums are the same; the gradient with respect to
    # the kernel is twenty times faster on a CPU.

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """`[..., H, W, C]` -> `[..., 2H, 2W, features]`."""
        shape = (4, 4, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_normal(), shape)
        *batch, height, width, channels = x.shape
        flat = x.reshape(-1, height, width, channels)
        rows = [
            jnp.stack(
                [
                    lax.conv_general_dilated(
                        flat,
                        kernel[i::2, j::2],
                        (1, 1),
                        ((1 - i, i), (1 - j, j)),
                        dimension_numbers=("NHWC", "HWIO", "NHWC"),
                        precision=lax.Precision.HIGHEST,
                    )
                    for j in range(2)
                ],
                axis=3,
            )
            for i in range(2)
        ]
        y = jnp.stack(rows, axis=2)  # [P, H, 2, W, 2, features]
        return y.reshape(*batch, 2 * height, 2 * width, self.features)


class Deconv(nn.Module):
    """Transposed convolution, kernel 4, stride 2, no bias; then LeakyReLU(0.1)."""

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """`[..., H, W, C]` -> `[..., 2H, 2W, features]`."""
        return nn.leaky_relu(_Twice(self.features, name="conv")(x), 0.1)


class LightNet(nn.Module):
    """L-Net (and LCNet, by its widths): light directions and intensities as classes."""

    # channels of the extractor's seven convolutions
    widths: tuple[int, ...] = (32, 64, 64, 128, 128, 128, 256)
    classifier: int = 128  # channels of the classifier's four
    hidden: int = 64  # channels of the heads' first

    @nn.compact
    def __call__(self, x: Array) -> Logits:
        """Classifies the lights of `[B, N, 128, 128, C]` (or 64 a side).

        Channels are image, mask and, in the second network, coarse normals and shading.
        """
        for index, stride in enumerate(_STRIDES):
            width = self.widths[index]
            x = Conv(width, stride=stride, name=f"extractor_{index}")(x)
        features = x
        fused = jnp.broadcast_to(jnp.max(x, axis=1, keepdims=True), x.shape)
        x = jnp.concatenate([x, fused], axis=-1)  # [B, N, h, w, 2C]
        for index, stride in enumerate((1, 2, 2, 2)):
            name = f"classifier_{index}"
            x = Conv(self.classifier, stride=stride, name=name)(x)
        heads = {}
        for head, count in (
            ("azimuth", NUM_ANGLES),
            ("elevation", NUM_ANGLES),
            ("intensity", NUM_INTENSITIES),
        ):
            y = Conv(self.hidden, size=1, name=f"{head}_hidden")(x)
            y = Conv(count, size=1, linear=True, name=f"{head}_logits")(y)
            heads[head] = y[..., 0, 0, :]
        return Logits(features=features, **heads)


class NormalNet(nn.Module):
    """PS-FCN (and GCNet's N-Net, by its widths): normals under known lights."""

    # channels of the extractor's seven layers
    widths: tuple[int, ...] = (64, 128, 128, 256, 256, 128, 128)
    # channels of the regressor's first three
    regressor_widths: tuple[int, ...] = (128, 128, 64)

    def setup(self) -> None:
        strides = (1, 2, 1, 2, 1, None, 1)
        self.extractor = [
            Deconv(width) if stride is None else Conv(width, stride=stride)
            for width, stride in zip(self.widths, strides, strict=True)
        ]
        first, second, third = self.regressor_widths
        self.regressor = [Conv(first), Conv(second), Deconv(third)]
        self.normal = Conv(3, use_bias=False, linear=True)

    def extract(self, x: Array) -> Array:
        """Features of images, `[..., H, W, 6]` -> `[..., H/2, W/2, C]`."""
        for layer in self.extractor:
            x = layer(x)
        return x

    def regress(self, fused: Array) -> Array:
        """Normals from fused features, `[B, H/2, W/2, C]` -> `[B, H, W, 3]`, unit."""
        x = fused
        for layer in self.regressor:
            x = layer(x)
        x = self.normal(x)
        return x / jnp.maximum(jnp.linalg.norm(x, axis=-1, keepdims=True), 1e-12)

    def __call__(self, x: Array) -> Array:
        """`[B, N, H, W, 6]` (image over intensity, direction) -> `[B, H, W, 3]`."""
        return self.regress(jnp.max(self.extract(x), axis=1))


class GCNet(nn.Module):
    """Both lighting networks and the coarse normal network between them."""

    lights: LightNet = LightNet()
    normals: NormalNet = NormalNet(widths=(16, 32, 64, 128, 128, 128, 128))

    def setup(self) -> None:
        self.light_1 = self.lights.clone(name="light_1", parent=self)
        self.coarse = self.normals.clone(name="coarse", parent=self)
        self.light_2 = self.lights.clone(name="light_2", parent=self)

    def __call__(self, images: Array, mask: Array) -> Stages:
        """The lights of masked images `[B, N, 128, 128, 3]`, the mask in [0, 1]."""
        mask = mask[..., None]  # [B, h, w, 1]
        masks = jnp.broadcast_to(mask[:, None], (*images.shape[:-1], 1))
        first = self.light_1(jnp.concatenate([images, masks], axis=-1))
        directions, intensities = soft_lights(first)
        normals = self.coarse(with_lights(images, directions, intensities)) * mask
        shading = jnp.einsum(
            "bhwc,bnc->bnhw", normals, directions, precision=lax.Precision.HIGHEST
        ).clip(0, 1)
        all_normals = jnp.broadcast_to(normals[:, None], images.shape)
        second = self.light_2(
            jnp.concatenate([images, masks, all_normals, shading[..., None]], axis=-1)
        )
        return Stages(first, normals, shading, second)


def with_lights(images: Array, directions: Array, intensities: Array) -> Array:
    """A normal network's input `[..., H, W, 6]`: image over intensity, direction."""
    scaled = images / (intensities[..., None, None, :] + 1e-8)
    spread = jnp.broadcast_to(directions[..., None, None, :], images.shape)
    return jnp.concatenate([scaled, spread], axis=-1)


def normals_by_chunks(
    net: NormalNet,
    params: Params,
    images: Array,
    directions: Array,
    intensities: Array,
    *,
    chunk: int = 8,
) -> Array:
    """Unit normals `[H, W, 3]` of one object, a few images in memory at a time."""
    count = images.shape[0]
    chunk = min(chunk, count)
    order = jnp.minimum(jnp.arange(-(-count // chunk) * chunk), count - 1)

    def features(index: Array) -> Array:
        x = with_lights(images[index], directions[index], intensities[index])
        each: Any = net.apply({"params": params}, x, method="extract")
        return jnp.max(each, axis=0)

    chunks = order.reshape(-1, chunk)  # repeats of the last image change no maximum
    fused, _ = lax.scan(
        lambda best, index: (jnp.maximum(best, features(index)), None),
        features(chunks[0]),
        chunks[1:],
    )
    normals: Any = net.apply({"params": params}, fused[None], method="regress")
    return normals[0]


def light_net_of(params: Params) -> LightNet:
    """The lighting network whose widths these parameters have."""
    return LightNet(
        widths=tuple(_width(params[f"extractor_{i}"]) for i in range(7)),
        classifier=_width(params["classifier_0"]),
        hidden=_width(params["azimuth_hidden"]),
    )


def normal_net_of(params: Params) -> NormalNet:
    """The normal network whose widths these parameters have."""
    return NormalNet(
        widths=tuple(_width(params[f"extractor_{i}"]) for i in range(7)),
        regressor_widths=tuple(_width(params[f"regressor_{i}"]) for i in range(3)),
    )


def gcnet_of(params: Params) -> GCNet:
    """The GCNet whose widths these parameters have."""
    return GCNet(light_net_of(params["light_1"]), normal_net_of(params["coarse"]))


def _width(layer: Params) -> int:
    return layer["conv"]["kernel"].shape[-1]
