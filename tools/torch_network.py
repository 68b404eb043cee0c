"""The paper's network once more, in PyTorch: what our arithmetic and speed are held to.

Written plainly from the paper and its supplement (Sec. 3 and 4), not from the authors'
code: float32, no compilation. `tools/benchmark.py --torch` times it.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from flax.traverse_util import flatten_dict
from torch import Tensor

from unips_jax.models.network import UniversalNetwork

Weights = Mapping[str, Tensor]
HEADS, WINDOW, DEPTHS = 8, 7, (2, 2, 18, 2)


def torch_weights(network: UniversalNetwork) -> Weights:
    """Its parameters by their paths, kernels as PyTorch has them: outputs first."""
    flat = flatten_dict(network.params, sep=".")
    return {
        name: torch.from_numpy(
            np.moveaxis(np.array(value), (-1, -2), (0, 1))
            if name.endswith("kernel")
            else np.array(value)
        ).contiguous()
        for name, value in flat.items()
    }


class Part:
    """The parameters whose paths begin with a prefix."""

    def __init__(self, weights: Weights, prefix: str) -> None:
        """Of the parameters of `torch_weights`, such as "encoder.fusion"."""
        self.weights, self.prefix = weights, prefix

    def __getitem__(self, name: str) -> "Part":
        """Those of them whose paths go on so."""
        return Part(self.weights, f"{self.prefix}.{name}")

    def get(self, name: str) -> Tensor | None:
        """One parameter, if there is one."""
        return self.weights.get(f"{self.prefix}.{name}")

    def linear(self, x: Tensor) -> Tensor:
        """A linear layer."""
        return F.linear(x, self.weights[f"{self.prefix}.kernel"], self.get("bias"))

    def norm(self, x: Tensor) -> Tensor:
        """Layer normalisation, where this part has one."""
        scale = self.get("scale")
        if scale is None:
            return x
        return F.layer_norm(x, scale.shape, scale, self.get("bias"))

    def convolve(self, x: Tensor, stride: int = 1) -> Tensor:
        """A convolution."""
        kernel = self.weights[f"{self.prefix}.kernel"]
        padding = kernel.shape[-1] // 2
        return F.conv2d(x, kernel, self.get("bias"), stride, padding)


def split(x: Tensor, heads: int) -> Tensor:
    """`[..., N, C]` to `[..., heads, N, C / heads]`."""
    return x.unflatten(-1, (heads, -1)).transpose(-2, -3)


def set_attention(part: Part, x: Tensor, y: Tensor) -> Tensor:
    """Queries `[B, M, C]` look at `[B, N, C]`; `[B, M, width]`."""
    q = part["query"].linear(part["norm"].norm(x))
    k, v = part["key"].linear(y), part["value"].linear(y)
    scores = split(q, HEADS) @ split(k, HEADS).transpose(-1, -2)
    read = torch.softmax(scores / q.shape[-1] ** 0.5, -1) @ split(v, HEADS)
    out = q + read.transpose(-2, -3).flatten(-2)
    mlp = part["mlp"]
    return out + mlp["fc2"].linear(F.gelu(mlp["fc1"].linear(mlp["norm"].norm(out))))


def windows(x: Tensor) -> Tensor:
    """`[N, H, W, C]` to `[N x windows, 49, C]`."""
    n, h, w, c = x.shape
    x = x.view(n, h // WINDOW, WINDOW, w // WINDOW, WINDOW, c)
    return x.transpose(2, 3).reshape(-1, WINDOW**2, c)


def unwindows(x: Tensor, n: int, h: int, w: int) -> Tensor:
    """Back from `windows`."""
    x = x.view(n, h // WINDOW, w // WINDOW, WINDOW, WINDOW, -1)
    return x.transpose(2, 3).reshape(n, h, w, -1)


def shift_mask(h: int, w: int) -> Tensor:
    """-100 between tokens that only a shift brings together: `[windows, 49, 49]`."""
    region = torch.zeros(1, h, w, 1)
    edges = (slice(0, -WINDOW), slice(-WINDOW, -(WINDOW // 2)), slice(-3, None))
    for i, rows in enumerate(edges):
        for j, columns in enumerate(edges):
            region[:, rows, columns] = 3 * i + j
    region = windows(region)[..., 0]
    return (region[:, None] != region[:, :, None]) * -100.0


def relative_places() -> Tensor:
    """Rows of the table of relative position biases: `[49, 49]`."""
    y, x = np.divmod(np.arange(WINDOW**2), WINDOW)
    dy, dx = y[:, None] - y, x[:, None] - x
    return torch.as_tensor((dy + WINDOW - 1) * (2 * WINDOW - 1) + dx + WINDOW - 1)


def swin_block(part: Part, x: Tensor, heads: int, shift: int) -> Tensor:
    """One block on `[N, H, W, C]`."""
    n, height, width, c = x.shape
    padded = F.pad(
        part["norm1"].norm(x), (0, 0, 0, -width % WINDOW, 0, -height % WINDOW)
    )
    h, w = padded.shape[1:3]
    shifted = torch.roll(padded, (-shift, -shift), (1, 2))
    qkv = part["attn"]["qkv"].linear(windows(shifted))
    q, k, v = (split(z, heads) for z in qkv.chunk(3, -1))
    table = part["attn"].get("relative_position_bias_table")
    assert table is not None
    scores = (q * (c // heads) ** -0.5) @ k.transpose(-1, -2)
    scores = scores + table[relative_places()].permute(2, 0, 1)
    if shift:
        mask = shift_mask(h, w)[:, None]
        scores = (scores.view(n, -1, *scores.shape[1:]) + mask).view_as(scores)
    read = (torch.softmax(scores, -1) @ v).transpose(1, 2).flatten(-2)
    read = unwindows(part["attn"]["proj"].linear(read), n, h, w)
    x = x + torch.roll(read, (shift, shift), (1, 2))[:, :height, :width]
    hidden = F.gelu(part["fc1"].linear(part["norm2"].norm(x)))
    return x + part["fc2"].linear(hidden)


def backbone(part: Part, x: Tensor) -> list[Tensor]:
    """`[N, 4, s, s]` to maps `[N, s / 4, s / 4, 96]` ... `[N, s / 32, s / 32, 768]`."""
    for i, stride in enumerate((2, 1, 2, 1, 1)):
        x = part[f"patch_embed.conv{i}"].convolve(x, stride)
        x = F.relu(x) if i < 4 else x
    x, maps = x.permute(0, 2, 3, 1), []
    for i, depth in enumerate(DEPTHS):
        for j in range(depth):
            shift = WINDOW // 2 * (j % 2)
            x = swin_block(part[f"stages_{i}.block{j}"], x, 3 * 2**i, shift)
        maps.append(part[f"norms_{i}"].norm(x))
        if i < 3:
            x = F.pad(x, (0, 0, 0, x.shape[2] % 2, 0, x.shape[1] % 2))
            parts = (x[:, a::2, b::2] for a, b in ((0, 0), (1, 0), (0, 1), (1, 1)))
            down = part[f"stages_{i + 1}.merging"]
            x = down["reduction"].linear(down["norm"].norm(torch.cat([*parts], -1)))
    return maps


def fuse(part: Part, maps: Sequence[Tensor]) -> Tensor:
    """UPerNet without batch normalisation: the contexts `[N, 256, s / 4, s / 4]`."""

    def resize(x: Tensor, like: Tensor) -> Tensor:
        return F.interpolate(x, like.shape[2:], mode="bilinear")

    def layer(part: Part, x: Tensor) -> Tensor:
        return F.relu(part.convolve(x))

    *fine, last = (x.permute(0, 3, 1, 2) for x in maps)
    pools = [
        resize(layer(part[f"ppm{i}"], F.adaptive_avg_pool2d(last, n)), last)
        for i, n in enumerate((1, 2, 3, 6))
    ]
    above = layer(part["ppm_bottleneck"], torch.cat([last, *pools], 1))
    levels = [above]
    for i in (2, 1, 0):
        side = layer(part[f"lateral{i}"], fine[i])
        above = side + resize(above, side)
        levels.insert(0, above)
    levels[:3] = (layer(part[f"fpn{i}"], x) for i, x in enumerate(levels[:3]))
    all_levels = [levels[0], *(resize(x, levels[0]) for x in levels[1:])]
    return layer(part["fpn_bottleneck"], torch.cat(all_levels, 1))


def encode(weights: Weights, images: Tensor, mask: Tensor, size: int) -> Tensor:
    """Contexts `[N, 256, size / 4, size / 4]` of images `[N, H, W, 3]`."""
    encoder = Part(weights, "encoder")
    small = F.interpolate(images.permute(0, 3, 1, 2), (size, size), mode="bilinear")
    inside = F.interpolate(mask.float()[None, None], (size, size), mode="nearest")
    x = torch.cat([small * inside, inside.expand(len(small), -1, -1, -1)], 1)
    maps = backbone(encoder, x)
    for i, each in enumerate(maps):
        sets = each.flatten(0, 2).unflatten(0, (len(each), -1)).transpose(0, 1)
        sets = set_attention(encoder[f"communications_{i}"], sets, sets)
        maps[i] = sets.transpose(0, 1).reshape(each.shape)
    return fuse(encoder["fusion"], maps)


def decode(weights: Weights, sets: Tensor) -> Tensor:
    """Unit normals `[P, 3]` of observations with their contexts `[P, N, 259]`."""
    aggregation = Part(weights, "decoder.aggregation")
    for i in range(4):
        sets = set_attention(aggregation[f"layer{i}"], sets, sets)
    pooling = aggregation["pooling"]
    seeds = pooling.get("seeds")
    assert seeds is not None
    pooled = set_attention(pooling, seeds.expand(len(sets), -1, -1), sets)[:, 0]
    head = Part(weights, "decoder.prediction")
    return F.normalize(head["fc2"].linear(F.relu(head["fc1"].linear(pooled))), dim=-1)


@torch.inference_mode()
def estimate(
    weights: Weights,
    images: Tensor,
    mask: Tensor,
    size: int = 256,
    pixels_at_once: int = 10_000,
) -> Tensor:
    """Normals `[P, 3]` of the mask's pixels, row by row.

    `images`: `[N, H, W, 3]`, each divided by its mean and 0 outside of the mask
    `[H, W]`; `weights`: of `torch_weights`.
    """
    contexts = encode(weights, images, mask, size)
    rows, columns = torch.nonzero(mask, as_tuple=True)
    height, width = mask.shape
    # The published network reads half a pixel off, with 0 beyond the border.
    y, x = 2 * rows / height - 1, 2 * columns / width - 1
    normals = []
    for i in range(0, len(rows), pixels_at_once):
        chunk = slice(i, i + pixels_at_once)
        places = torch.stack([x[chunk], y[chunk]], -1)[None, None]
        places = places.expand(len(images), -1, -1, -1)
        read = F.grid_sample(contexts, places, align_corners=False)[:, :, 0]
        seen = images[:, rows[chunk], columns[chunk]]
        sets = torch.cat([seen, read.transpose(1, 2)], -1).transpose(0, 1)
        normals.append(decode(weights, sets))
    return torch.cat(normals)
