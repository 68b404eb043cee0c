"""Trains our own small GCNet on scenes under directional light.

    python tools/train_gcnet.py -o gcnet_small.safetensors

The authors' weights may not be passed on; these are the architecture of Chen et al.
(ECCV 2020), at half the width, with weights of our own. Their four stages are shortened
to two: first the first lighting network, and the normal network under true lights; then
everything end to end. The scenes are single directional lights of the training
distribution, 64 x 64 and not 128 x 128, so the method is to be used with `side=64`.
Prints errors of held-out lights at the end. Stopped and started again, it goes on from
the last multiple of 50 steps, kept next to the output as `*.part`, if the options are
the same.
"""

import argparse
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.serialization import from_state_dict, msgpack_restore, to_bytes
from jax import Array

from unips_jax.baselines.gcnet.lights import Logits, encode, light_errors, soft_lights
from unips_jax.baselines.gcnet.networks import GCNet, LightNet, NormalNet, with_lights
from unips_jax.baselines.gcnet.parameters import save_params
from unips_jax.baselines.method import Lights
from unips_jax.console import cache_compilations, command
from unips_jax.errors import InputError
from unips_jax.io.door import write_whole
from unips_jax.scenes import LIGHT_KINDS, SceneConfig, render_batch

NET = GCNet(
    LightNet(widths=(16, 32, 32, 64, 64, 64, 128), classifier=64, hidden=64),
    NormalNet(widths=(8, 16, 32, 64, 64, 64, 64), regressor_widths=(64, 64, 32)),
)
SIZE = 64
SCENES = SceneConfig(linear_rate=1.0, eight_bit_rate=0.0, mask_error_rate=0.0)


def draw(key: Array, *, objects: int, images: int) -> dict[str, Array]:
    """Objects under directional lights, scaled as the method scales images by default.

    Every image's maximum is put at 0.1. The intensities follow; as only their ratios
    can be seen, their geometric mean is put at 0.6, the middle of the classes' range.
    """
    scene = render_batch(
        jax.random.split(key, objects),
        size=SIZE,
        num_images=images,
        config=SCENES,
        light_kind=np.int32(LIGHT_KINDS.index("directional")),
    )
    peaks = jnp.maximum(scene.images.max(axis=(2, 3, 4)), 1e-6)
    strength = scene.light_intensities.mean(axis=-1) / peaks
    mean = jnp.exp(jnp.mean(jnp.log(strength), axis=1, keepdims=True))
    return {
        "images": 0.1 * scene.images / peaks[..., None, None, None],
        "mask": scene.mask.astype(jnp.float32),
        "normals": scene.normals,
        "directions": scene.light_directions,
        "intensities": jnp.clip(0.6 * strength / mean, 0.2, 2.0),
    }


def light_loss(logits: Logits, batch: dict[str, Array]) -> Array:
    """Cross entropies of azimuth, elevation and intensity."""
    targets = encode(batch["directions"], batch["intensities"])
    return sum(
        optax.softmax_cross_entropy_with_integer_labels(predicted, target).mean()
        for predicted, target in zip(logits[:3], targets, strict=True)
    )


def normal_loss(normals: Array, batch: dict[str, Array]) -> Array:
    """Mean of 1 - cosine over the objects."""
    wrong = (1 - jnp.sum(normals * batch["normals"], axis=-1)) * batch["mask"]
    return wrong.sum() / batch["mask"].sum()


def first_stage(params: Any, batch: dict[str, Array]) -> Array:
    """The first lighting network, and the normal network under true lights."""

    def both(net: GCNet, images: Array, mask: Array) -> tuple[Logits, Array]:
        masks = jnp.broadcast_to(mask[:, None, ..., None], (*images.shape[:-1], 1))
        lights = net.light_1(jnp.concatenate([images, masks], axis=-1))
        true = batch["intensities"][..., None]
        return lights, net.coarse(with_lights(images, batch["directions"], true))

    found: Any = NET.apply(
        {"params": params}, batch["images"], batch["mask"], method=both
    )
    lights, normals = found
    return light_loss(lights, batch) + normal_loss(normals, batch)


def last_stage(params: Any, batch: dict[str, Array]) -> Array:
    """Everything end to end: both lightings, normals and shading."""
    stages: Any = NET.apply({"params": params}, batch["images"], batch["mask"])
    shading = jnp.einsum("bhwc,bnc->bnhw", batch["normals"], batch["directions"])
    wrong = (stages.shading - shading.clip(0, 1)) ** 2 * batch["mask"][:, None]
    return (
        light_loss(stages.first, batch)
        + light_loss(stages.second, batch)
        + normal_loss(stages.normals, batch)
        + wrong.sum() / (batch["mask"].sum() * wrong.shape[1])
    )


def train(steps: int, objects: int, seed: int, kept: Path) -> dict[str, Any]:
    """Trains for `steps` steps of `objects` objects with 8 images each.

    The state is kept in a file, and taken from it if it is there.
    """
    settings = {"steps": steps, "objects": objects, "seed": seed}
    earlier = read_state(kept, settings)
    key = jax.random.key(seed)
    empty = jnp.zeros((1, 2, SIZE, SIZE, 3)), jnp.zeros((1, SIZE, SIZE))
    params = jax.jit(NET.init)(key, *empty)["params"]
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.adam(optax.cosine_onecycle_schedule(steps, 1e-3, 0.1)),
    )
    state = optimiser.init(params)

    @functools.partial(jax.jit, static_argnames=("loss_of",))
    def step(params: Any, state: Any, batch: Any, *, loss_of: Any) -> Any:
        loss, grads = jax.value_and_grad(loss_of)(params, batch)
        updates, state = optimiser.update(grads, state, params)
        return optax.apply_updates(params, updates), state, loss

    losses: list[Array] = []
    done = 0
    if earlier is not None:
        params, state, done = from_state_dict((params, state, done), earlier)
    for index in range(done, steps):
        batch = draw(jax.random.fold_in(key, index), objects=objects, images=8)
        stage = first_stage if index < steps // 2 else last_stage
        params, state, loss = step(params, state, batch, loss_of=stage)
        losses.append(loss)
        if index % 50 == 49:
            mean = float(jnp.mean(jnp.stack(losses[-50:])))
            print(f"step {index + 1}/{steps}: loss {mean:.3f}", flush=True)
            write_state(kept, settings, (params, state, index + 1))
    return params


def write_state(kept: Path, settings: dict[str, int], state: Any) -> None:
    """Writes the state of training, with what it follows from."""
    write_whole(kept, to_bytes({"settings": settings, "state": state}))


def read_state(kept: Path, settings: dict[str, int]) -> Any:
    """What was written, for `from_state_dict`; None if there is nothing."""
    if not kept.exists():
        return None
    found = msgpack_restore(kept.read_bytes())
    if found.get("settings") != settings:
        raise InputError(
            f"{kept}: expected training with {settings}, got one with "
            f"{found.get('settings', 'unknown settings')}; give the same options, "
            "another -o, or remove the file"
        )
    return found["state"]


def held_out(params: Any, objects: int = 64) -> dict[str, float]:
    """Mean errors of the lights of objects that training never saw."""
    errors = []
    for index in range(objects // 8):
        key = jax.random.fold_in(jax.random.key(2**31), index)
        batch = draw(key, objects=8, images=8)
        stages = jax.jit(NET.apply)({"params": params}, batch["images"], batch["mask"])
        directions, intensities = map(np.asarray, soft_lights(stages.second))
        truth = np.asarray(batch["directions"]), np.asarray(batch["intensities"])
        for i in range(8):
            found = Lights(directions[i], intensities[i])
            true = Lights(truth[0][i], truth[1][i][:, None])
            errors.append(light_errors(found, true))
    return {name: float(np.mean([e[name] for e in errors])) for name in errors[0]}


@command
def main(argv: Sequence[str] | None = None) -> None:
    """Parses the command line, trains, and writes the weights."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--steps", type=int, default=1000, help="(1000)")
    parser.add_argument("--objects", type=int, default=8, help="per step (8)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    cache_compilations()
    kept = arguments.output.with_suffix(".part")
    params = train(arguments.steps, arguments.objects, arguments.seed, kept)
    half = jax.tree.map(lambda x: np.asarray(x, np.float16), params)
    print(held_out(jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), half)))
    save_params(arguments.output, half, "gcnet")
    kept.unlink(missing_ok=True)


if __name__ == "__main__":
    raise SystemExit(main())
