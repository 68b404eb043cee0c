"""One training step: augment, losses and gradients, update, average."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from unips_jax.models.network import UniversalNetwork
from unips_jax.training.config import Config
from unips_jax.training.known_lights import draw_known_lights
from unips_jax.training.loss import LossOptions, Objects, training_loss
from unips_jax.training.optimizer import make_optimizer
from unips_jax.training.state import TrainState

Batch = dict[str, Any]  # arrays; see `Objects`


def augment(scene: Objects, key: Array) -> Objects:
    """The paper's four augmentations of one object, each with probability one half.

    Flipped left-right (n_x negated), up-down (n_y negated), transposed (n becomes
    (-n_y, -n_x, n_z)), the lights with the normals; and the colours of each image
    permuted. Images are square and without a leading axis of objects; incident light is
    left out: it is not turned. Source: UniPS (Ikehata, CVPR 2022), supplement.
    """
    flip_key, colour_key, order_key = jax.random.split(key, 3)
    half = jnp.float32(0.5)  # its type is that of the draws
    horizontal, vertical, transpose = jax.random.bernoulli(flip_key, half, (3,))

    def apply(scene: Objects, when: Array, change: Any, turn: Any) -> Objects:
        images, mask, normals, lights, *_ = scene
        turned = Objects(
            jax.vmap(change)(images),
            change(mask),
            turn(change(normals)),
            None if lights is None else turn(lights),
        )
        return jax.tree.map(functools.partial(jnp.where, when), turned, scene)

    scene = scene._replace(incident=None)
    dtype = scene.normals.dtype
    signs = jnp.array([-1, 1, 1], dtype)
    scene = apply(scene, horizontal, lambda x: x[:, ::-1], lambda n: n * signs)
    signs = jnp.array([1, -1, 1], dtype)
    scene = apply(scene, vertical, lambda x: x[::-1], lambda n: n * signs)
    signs = jnp.array([-1, -1, 1], dtype)
    scene = apply(
        scene,
        transpose,
        lambda x: jnp.swapaxes(x, 0, 1),
        lambda n: n[..., jnp.array([1, 0, 2])] * signs,
    )
    images = scene.images
    n = images.shape[0]
    orders = jax.vmap(lambda k: jax.random.permutation(k, 3))(
        jax.random.split(order_key, n)
    )
    permuted = jax.random.bernoulli(colour_key, half, (n,))
    orders = jnp.where(permuted[:, None], orders, jnp.arange(3))
    # As a product: gathers along the last axis are slow.
    mixing = jax.nn.one_hot(orders, 3, dtype=images.dtype)  # [N, new, old]
    return scene._replace(images=jnp.einsum("nhwc,ndc->nhwd", images, mixing))


def batch_loss(
    params: Any, batch: Batch, *keys: Array, config: Config
) -> tuple[Array, dict[str, Array]]:
    """Mean loss over a batch of B objects, and their mean metrics; keys `[2, B]`."""
    data = config.data
    objects = Objects(**batch)
    num_images = objects.images.shape[1]
    if data.augment:
        objects = jax.vmap(augment)(objects, keys[0])
    if data.known_lights_rate and objects.incident is not None:
        draw = functools.partial(draw_known_lights, share=data.known_lights_rate)
        drawn = jax.vmap(draw)(objects.incident, keys[0])
        objects = objects._replace(known_lights=drawn)
    # The loss' options have the names of the fields that they come from.
    given = vars(data) | vars(config.train)
    given["num_pixels"] = data.pixels_for(num_images)
    fields = dataclasses.fields(LossOptions)
    options = LossOptions(**{field.name: given[field.name] for field in fields})
    network = UniversalNetwork(config.model, params)
    return training_loss(network, objects, keys[1], options)


def batch_gradient(params: Any, batch: Batch, key: Array, *, config: Config) -> Any:
    """Value and gradient of `batch_loss`.

    With microbatches, the means over parts of the batch, of which one at a time is in
    memory. What is drawn for an object is the same, but for dropout.
    """
    loss = functools.partial(batch_loss, config=config)
    gradient = jax.value_and_grad(loss, has_aux=True)
    objects = batch, *jax.random.split(key, (2, len(batch["mask"])))
    count = config.mesh.microbatches
    if count == 1:
        return gradient(params, *objects)

    def part(x: Array) -> Array:
        """`[B, ...]` to `[count, B / count, ...]`: each device keeps its objects."""
        return jnp.moveaxis(x.reshape(-1, count, *x.shape[1:]), 1, 0)

    def add(total: Any, objects: Any) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, gradient(params, *objects)), None

    parts = jax.tree.map(part, objects)
    shapes = jax.eval_shape(gradient, params, *jax.tree.map(lambda x: x[0], parts))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    total, _ = jax.lax.scan(add, zeros, parts)
    return jax.tree.map(lambda x: x / count, total)


def train_step(
    state: TrainState, batch: Batch, key: Array, *, config: Config
) -> tuple[TrainState, dict[str, Array]]:
    """Advances training by one step; pure.

    `key` is the run's; the step's own follows from it and `state.step`. Returns the
    state after it, and metrics: loss, mae_deg, grad_norm, and untrained, the share of
    the parameters whose output has no gradient.
    """
    key = jax.random.fold_in(key, state.step)
    (loss, metrics), grads = batch_gradient(state.params, batch, key, config=config)
    optimizer = make_optimizer(config)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema_params = state.ema_params
    if ema_params is not None:
        # Short memory at first, so that the average forgets the initial parameters.
        step = state.step.astype(jnp.float32)
        decay = jnp.minimum(config.optim.ema_decay, (1 + step) / (10 + step))
        ema_params = optax.incremental_update(params, ema_params, 1 - decay)
    metrics = {
        "loss": loss,
        "grad_norm": optax.tree.norm(grads),
        "untrained": _untrained(grads),
        **metrics,
    }
    return TrainState(state.step + 1, params, opt_state, ema_params), metrics


def _untrained(grads: Any) -> Array:
    """The share of the parameters that lead to an output without any gradient."""

    def count(gradient: Array) -> Array:
        off = jnp.all(gradient == 0, axis=range(gradient.ndim - 1))
        return jnp.mean(off) * gradient.size

    total = sum(g.size for g in jax.tree.leaves(grads))
    return jax.tree.reduce(jnp.add, jax.tree.map(count, grads)) / total
