"""Array functions against hand-made answers."""

import functools

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest

from unips_jax.metrics import angular_error_deg, mean_angular_error_deg
from unips_jax.models import ops


def test_one_mask_serves_several_estimates():
    true = np.float32([0, 0, 1]) + np.zeros((2, 4, 3), np.float32)
    tilted = np.float32([1, 0, 1]) + np.zeros((3, 2, 4, 3), np.float32)
    mask = np.array([[1, 1, 0, 0], [1, 0, 0, 0]], bool)
    for pair in ((tilted, true, mask), (tilted[0], true, np.stack([mask, mask]))):
        assert mean_angular_error_deg(*pair) == pytest.approx(45, abs=1e-4)


def test_what_is_outside_the_mask_may_be_nan():
    """As true normals often are, and has no part in the derivatives; by any types."""
    mask = np.array([[1, 1, 0, 0], [1, 0, 0, 0]], bool)
    tilted = np.float32([1, 0, 1]) + np.zeros((2, 4, 3), np.float32)
    true = np.where(mask[..., None], np.float32([0, 0, 1]), np.float32(np.nan))
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        run = jax.value_and_grad(mean_angular_error_deg)
        mean, slope = run(jnp.asarray(tilted), true, mask)
    assert mean == pytest.approx(45, abs=1e-4)
    expected = mask[..., None] * np.float32([1, 0, -1]) * 28.6479 / 3
    np.testing.assert_allclose(slope, expected, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1.0, 1e12, 1e30])
def test_lengths_do_not_matter_to_angles(scale):
    tilted, true = scale * jnp.float32([1, 0, 1]), jnp.float32([0, 0, 1])
    for pair in ((tilted, true), (true, tilted), (tilted, scale * true)):
        assert angular_error_deg(*pair) == pytest.approx(45, abs=1e-4)
    gradient = jax.grad(lambda x: angular_error_deg(x, true))(tilted)
    np.testing.assert_allclose(scale * gradient, [28.6479, 0, -28.6479], atol=1e-3)


def test_window_round_trip():
    x = jax.random.normal(jax.random.key(0), (2, 10, 15, 3))
    windows = ops.window_partition(x, 5)
    assert windows.shape == (2 * 6, 25, 3)
    np.testing.assert_array_equal(windows[1, 0], x[0, 0, 5])
    np.testing.assert_array_equal(ops.window_reverse(windows, 10, 15), x)


def test_mask_resize_takes_floor():
    mask = jnp.arange(8)[None, :] * jnp.ones((8, 1), int)
    np.testing.assert_array_equal(
        ops.resize_mask_nearest(mask, (4, 4))[0], [0, 2, 4, 6]
    )


def test_bilinear_resize_is_half_pixel_without_antialias():
    x = jnp.arange(8.0)[None, :, None] * jnp.ones((8, 1, 1))
    np.testing.assert_allclose(ops.resize_bilinear(x, (2, 2))[0, :, 0], [1.5, 5.5])


@pytest.mark.parametrize(("size", "bins"), [(2, 6), (7, 3), (5, 5)])
def test_adaptive_average(size, bins):
    x = np.random.default_rng(0).random((size, size, 2), np.float32)
    pooled = ops.adaptive_average_pool(jnp.asarray(x), bins)
    for i in range(bins):
        for j in range(bins):
            rows = slice(i * size // bins, int(np.ceil((i + 1) * size / bins)))
            columns = slice(j * size // bins, int(np.ceil((j + 1) * size / bins)))
            expected = x[rows, columns].mean((0, 1))
            np.testing.assert_allclose(pooled[i, j], expected, rtol=1e-5)


def test_shift_mask_separates_what_wrapped_around():
    mask = ops.shift_mask(4, 4, 2, 1)
    assert mask.shape == (4, 4, 4)
    assert (mask[0] == 0).all()  # the first window holds no wrapped token
    expected = np.where(np.eye(4, dtype=bool), 0, -100)
    np.testing.assert_array_equal(mask[3], expected)  # the last holds four corners


def test_relative_position_index():
    index = ops.relative_position_index(2)
    assert index.shape == (4, 4)
    assert (np.diag(index) == 4).all()  # offset (0, 0) in a table of 3 x 3
    assert index[0, 3] == 0  # offset (-1, -1)
    assert index[3, 0] == 8


@pytest.mark.parametrize("size", [(3, 5), (31, 29)])
@pytest.mark.parametrize("zeros", [True, False])
def test_bilinear_sample(size, zeros):
    h, w = size
    grid = np.random.default_rng(1).random((2, h, w, 3), np.float32)
    rows = jnp.array([0.0, 0.25, h - 1.0, -0.5, h - 0.5])
    columns = jnp.array([0.0, 1.5, w - 1.0, 0.0, 2.0])
    cells = jnp.asarray(np.moveaxis(grid, 0, 2))
    read = functools.partial(ops.bilinear_sample, zeros=zeros)
    out = jnp.swapaxes(read(cells, rows, columns), 0, 1)
    half = 0.5 if zeros else 1.0
    expected = [
        grid[:, 0, 0],
        0.375 * (grid[:, 0, 1] + grid[:, 0, 2])
        + 0.125 * (grid[:, 1, 1] + grid[:, 1, 2]),
        grid[:, -1, -1],
        half * grid[:, 0, 0],
        half * grid[:, -1, 2],
    ]
    np.testing.assert_allclose(out, np.stack(expected, 1), atol=1e-6)
    # And its derivatives, by the grid and by the places, within the grid.
    inner = (cells, rows[1:2] + 0.2, columns[1:2] + 0.3)
    jax.test_util.check_grads(read, inner, order=1, modes=["rev"], rtol=0.01, atol=0.01)


def test_normalize_has_finite_gradients_at_zero():
    x = jnp.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]])
    np.testing.assert_allclose(ops.normalize(x), [[0, 0, 0], [0.6, 0, 0.8]], atol=1e-7)
    gradient = jax.grad(lambda x: ops.normalize(x).sum())(x)
    assert np.isfinite(gradient).all()


def test_normalize_makes_no_nan_of_its_own():
    """For who searches the first one, step by step."""
    with jax.debug_nans(True), jax.disable_jit():
        jax.grad(lambda x: ops.normalize(x).sum())(jnp.float32([[0, 0, 2]]))


def test_normalize_shows_what_is_not_finite():
    x = jnp.array(
        [[np.nan, 1, 0], [1, np.inf, 0], [-np.inf, 0, 0], [0, 1e30, 0], [0, 0, 2]]
    )
    expected = np.full((5, 3), np.nan)
    expected[4] = 0, 0, 1
    np.testing.assert_array_equal(ops.normalize(x), expected)


@pytest.mark.parametrize("axis", [0, 1, -1])
def test_largest_is_the_maximum_with_one_elements_gradient(axis):
    x = jnp.asarray(np.random.default_rng(0).integers(0, 3, (4, 5, 6)), jnp.float32)
    np.testing.assert_array_equal(ops.largest(x, axis), jnp.max(x, axis))
    gradient = jax.grad(lambda x: jnp.sum(ops.largest(x, axis)))(x)
    assert set(np.unique(gradient)) == {0, 1}
    np.testing.assert_array_equal(jnp.sum(gradient, axis), 1)
    np.testing.assert_array_equal(jnp.sum(gradient * x, axis), jnp.max(x, axis))
    assert jnp.isnan(ops.largest(x.at[1, 2, 3].set(jnp.nan), axis)).any()


@pytest.mark.parametrize("strides", [(1, 1), (2, 2)])
@pytest.mark.parametrize("size", [(1, 1), (3, 3), (2, 3)])
def test_convolution_has_the_librarys_derivatives(strides, size):
    keys = jax.random.split(jax.random.key(0), 4)
    x, dx = jax.random.normal(keys[0], (2, 2, 7, 6, 4))
    kernel, dkernel = jax.random.normal(keys[1], (2, *size, 4, 5))
    padding = ((1, 0), (size[1] // 2, 1))
    numbers = ("NHWC", "HWIO", "NHWC")

    def ours(x, kernel):
        return ops.convolution(x, kernel, strides, padding)

    def librarys(x, kernel):
        return jax.lax.conv_general_dilated(
            x, kernel, strides, padding, dimension_numbers=numbers
        )

    tangents = (dx, dkernel)
    for a, b in zip(
        jax.jvp(ours, (x, kernel), tangents),
        jax.jvp(librarys, (x, kernel), tangents),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-4)
    (value, ours_back), (_, librarys_back) = (
        jax.vjp(f, x, kernel) for f in (ours, librarys)
    )
    cotangent = jax.random.normal(keys[2], value.shape)
    for a, b in zip(ours_back(cotangent), librarys_back(cotangent), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_angular_error_has_a_gradient_everywhere():
    rng = np.random.default_rng(0)
    true, predicted = rng.normal(size=(2, 4, 5, 3)).astype(np.float32)
    true[0] = predicted[0] = 0  # background
    true[1, 0] = predicted[1, 1] = 0
    predicted[1, 2] = true[1, 2]
    predicted[1, 3] = -true[1, 3]
    special = np.zeros((4, 5), bool)
    special[0] = special[1, :4] = True
    errors = angular_error_deg(predicted, true)
    np.testing.assert_array_equal(errors[special], [90.0] * 7 + [0, 180])
    for mask in (~special, np.ones_like(special)):
        slope = jax.grad(mean_angular_error_deg)(predicted, true, mask) * mask.sum()
        np.testing.assert_array_equal(slope[special], 0)
        for axis, step in enumerate(1e-2 * np.eye(3, dtype=np.float32)):
            ends = (angular_error_deg(predicted + s * step, true) for s in (1, -1))
            numeric = np.subtract(*ends) / 2e-2
            np.testing.assert_allclose(
                slope[..., axis][~special], numeric[~special], rtol=1e-2, atol=0.1
            )
