"""Speed and memory, as shares of this run's own matrix products.

    python tools/benchmark.py [--config FILE] [--images 10] [--size 512]
    python tools/benchmark.py --torch [--images 10] [--size 512]
    python tools/benchmark.py --train --config configs/unips.py --objects 1 --images 6

Prints one JSON line: versions, device, medians. Appended to `docs/results/speed.jsonl`
it is shown by `tools/results.py`. Absolute seconds say little on shared machines; so
the rate of every part is given as a share of the rate of float32 matrix products of the
network's own sizes, timed in the same run, between the parts.
Operations are those of the plain network, as its sizes give them: what the
implementation saves by rearranging counts in its favour, what it adds against it.
"""

import argparse
import contextlib
import dataclasses
import datetime
import functools
import json
import resource
import shlex
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import unips_jax
from unips_jax.console import cache_compilations, command
from unips_jax.errors import InputError
from unips_jax.estimation.pure import estimate_normals
from unips_jax.models.config import ModelConfig, SelfCalibratingConfig, UniPSConfig
from unips_jax.models.network import UniversalNetwork
from unips_jax.train import load_config
from unips_jax.training.compilation import compile_together
from unips_jax.training.config import Config, DataConfig
from unips_jax.training.state import new_state
from unips_jax.training.step import Batch, train_step
from unips_jax.weights import random_weights

# Rows of the plain products: enough for their full rate.
_ROWS = 4096


def decoder_operations(config: ModelConfig) -> float:
    """Multiplications and additions of the plain decoder, per pixel and image.

    Those of its linear layers; what is done once per pixel, or grows with the square
    of the images, is left out.
    """
    total, width = 0.0, 3 + config.context_dim
    paper = config if isinstance(config, UniPSConfig) else ModelConfig.paper()
    if isinstance(
        config, SelfCalibratingConfig
    ):  # from three times RGB to scale and shift
        total += config.observation_dim * (9 + 2 * config.context_dim)
    for _ in range(config.aggregation_layers):
        total += 3 * width * config.hidden_dim
        total += 2 * config.hidden_dim * config.aggregation_mlp_dim
        if paper.attention == "pre_norm":
            total += config.hidden_dim**2
            if width != config.hidden_dim:  # the residual's projection
                total += width * config.hidden_dim
        width = config.hidden_dim
    if paper.aggregation == "pma":  # keys and values
        total += 2 * width * config.hidden_dim
    return 2 * total


def encoder_operations(config: ModelConfig, images: int) -> float:
    """Multiplications and additions of the plain encoder, of a set of images.

    As the compiler counts them; padded windows count as what they are.
    """
    from unips_jax.models.network import EncoderDecoder

    size = config.canonical_size
    shape = (images, size, size, config.input_channels)
    inputs = jax.ShapeDtypeStruct(shape, jnp.float32)
    network = jax.eval_shape(functools.partial(random_weights, config))

    def run(params: Any, inputs: jax.Array) -> Any:
        return EncoderDecoder(config).apply({"params": params}, inputs, method="encode")

    cost = jax.jit(run).lower(network.params, inputs).cost_analysis()
    return float(cost["flops"]) if cost else float("nan")


def median_seconds(run: Callable[[], Any], repeats: int) -> float:
    """Median wall time of a call, its result waited for."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def matrix_rate(config: ModelConfig) -> float:
    """Operations per second of plain products of the decoder's sizes."""
    d, m = config.hidden_dim, config.aggregation_mlp_dim
    x, query, key, value, up, down = (
        jnp.ones(shape, jnp.float32)
        for shape in ((_ROWS, d), (d, d), (d, d), (d, d), (d, m), (m, d))
    )

    @jax.jit
    def products(x: jax.Array, query, key, value, up, down) -> jax.Array:
        for _ in range(4):  # one layer: query, key, value and the MLP's two
            x = (((x @ query) @ key) @ value) @ up @ down * 1e-9
        return x

    operations = 4 * 2 * _ROWS * (3 * d * d + 2 * d * m)
    jax.block_until_ready(products(x, query, key, value, up, down))
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < 2:
        jax.block_until_ready(products(x, query, key, value, up, down))
        count += 1
    return count * operations / (time.perf_counter() - start)


def disc(images: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Random images, and a disc mask of 55 % of the pixels."""
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    mask = x**2 + y**2 < 0.7
    generator = np.random.default_rng(0)
    return generator.random((images, size, size, 3), np.float32), mask


def shares(seconds: float, operations: float, rates: Sequence[float]) -> dict:
    """A part's rate and its share of the products timed before and after it."""
    rate = operations / seconds
    return {
        "seconds": round(seconds, 3),
        "gflop_per_s": round(rate / 1e9, 1),
        "share_of_products": round(rate / statistics.mean(rates), 3),
    }


def peak_memory_gb() -> float:
    """The most memory this process has held so far, or since `forget_peak_memory`."""
    status = Path("/proc/self/status")
    if status.exists():
        return round(int(status.read_text().split("VmHWM:")[1].split()[0]) / 1e6, 2)
    unit = 1e9 if sys.platform == "darwin" else 1e6  # bytes there, else kilobytes
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, 2)


def forget_peak_memory() -> None:
    """Starts `peak_memory_gb` anew, on Linux."""
    clear = Path("/proc/self/clear_refs")
    if clear.exists():
        clear.write_text("5")


def torch_estimate(
    network: UniversalNetwork, stack: np.ndarray, mask: np.ndarray
) -> Callable[[], np.ndarray]:
    """The same normals by PyTorch (`torch_network`): `[P, 3]` of the mask's pixels."""
    try:
        import torch
        import torch_network
    except ImportError:
        raise InputError("--torch: torch is not installed: pip install torch") from None
    weights = torch_network.torch_weights(network)
    means = stack[:, mask].mean((1, 2), keepdims=True)[..., None]
    images = torch.from_numpy(stack / means * mask[..., None])
    inside, size = torch.from_numpy(mask), network.config.canonical_size
    return lambda: torch_network.estimate(weights, images, inside, size).numpy()


def estimation_benchmark(
    config: ModelConfig, images: int, size: int, repeats: int, with_torch: bool = False
) -> dict:
    """Encoder alone, end to end, and what the first call adds to compile or to load.

    `with_torch`: also by PyTorch, in turn.
    """
    network = jax.block_until_ready(random_weights(config))
    forget_peak_memory()
    observed = disc(images, size)
    other = torch_estimate(network, *observed) if with_torch else None
    stack, mask = map(jnp.asarray, observed)
    views = 1 + config.mirror
    decoder = views * decoder_operations(config) * images * int(mask.sum())
    encoder = views * encoder_operations(config, images)
    of_network = functools.partial(estimate_normals, network, stack, frame="image")
    run = functools.partial(of_network, mask)
    nothing = jnp.zeros_like(mask)  # no pixel to decode: the same program's encoder
    empty = functools.partial(of_network, nothing)
    first = median_seconds(empty, 1)
    before = matrix_rate(config)
    encoder_seconds = median_seconds(empty, repeats)
    rates, times, other_times = [matrix_rate(config)], [], []
    for _ in range(repeats):
        times.append(median_seconds(run, 1))
        if other:
            other_times.append(median_seconds(other, 1))
        rates.append(matrix_rate(config))
    beside = {}
    if other:
        apart = float(np.abs(other() - np.asarray(run())[observed[1]]).max())
        beside = {
            "torch": shares(statistics.median(other_times), encoder + decoder, rates),
            "torch_difference": apart,  # of the normals' components, at most
        }
    return {
        "first_call_overhead_seconds": round(first - encoder_seconds, 1),
        "encoder_gflop": round(encoder / 1e9, 1),
        "decoder_gflop": round(decoder / 1e9, 1),
        "end_to_end": shares(statistics.median(times), encoder + decoder, rates),
        "encoder": shares(encoder_seconds, encoder, [before, rates[0]]),
        **beside,
        "products_gflop_per_s": [round(rate / 1e9, 1) for rate in rates],
        "peak_memory_gb": peak_memory_gb(),
    }


def training_batch(render: Callable[[], Batch]) -> Batch:
    """Objects for one step, with all that scenes give; the truth does not matter."""
    made = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(render))
    stack, mask = disc(*made["images"].shape[1:3])
    up = made["normals"].at[..., 2].set(1)
    of_all = {"images": made["images"] + stack, "mask": made["mask"] | mask}
    return made | of_all | {"normals": up}


def training_benchmark(config: Config, images: int, repeats: int) -> dict:
    """One step on one object, and the scenes it would need."""
    from unips_jax.scenes import load_meshes
    from unips_jax.training.batches import scene_batch

    data, model = config.data, config.model
    key = jax.random.key(1)
    meshes, keys = load_meshes(config.scenes), jax.random.split(key, data.batch_size)
    make = jax.jit(functools.partial(scene_batch, config=config, num_images=images))
    render = functools.partial(make, keys, meshes)
    batch = training_batch(render)
    state = new_state(config, jax.random.key(0))
    step = compile_together(
        jax.jit(functools.partial(train_step, config=config), donate_argnums=0),
        compiling=lambda _: contextlib.nullcontext(),
    )
    state, _ = jax.block_until_ready(step(state, batch, key))
    first_peak = peak_memory_gb()
    forget_peak_memory()
    pixels = data.pixels_for(images)
    if data.grid_loss:
        pixels += (model.canonical_size // 4) ** 2
    forward = encoder_operations(model, images)
    forward += decoder_operations(model) * images * pixels
    rates, times = [matrix_rate(model)], []
    for _ in range(repeats):
        start = time.perf_counter()
        state, _ = jax.block_until_ready(step(state, batch, key))
        times.append(time.perf_counter() - start)
        rates.append(matrix_rate(model))
    seconds, step_peak = statistics.median(times), peak_memory_gb()
    jax.block_until_ready(render())
    scenes = median_seconds(render, repeats)
    return {
        "objects": data.batch_size,
        "images": images,
        "step": shares(seconds, 3 * data.batch_size * forward, rates),
        "first_step_peak_memory_gb": first_peak,  # compilation too
        "step_peak_memory_gb": step_peak,
        "scenes_per_second": round(data.batch_size / scenes, 1),
        "scenes_share_of_step": round(scenes / seconds, 3),
        "products_gflop_per_s": [round(rate / 1e9, 1) for rate in rates],
    }


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--config", default="official", help="official, or a file")
    parser.add_argument("--images", type=int, default=10)
    parser.add_argument("--size", type=int, help="of the images (512)")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--torch", action="store_true", help="the paper's network by PyTorch too"
    )
    parser.add_argument("--train", action="store_true", help="a training step instead")
    parser.add_argument("--objects", type=int, help="in it; else what --config says")
    arguments = parser.parse_args(argv)
    if arguments.repeats < 1:
        raise InputError(f"--repeats {arguments.repeats}: expected 1 or more")
    if arguments.objects is not None and not arguments.train:
        raise InputError(
            f"--objects {arguments.objects}: expected --train too, estimates are of "
            "one object; add it, or leave --objects out"
        )
    if arguments.torch and (arguments.train or arguments.config != "official"):
        raise InputError(
            "--torch: expected an estimate by the paper's network, leave --train and "
            "--config out"
        )
    size = 512 if arguments.size is None else arguments.size
    official = arguments.config == "official"
    if arguments.size is not None and arguments.train and not official:
        raise InputError(
            f"--size {size}: with --train, images have the size that --config "
            f"{arguments.config} says; leave --size out"
        )
    cache_compilations()
    if official:
        data = DataConfig(image_size=size, batch_size=1)
        config = Config(model=ModelConfig.released(), data=data)
    else:
        config = load_config(arguments.config)
    if arguments.objects is not None:
        data = dataclasses.replace(config.data, batch_size=arguments.objects)
        config = dataclasses.replace(config, data=data)
    if arguments.train:
        result = training_benchmark(config, arguments.images, arguments.repeats)
    else:
        result = estimation_benchmark(
            config.model, arguments.images, size, arguments.repeats, arguments.torch
        )
    given = sys.argv[1:] if argv is None else argv
    print(
        json.dumps(
            {
                "date": datetime.date.today().isoformat(),
                "arguments": shlex.join(given),
                "unips_jax": unips_jax.__version__,
                "jax": jax.__version__,
                "device": jax.devices()[0].device_kind,
                "config": arguments.config,
                **result,
            }
        )
    )


if __name__ == "__main__":
    raise SystemExit(main())
