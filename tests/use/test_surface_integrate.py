"""Bilateral normal integration against surfaces whose depth is known exactly."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax import integrate_image, integrate_normals
from unips_jax.surface import integrate
from unips_jax.surface.equations import statements
from unips_jax.surface.integrate import read_prior


def grid(height, width):
    """Columns and rows, `[H, W]` each."""
    return np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))


def unit(x, y, z):
    normals = np.stack(np.broadcast_arrays(x, y, z), -1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return (normals / np.where(length > 0, length, 1)).astype(np.float32)


def of_height(across, down):
    """Normals of a height towards the viewer, from its slopes to the right and down."""
    return unit(-across, down, np.ones(np.broadcast(across, down).shape))


def hemisphere(size):
    column, row = grid(size, size)
    radius = 0.49 * size
    x, y = (column - (size - 1) / 2) / radius, -(row - (size - 1) / 2) / radius
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 0))
    return unit(x * mask, y * mask, z), mask, -radius * z, radius


def cut_waves(size, amplitude):
    """A cosine sheet above the middle row, its negative below: depth jumps between."""
    column, row = grid(size, size)
    rate = 4 * np.pi / size
    sign = np.where(row < size / 2, 1, -1)
    normals = of_height(-sign * amplitude * rate * np.sin(rate * column), 0 * column)
    return normals, -sign * amplitude * np.cos(rate * column)


def deviation(depth, truth, mask=None):
    """Absolute errors once the mean offset is taken off."""
    mask = np.ones(truth.shape, bool) if mask is None else mask
    error = np.asarray(depth)[mask] - truth[mask]
    return np.abs(error - error.mean())


def test_hemisphere_within_a_three_hundredth_of_its_radius():
    normals, mask, truth, radius = hemisphere(512)
    found = integrate_image(normals, mask)
    # Measured: 1e-5; statements of single pixels, as in the paper, give 0.02.
    assert deviation(found.depth, truth, mask).max() < 1e-4 * radius
    assert found.islands == 1
    assert np.isnan(found.depth[~mask]).all()
    assert abs(np.nanmean(found.depth)) < 1e-2
    # The middle is nearest: depth grows away from the viewer.
    assert np.nanargmin(found.depth) in np.flatnonzero(truth == truth.min())


def test_saddle():
    column, row = grid(61, 83)
    across, down = (column - 41) / 60, -(row - 30) / 50
    truth = -((column - 41) ** 2 / 120 - (row - 30) ** 2 / 100)
    found = integrate_image(of_height(across, down))
    assert deviation(found.depth, truth).max() < 0.15  # of a range of 23 pixels
    plain = integrate_image(of_height(across, down), max_rounds=0)
    assert deviation(plain.depth, truth).max() < 0.02


def test_a_jump_stays_sharp():
    normals, truth = cut_waves(96, 20)
    plain = integrate_image(normals, max_rounds=0)
    found = integrate_image(normals)
    # Measured: 3.7 pixels with plain least squares, 0.04 with weights.
    assert deviation(plain.depth, truth).mean() > 3
    assert deviation(found.depth, truth).mean() < 0.1
    jump = found.depth[48] - found.depth[47]
    assert np.abs(jump - (truth[48] - truth[47])).max() < 0.5
    beside = np.diff(found.depth, axis=0)[[45, 46, 48, 49]]
    assert np.abs(beside).max() < 0.5


def test_front_ball_does_not_bend_the_one_behind():
    column, row = grid(96, 96)
    truth, normals = np.zeros((96, 96)), np.zeros((96, 96, 3), np.float32)
    label = np.zeros((96, 96), int)
    for index, (x0, y0, radius) in enumerate([(38, 40, 34), (62, 58, 30)], start=1):
        x, y = (column - x0) / radius, -(row - y0) / radius
        ball = x**2 + y**2 < 1
        z = np.sqrt(np.where(ball, 1 - x**2 - y**2, 0))
        normals[ball] = unit(x, y, z)[ball]
        truth[ball], label[ball] = -radius * z[ball], index
    plain, found = integrate_image(normals, max_rounds=0), integrate_image(normals)
    errors = [
        deviation(each.depth, truth, label == 1).mean() for each in (plain, found)
    ]
    assert errors[1] < errors[0] / 5, errors


@pytest.mark.parametrize("principal_point", [None, np.array([20.0, 55.0])])
def test_perspective_plane(principal_point):
    column, row = grid(72, 90)
    focal = 130.0
    x0, y0 = (44.5, 35.5) if principal_point is None else principal_point
    normal = unit(0.4, -0.3, 0.87)
    ray = np.stack([(column - x0) / focal, -(row - y0) / focal, -np.ones_like(row)], -1)
    truth = -1 / (ray @ normal)
    normals = np.broadcast_to(normal, (72, 90, 3))
    mask = np.zeros((72, 90), bool)
    mask[9:70, 29:90] = True  # what is integrated is its box
    found = integrate_image(normals, mask, focal=focal, principal_point=principal_point)
    assert abs(np.log(found.depth[mask]).mean()) < 1e-5
    ratio = (found.depth / truth)[mask]
    assert np.ptp(ratio) / ratio.mean() < 1e-4


def test_the_principal_point_is_the_middle_of_the_image():
    normals = jnp.broadcast_to(jnp.array([0.4, -0.3, 0.87]), (7, 10, 3))
    inside = jnp.ones((7, 10), bool)
    middle, given = (statements(normals, inside, 20.0, p).m for p in (None, (4.5, 3.0)))
    np.testing.assert_allclose(middle, given, rtol=1e-6)


def test_a_prior_that_is_no_distance_is_unknown():
    prior = jnp.array([[2.0, 0.0, -3.0, jnp.nan, 8.0]])
    labels = jnp.zeros((1, 5), int)
    known, shift = read_prior(prior, 0.5, jnp.ones((1, 5), bool), labels, 10.0)
    half = 10 * np.log(2)
    np.testing.assert_allclose(shift, 10 * np.log(4), rtol=1e-6)
    np.testing.assert_allclose(known.depth, [[-half, 0, 0, 0, half]], rtol=1e-5)
    np.testing.assert_allclose(known.weight, [[0.5, 0, 0, 0, 0.5]])


def perspective_box(size, focal):
    """A cube seen from a corner: normals, distance along the axis, mask."""
    column, row = grid(size, size)
    middle = (size - 1) / 2
    ray = np.stack(
        [(column - middle) / focal, -(row - middle) / focal, -np.ones_like(row)], -1
    )
    towards = np.array([1, 1, 1]) / np.sqrt(3)
    side = np.cross([0, 1, 0], towards)
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(towards, side), towards])  # rows: x, y, z
    normals, corner = np.eye(3) @ frame.T, np.array([0, 0, -4.0])
    # A convex corner is the farthest of its three planes.
    distance = np.stack([(n @ corner) / (ray @ n) for n in normals])
    return normals[distance.argmax(0)].astype(np.float32), distance.max(0)


def test_perspective_box():
    normals, truth = perspective_box(91, 160.0)
    found = integrate_image(normals, focal=160.0)
    ratio = found.depth / truth
    ratio /= np.median(ratio)
    # A crease between two pixels is off by a fraction of one: 4 / 160 a pixel.
    assert np.abs(ratio - 1).max() < 0.01
    assert np.abs(ratio - 1).mean() < 0.003


def test_offset_and_scale_come_from_the_prior():
    normals, mask, truth, radius = hemisphere(40)
    prior = np.full(truth.shape, np.nan)
    prior[18:22, 18:22] = truth[18:22, 18:22] + 500
    found = integrate_image(normals, mask, prior=prior)
    assert np.abs(found.depth - truth - 500)[mask].max() < 0.1
    assert np.isfinite(found.depth[mask]).all()


@pytest.mark.parametrize("dtype", [np.float16, np.uint16])
def test_priors_of_any_type(dtype):
    """Of half floats the sum over an image is beyond them."""
    normals, mask, truth, _ = hemisphere(40)
    prior = np.where(mask, truth + 1000, 0).astype(dtype)
    expected = integrate_normals(normals, mask, prior=prior.astype(np.float32))
    found = integrate_normals(normals, mask, prior=prior)
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found).all() and expected[mask].min() > 900


def test_types_do_not_grow_with_wide_numbers():
    normals, mask, _, _ = hemisphere(20)
    prior = np.ones(mask.shape, np.float32)
    with jax.enable_x64(True):
        for focal in (None, 30.0, np.float64(30)):
            run = functools.partial(
                integrate_normals,
                focal=focal,
                principal_point=focal and (focal, focal),
                prior_weight=np.float64(1e-3),
            )
            assert jax.eval_shape(run, normals, mask).dtype == jnp.float32
            found = jax.eval_shape(functools.partial(run, prior=prior), normals, mask)
            assert found.dtype == jnp.float32


def test_prior_in_perspective_has_the_users_unit():
    normals, truth = perspective_box(64, 110.0)
    found = integrate_image(normals, focal=110.0, prior=truth * 250)
    assert np.abs(found.depth / (truth * 250) - 1).max() < 0.01


def test_prior_mends_what_normals_drift():
    column, _ = grid(300, 300)
    flat = np.broadcast_to(np.float32([0, 0, 1]), (300, 300, 3))
    bent = 0.02 * (column - 150)
    strong = integrate_image(flat, prior=bent, prior_weight=1.0, max_rounds=0)
    weak = integrate_image(flat, prior=bent, prior_weight=1e-8, max_rounds=0)
    assert np.abs(strong.depth - bent).max() < 0.1
    assert np.ptp(weak.depth) < 0.1


@pytest.mark.parametrize(
    ("pixels", "islands"),
    [
        ([], 0),
        ([(3, 4)], 1),
        ([(3, 4), (4, 5)], 2),  # corners do not connect
        ([(0, 0), (0, 1), (5, 6), (6, 6)], 2),
    ],
)
def test_few_pixels(pixels, islands):
    mask = np.zeros((7, 9), bool)
    for pixel in pixels:
        mask[pixel] = True
    found = integrate_image(np.broadcast_to(unit(0.6, 0, 0.8), (7, 9, 3)), mask)
    assert found.islands == islands
    assert np.array_equal(np.isfinite(found.depth), mask)
    if islands == 2 and len(pixels) == 4:
        # A slope of -3/4 in height, to the right, is 3/4 in depth.
        assert found.depth[0, 1] - found.depth[0, 0] == pytest.approx(0.75, abs=1e-4)
        assert found.depth[0, 0] == pytest.approx(-0.375, abs=1e-4)


def test_holes_and_islands():
    normals, mask, truth, _ = hemisphere(64)
    normals = normals.copy()
    normals[20:25, 30:33] = np.nan
    normals[40, 40] = 0
    mask = mask.copy()
    mask[:, 15] = False
    found = integrate_image(normals, mask)
    holes = ~np.isfinite(normals).all(-1) | (normals == 0).all(-1)
    assert np.array_equal(np.isnan(found.depth), ~mask | holes)
    assert found.islands == 2
    left = mask & (grid(64, 64)[0] < 15)
    assert abs(found.depth[left].mean()) < 1e-3
    right = mask & ~left & ~holes
    assert deviation(found.depth, truth, right).mean() < 0.2


def test_normals_at_and_beyond_ninety_degrees_give_numbers():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(33, 47, 3)).astype(np.float32)
    normals[3:6] = [1, 0, 0]
    assert np.isfinite(integrate_image(normals).depth).all()
    assert np.isfinite(integrate_image(normals, focal=30.0).depth).all()


def small_surface(seed):
    rng = np.random.default_rng(seed)
    normals = unit(*(rng.normal(size=(2, 11, 13)) / 2), np.ones((11, 13)))
    mask = np.ones((11, 13), bool)
    mask[:2, :3] = False
    return jnp.asarray(normals), jnp.asarray(mask)


@pytest.mark.parametrize("focal", [None, 17.0])
def test_gradient_agrees_with_finite_differences(focal):
    normals, mask = small_surface(0)
    prior = jnp.full(mask.shape, jnp.nan).at[5, 5].set(3.0)
    weights = jax.random.normal(jax.random.key(1), mask.shape)

    @jax.jit
    def score(normals):
        depth = integrate_normals(
            normals, mask, focal=focal, prior=prior, prior_weight=0.1, rounds=2
        )
        return (weights * depth).sum()

    gradient = jax.jit(jax.grad(score))(normals)
    assert np.isfinite(gradient).all()
    assert not np.asarray(gradient)[~np.asarray(mask)].any()
    for seed in range(3):
        direction = jax.random.normal(jax.random.key(seed), normals.shape)
        step = 1e-2
        ahead, behind = (
            score(normals + sign * step * direction).item() for sign in (1, -1)
        )
        expected = (ahead - behind) / (2 * step)
        assert (gradient * direction).sum() == pytest.approx(expected, rel=0.01)


def test_vmap_is_the_loop_and_jit_is_eager():
    pairs = [small_surface(seed) for seed in (0, 1)]
    normals, masks = (jnp.stack(each) for each in zip(*pairs, strict=True))
    focals = jnp.array([20.0, 40.0])

    def depth(normals, mask, focal):
        return integrate_normals(normals, mask, focal=focal, rounds=2)

    together = jax.jit(jax.vmap(depth))(normals, masks, focals)
    for index in range(2):
        alone = depth(normals[index], masks[index], focals[index])
        np.testing.assert_allclose(together[index], alone, rtol=1e-4, atol=1e-5)


def test_any_arrays_will_do_and_one_compilation_serves_them():
    normals, mask, _, _ = hemisphere(12)
    integrate._integrate.clear_cache()
    expected = integrate_normals(normals, mask, focal=30.0, rounds=1)
    for given in (
        (normals.tolist(), mask.tolist()),
        (jnp.asarray(normals), mask.astype(np.uint8) * 255),
    ):
        found = integrate_normals(*given, focal=np.float64(30), rounds=1)
        np.testing.assert_array_equal(found, expected)
    assert integrate._integrate._cache_size() == 1


def test_strict_promotion_is_enough():
    """Of types and of ranks."""
    normals, mask, depth, _ = hemisphere(12)
    run = functools.partial(integrate_normals, prior=np.float32(depth), focal=30)
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        assert jax.eval_shape(run, normals, mask).shape == mask.shape
        integrate_image(normals, mask, prior=depth, max_rounds=1)


def test_normals_may_have_any_length():
    normals, mask = small_surface(0)
    expected = integrate_normals(normals, mask, rounds=2)
    row, column = np.argwhere(np.asarray(mask))[20]
    short = jnp.asarray(normals).at[row, column].multiply(1e-20)
    np.testing.assert_allclose(
        integrate_normals(short, mask, rounds=2), expected, atol=1e-4
    )

    def spread(normals):
        return jnp.square(integrate_normals(normals, mask, rounds=2)).sum()

    assert np.isfinite(jax.grad(spread)(short)).all()


def test_inside_shard_map_without_its_check():
    normals, mask = small_surface(0)
    mesh = jax.make_mesh((1,), ("x",), axis_types=(jax.sharding.AxisType.Auto,))
    split = jax.sharding.PartitionSpec("x")

    @jax.shard_map(mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
    def depth(normals, mask):
        return integrate_normals(normals[0], mask[0], rounds=2)[None]

    found = depth(jnp.asarray(normals)[None], jnp.asarray(mask)[None])
    np.testing.assert_allclose(
        found[0], integrate_normals(normals, mask, rounds=2), atol=1e-4
    )


def test_both_paths_agree():
    normals, mask, _, _ = hemisphere(48)
    pure = integrate_normals(jnp.asarray(normals), jnp.asarray(mask), rounds=1)
    image = integrate_image(normals, mask, max_rounds=1)
    assert not np.asarray(pure)[~mask].any()
    np.testing.assert_allclose(pure[mask], image.depth[mask], atol=0.02)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"normals": np.zeros((4, 5))}, r"normals: expected \[H, W, 3\]"),
        ({"mask": np.ones((4, 4))}, r"normals: expected \(4, 4, 3\)"),
        ({"normals": np.ones((4, 5, 3), np.uint8)}, "normals: expected floats of"),
        ({"prior": np.ones((4, 4))}, r"prior: expected \(4, 5\)"),
        ({"focal": 0.0}, "focal: expected pixels above 0, got 0.0"),
        ({"sharpness": -1.0}, "sharpness: expected 0 or more"),
        ({"max_rounds": -1}, "max_rounds: expected 0 or more"),
    ],
)
def test_bad_arguments(options, message):
    arguments = {"normals": np.ones((4, 5, 3)), **options}
    with pytest.raises(ValueError, match=message):
        integrate_image(**arguments)
