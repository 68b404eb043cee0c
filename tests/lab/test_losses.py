"""The loss in pieces against the loss as a whole."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_networks import SHALLOW_OURS, SMALL, lively_network, lively_weights

from unips_jax.models.network import UniversalNetwork
from unips_jax.training import loss as losses
from unips_jax.training.chunked_sum import chunked_sum

ONE_STAGE = dataclasses.replace(SMALL, depths=(1,), num_heads=(2,), pool_scales=(1,))


@pytest.mark.parametrize("size", [1, 3, 7, 10, None])
def test_sum_of_chunks_is_the_sum(size):
    keys = jax.random.split(jax.random.key(0), 3)
    w, x, c = (
        jax.random.normal(key, shape)
        for key, shape in zip(keys, ((4,), (7, 4), (7,)), strict=True)
    )

    def function(w, x, c):
        y = jnp.tanh(x @ w)
        return jnp.sum(c * y), y

    def chunked(w, x):
        return chunked_sum(function, w, x, c, size)

    value, y = chunked(w, x)
    expected, expected_y = function(w, x, c)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    np.testing.assert_allclose(y, expected_y, rtol=1e-5)
    for gradient, plain in zip(
        jax.grad(lambda *a: 3 * chunked(*a)[0], (0, 1))(w, x),
        jax.grad(lambda *a: 3 * function(*a, c)[0], (0, 1))(w, x),
        strict=True,
    ):
        np.testing.assert_allclose(gradient, plain, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.float16])
def test_images_may_have_any_type(dtype):
    """Sums over them do not: 160 x 160 pixels are beyond half floats."""
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.integers(1, 200, (2, 160, 160, 3)).astype(dtype))
    mask, key = jnp.ones((160, 160), bool), jax.random.key(0)
    prepare = functools.partial(
        losses._prepare,
        config=ONE_STAGE,
        options=losses.LossOptions(num_pixels=50, grid_loss=False),
    )
    normals = jnp.broadcast_to(jnp.float32([0, 0, 1]), (160, 160, 3))
    found = prepare(images, mask, normals, key)
    expected = prepare(images.astype(jnp.float32), mask, normals, key)
    for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_pieces_change_no_gradient(monkeypatch):
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.random((2, 3, 16, 16, 3)), jnp.float32)
    mask = jnp.asarray(rng.random((2, 16, 16)) > 0.3)
    normals = rng.normal(size=(2, 16, 16, 3))
    normals = jnp.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))

    objects = losses.Objects(images, mask, normals.astype(jnp.float32))

    def loss(params, remat, squared_loss=True):
        return losses.training_loss(
            UniversalNetwork(dataclasses.replace(ONE_STAGE, remat=remat), params),
            objects,
            jax.random.split(jax.random.key(1), 2),
            losses.LossOptions(num_pixels=50, squared_loss=squared_loss),
        )

    def gradient(remat):
        run = functools.partial(loss, remat=remat)
        return jax.jit(jax.value_and_grad(run, has_aux=True))(lively_weights(ONE_STAGE))

    monkeypatch.setattr(losses, "CHUNK_TOKENS", 10**9)
    whole = gradient(remat=False)
    monkeypatch.setattr(losses, "CHUNK_TOKENS", 30)  # pixels by fives
    monkeypatch.setattr(losses, "CHUNK_IMAGES", 4)  # six images in two pieces
    pieces = gradient(remat=True)
    scale = max(np.abs(g).max() for g in jax.tree.leaves(whole[1]))
    for a, b in zip(jax.tree.leaves(pieces), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5 * scale)

    # Of each of the two samplings: d^2 / 2 <= d as d <= 2, and Jensen's inequality.
    squares = whole[0][0]
    plain = jax.jit(functools.partial(loss, remat=False, squared_loss=False))
    assert squares / 2 < plain(lively_weights(ONE_STAGE))[0] < (2 * squares) ** 0.5


def test_plain_distance_is_the_distance():
    a, b = np.eye(3)[:2], np.array([[0.6, 0.8, 0.0], [0.0, -1.0, 0.0]])
    plain = losses.plain_distance(losses.squared_distance(a, b))
    np.testing.assert_allclose(plain, np.linalg.norm(a - b, axis=-1), rtol=0.04)

    def at(x):
        return losses.plain_distance(losses.squared_distance(x, jnp.ones(3)))

    assert float(at(jnp.ones(3))) == pytest.approx(0, abs=1e-7)
    np.testing.assert_array_equal(jax.grad(at)(jnp.ones(3)), 0)


@pytest.mark.parametrize("grid_loss", [False, True])
def test_the_frame_is_cropped_from_the_image(grid_loss):
    """Around the mask: the loss of a wide image is that of its square part."""
    rng = np.random.default_rng(0)
    images = rng.random((1, 3, 12, 12, 3)).astype(np.float32)
    mask = rng.random((1, 12, 12)) > 0.2
    mask[:, :, 0] = mask[:, :, -1] = mask[:, 0] = mask[:, -1] = True
    normals = rng.normal(size=(1, 12, 12, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals *= mask[..., None]

    @functools.partial(jax.jit, static_argnames="frame")
    def loss(images, mask, normals, frame):
        return losses.training_loss(
            lively_network(ONE_STAGE),
            losses.Objects(images, mask, normals),
            jax.random.split(jax.random.key(1), 1),
            losses.LossOptions(num_pixels=1000, frame=frame, grid_loss=grid_loss),
        )[0]

    square = images, mask, normals
    wide = [
        np.pad(x, [(0, 0)] * axis + [(3, 1), (5, 9)] + [(0, 0)] * (x.ndim - axis - 2))
        for x, axis in zip(square, (2, 1, 1), strict=True)
    ]
    expected = loss(*square, frame="image")
    np.testing.assert_allclose(loss(*wide, frame="mask"), expected, rtol=1e-5)
    assert abs(loss(*wide, frame="image") - expected) > 1e-3


def test_masks_count_where_they_are_not_zero():
    """As `estimate_normals` takes them: those of files hold 255."""
    network = lively_network(SHALLOW_OURS)
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.random((1, 2, 32, 32, 3), np.float32))
    mask = jnp.zeros((1, 32, 32), bool).at[:, 5:27, 9:24].set(True)
    normals = jnp.where(mask[..., None], jnp.float32([0.6, 0, 0.8]), 0)
    options = losses.LossOptions(num_pixels=20, frame="mask", grid_loss=False)

    @jax.jit
    def loss(mask):
        objects = losses.Objects(images, mask, normals)
        keys = jax.random.split(jax.random.key(1), 1)
        return losses.training_loss(network, objects, keys, options)[0]

    found = [loss(jnp.float32(value) * mask) for value in (1, 255)]
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)


@pytest.mark.parametrize("grid_loss", [True, False])
@pytest.mark.parametrize("outside", [9.0, np.nan])
def test_what_is_outside_the_mask_does_not_matter(outside, grid_loss):
    """As a normal map's black background, which is read as (-1, -1, -1)."""
    network = lively_network(ONE_STAGE)
    rng = np.random.default_rng(0)
    images = jnp.asarray(rng.random((1, 2, 32, 32, 3), np.float32))
    mask = jnp.zeros((1, 32, 32), bool).at[:, 5:27, 9:24].set(True)
    normals = jnp.where(mask[..., None], jnp.float32([0.6, 0, 0.8]), 0)
    options = losses.LossOptions(num_pixels=20, grid_loss=grid_loss)

    @jax.jit
    def loss(normals):
        objects = losses.Objects(images, mask, normals)
        keys = jax.random.split(jax.random.key(1), 1)
        return losses.training_loss(network, objects, keys, options)[0]

    other = jnp.where(mask[..., None], normals, outside)
    assert float(loss(other)) == float(loss(normals))


def test_strict_promotion_is_enough():
    """Of types and of ranks."""
    objects = losses.Objects(
        jax.ShapeDtypeStruct((2, 3, 16, 12, 3), jnp.float32),
        jax.ShapeDtypeStruct((2, 16, 12), jnp.bool),
        jax.ShapeDtypeStruct((2, 16, 12, 3), jnp.float32),
    )
    keys, options = jax.random.split(jax.random.key(0), 2), losses.LossOptions(8)

    def loss(network, objects):
        return losses.training_loss(network, objects, keys, options)[0]

    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        jax.eval_shape(jax.grad(loss), lively_network(SHALLOW_OURS), objects)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"images": (3, 16, 12, 3)},
            r"images: expected \[B, N, H, W, 3\], got \(3, 16",
        ),
        ({"mask": (16, 12)}, r"mask: expected \(2, 16, 12\), got \(16, 12\)"),
        ({"normals": (2, 16, 12, 2)}, r"normals: expected \(2, 16, 12, 3\), got"),
        ({"keys": (1,)}, r"keys: expected \(2,\), got \(1,\); jax.random.split"),
    ],
)
def test_shapes_that_do_not_fit_are_named(changed, message):
    shapes = {"images": (2, 3, 16, 12, 3), "mask": (2, 16, 12), "keys": (2,)}
    shapes |= {"normals": (2, 16, 12, 3), **changed}
    keys = jnp.zeros(shapes.pop("keys"), jnp.uint32)
    objects = losses.Objects(**{k: np.ones(shape) for k, shape in shapes.items()})
    with pytest.raises(ValueError, match=message):
        options = losses.LossOptions(8)
        losses.training_loss(lively_network(SHALLOW_OURS), objects, keys, options)
