"""The pure function: chunks, shapes, transformations, bad arguments."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_objects import ellipse_photographs
from small_networks import SHALLOW, SHALLOW_OURS, SMALL, lively_network

from unips_jax import estimate_normals
from unips_jax.estimation import pure
from unips_jax.estimation.streaming import estimate_photographs
from unips_jax.models import chunks
from unips_jax.models.network import Encoding, encode, with_uniform_contexts
from unips_jax.models.views import (
    Frame,
    Views,
    canonical_images,
    context_cells,
    square_frame,
)


@pytest.fixture(scope="module")
def network():
    return lively_network(SHALLOW)


def test_unit_inside_zero_outside_and_scale_free(network):
    images, mask = ellipse_photographs()
    normals = estimate_normals(network, images, mask)
    assert normals.shape == (23, 31, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), mask, atol=1e-5)
    scaled = images * np.array([1.0, 50.0, 0.02])[:, None, None, None]
    again = estimate_normals(network, scaled, mask)
    np.testing.assert_allclose(again, normals, atol=1e-4)


def test_light_outside_the_mask_does_not_matter(network):
    images, mask = ellipse_photographs()
    normals = estimate_normals(network, images, mask)
    other = np.where(mask[..., None], images, 7)
    again = estimate_normals(network, other, mask)
    np.testing.assert_allclose(again, normals, atol=1e-6)


def test_chunked_equals_whole(network, monkeypatch):
    images, mask = ellipse_photographs(n=5)
    monkeypatch.setattr(chunks, "CHUNK_TOKENS", 10**6)
    monkeypatch.setattr(chunks, "CHUNK_IMAGES", 10)
    pure._estimate.clear_cache()
    whole = estimate_normals(network, images, mask)
    monkeypatch.setattr(chunks, "CHUNK_TOKENS", 70)
    monkeypatch.setattr(chunks, "CHUNK_IMAGES", 2)
    pure._estimate.clear_cache()
    chunked = estimate_normals(network, images, mask)
    pure._estimate.clear_cache()
    np.testing.assert_allclose(chunked, whole, atol=1e-5)


@pytest.mark.parametrize("communication", ["none", "during", "pre", "post", "ours"])
def test_encoding_in_pieces_is_the_encoder(monkeypatch, communication):
    config = SHALLOW_OURS
    if communication != "ours":  # "during" is between stages
        config = SMALL if communication == "during" else SHALLOW
        config = dataclasses.replace(config, communication=communication)
    network = lively_network(config)
    images = jax.random.uniform(jax.random.key(1), (2, 5, 16, 16, 4))
    valid = jnp.array([True, True, False, True, True])
    monkeypatch.setattr(chunks, "CHUNK_TOKENS", 30)

    @jax.jit
    def both(network, images, valid):
        views = Views(images, None, None, None)
        pieces = encode(network, views, valid, **chunks.bounded(5))
        whole = encode(network, views, valid)
        return pieces.contexts, whole.contexts

    np.testing.assert_allclose(*both(network, images, valid), rtol=1e-4, atol=1e-4)


def test_place_in_the_image_does_not_matter(network):
    images, mask = ellipse_photographs()
    rows, columns = np.nonzero(mask)
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    cropped = estimate_normals(network, images[:, *box], mask[box], frame="mask")
    whole = estimate_normals(network, images, mask)
    np.testing.assert_allclose(whole[box], cropped, atol=1e-5)


def test_frame_keeps_the_aspect():
    mask = np.zeros((20, 30), bool)
    mask[3:9, 10:28] = True
    assert [int(v) for v in square_frame(mask)] == [-3, 10, 18]
    assert [int(v) for v in square_frame(mask, "image")] == [-5, 0, 30]
    assert [int(v) for v in square_frame(np.zeros((20, 30)))] == [-5, 0, 30]
    with pytest.raises(ValueError, match="frame: expected one of"):
        square_frame(mask, "masks")


@pytest.mark.parametrize("antialias", [False, True])
def test_canonical_images_are_resized_ones(antialias):
    """Of a whole image those of a library; of a flat object flat up to its rim."""
    images = np.random.default_rng(2).random((2, 39, 39, 3)).astype(np.float32)
    frame, full = square_frame(np.ones((39, 39))), jnp.ones((39, 39), bool)
    actual = canonical_images(images, full, frame, 16, antialias)
    expected = jax.image.resize(images, (2, 16, 16, 3), "linear", antialias=antialias)
    np.testing.assert_allclose(actual[..., :3], expected, atol=1e-6)

    if antialias:
        _, mask = ellipse_photographs()
        flat = mask[None, ..., None] * jnp.full(3, 0.7)
        frame = square_frame(mask)
        small = canonical_images(flat, jnp.asarray(mask), frame, 16, antialias)
        expected = 0.7 * jnp.repeat(small[..., 3:], 3, axis=-1)
        np.testing.assert_allclose(small[..., :3], expected, atol=1e-6)


def test_contexts_are_read_at_the_middles_of_pixels():
    """Those of the authors' released weights at their corners."""
    released = dataclasses.replace(SHALLOW, context_sampling="corner")
    frame = Frame(*np.int32([-3, 5, 2 * SHALLOW.context_size]))
    places = np.array([0, 1, 7])
    for config, middle in ((SHALLOW_OURS, 0.5), (SHALLOW, 0.5), (released, 0.0)):
        rows, columns = context_cells(places, places + 8, frame, config)
        np.testing.assert_allclose(rows, (places + 3 + middle) / 2 - 0.5)
        np.testing.assert_allclose(columns, (places + 3 + middle) / 2 - 0.5)


def test_no_mask_is_the_whole_image(network):
    images, _ = ellipse_photographs()
    normals = estimate_normals(network, images)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)


def test_padded_sets(network):
    images, mask = ellipse_photographs()
    plain = estimate_normals(network, images, mask)
    valid = [True, True, True, False, False]
    for value in (5, np.nan, np.inf):  # as of memory that nobody wrote
        rest = np.full((2, 23, 31, 3), value, np.float32)
        padded = np.concatenate([images, rest])
        again = estimate_normals(network, padded, mask, valid=valid)
        np.testing.assert_allclose(again, plain, atol=1e-5)


def test_padding_has_no_gradient(network):
    images, mask = ellipse_photographs()
    padded = np.concatenate([images, np.full((1, 23, 31, 3), np.nan, np.float32)])
    valid = np.array([True, True, True, False])

    def tilt(images):
        return estimate_normals(network, images, mask, valid=valid)[..., 0].sum()

    slopes = jax.grad(tilt)(jnp.asarray(padded))
    assert np.isfinite(slopes).all() and (slopes[3] == 0).all()


def test_jit_vmap_and_eager_agree(network):
    pairs = [ellipse_photographs(), ellipse_photographs()]
    pairs[1] = (pairs[1][0][:, ::-1] ** 2, pairs[1][1][:, ::-1])
    images, masks = (np.stack(x) for x in zip(*pairs, strict=True))

    def run(images, mask):
        return estimate_normals(network, images, mask)

    loop = np.stack([run(*pair) for pair in zip(images, masks, strict=True)])
    np.testing.assert_allclose(jax.jit(jax.vmap(run))(images, masks), loop, atol=1e-5)


def test_photographs_may_be_of_half_precision(network):
    images, mask = ellipse_photographs()
    half = jnp.asarray(images, jnp.bfloat16)
    expected = estimate_photographs(network, np.float32(half), mask)
    np.testing.assert_array_equal(estimate_photographs(network, half, mask), expected)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_show(network, value):
    images, mask = ellipse_photographs()
    clean = estimate_normals(network, images, mask)
    images[:, ~mask] = value
    again = estimate_normals(network, images, mask)
    np.testing.assert_array_equal(again, clean)
    images[1, 12, 13, 2] = value
    expected = np.where(mask, np.nan, 0)[..., None].repeat(3, -1)
    for estimate in (estimate_normals, estimate_photographs):
        with np.errstate(invalid="ignore"):
            normals = estimate(network, images, mask)
        np.testing.assert_array_equal(normals, expected)


def test_compiles_once_per_shape(network):
    pure._estimate.clear_cache()
    for seed in range(3):
        images, mask = ellipse_photographs()
        mask = mask & (np.random.default_rng(seed).random(mask.shape) < 0.8)
        estimate_normals(network, images * (1 + seed), mask)
    assert pure._estimate._cache_size() == 1


@pytest.mark.parametrize(
    ("dtype", "transfer", "config"),
    [
        ("float32", "linear", SHALLOW),
        ("uint16", "linear", SHALLOW_OURS),
        ("uint8", "srgb", SHALLOW_OURS),
    ],
    ids=["float", "linear", "srgb"],
)
def test_streaming_gives_the_same(dtype, transfer, config):
    network = lively_network(config)
    images, mask = ellipse_photographs(n=5)
    stored, linear = images, images
    if dtype != "float32":
        top = np.iinfo(dtype).max
        stored = np.round(images * top).astype(dtype)
        linear = stored / np.float32(top)
    if transfer == "srgb":
        high = ((linear + 0.055) / 1.055) ** 2.4
        linear = np.where(linear <= 0.04045, linear / 12.92, high)
    expected = estimate_normals(network, linear, mask)
    seen = []
    actual = estimate_photographs(
        network,
        stored,
        mask,
        transfer=transfer,
        progress=lambda done, total: seen.append((done, total)),
    )
    np.testing.assert_allclose(actual, expected, atol=2e-5)
    assert seen[-1] == (mask.sum(), mask.sum())


def test_uniform_contexts_differ(network):
    images, mask = ellipse_photographs()
    plain = estimate_normals(network, images, mask)
    uniform = estimate_normals(network, images, mask, uniform_contexts=True)
    assert abs(plain - uniform).max() > 1e-3
    streamed = estimate_photographs(network, images, mask, uniform_contexts=True)
    np.testing.assert_allclose(streamed, uniform, atol=2e-5)


def test_uniform_contexts_are_the_mean_over_the_mask():
    contexts = jnp.float32([[1, 2], [4, 9]]).reshape(1, 2, 2, 1, 1)
    seen = jnp.zeros((1, 1, 4, 4, 4)).at[..., :2, :, 3].set(1)  # the upper half
    encoding = Encoding(contexts, None, None, None)
    found = with_uniform_contexts(encoding, Views(seen, None, None, None))
    np.testing.assert_allclose(found.contexts, jnp.full((1, 2, 2, 1, 1), 1.5))


@pytest.mark.parametrize(
    ("images", "mask", "message"),
    [
        (np.zeros((2, 8, 8)), None, r"images: expected \[N, H, W, 3\]"),
        (np.zeros((2, 8, 8, 4)), None, "images"),
        (np.zeros((0, 8, 8, 3)), None, "at least one image"),
        (np.zeros((2, 8, 8, 3)), np.ones((8, 9)), r"mask: expected .*\(8, 8\)"),
    ],
)
def test_bad_shapes(network, images, mask, message):
    for estimate in (estimate_normals, estimate_photographs):
        with pytest.raises(ValueError, match=message):
            estimate(network, images, mask)


def test_photographs_take_masks_and_transfers_as_they_come(network):
    images, mask = ellipse_photographs()
    expected = estimate_photographs(network, images, mask)
    for other in (mask.astype(np.uint8) * 255, -0.3 * mask):
        found = estimate_photographs(network, images, other)
        np.testing.assert_array_equal(found, expected)
    whole = estimate_photographs(network, images, np.ones_like(mask))
    np.testing.assert_array_equal(estimate_photographs(network, images), whole)
    with pytest.raises(ValueError, match="transfer: expected one of"):
        estimate_photographs(network, images, mask, transfer="sRGB")


def test_every_number_but_zero_is_inside_the_mask(network):
    images, mask = ellipse_photographs()
    expected = estimate_normals(network, images, mask)
    for value in (-1, 0.3):
        normals = estimate_normals(network, images, value * mask)
        np.testing.assert_array_equal(normals, expected)


def test_a_mask_known_to_the_compiler_is_not_worked_through(network):
    """Its folding takes longer than the rest of a large image's compilation."""
    images, mask = ellipse_photographs()
    run = jax.jit(lambda images: estimate_normals(network, images, mask))
    program = run.lower(images).compile().as_text()
    assert "pred[23,31]" in program
    assert not re.search(r"s32\[713\]\S* constant\(", program)


def test_what_is_no_network_is_refused():
    images, mask = ellipse_photographs()
    with pytest.raises(TypeError, match="network: expected a UniversalNetwork.*dict"):
        estimate_normals({}, images, mask)
    with pytest.raises(TypeError, match="network: expected a UniversalNetwork.*dict"):
        estimate_photographs({}, images, mask)
