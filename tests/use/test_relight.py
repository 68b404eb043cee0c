"""`relight`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_objects import hemisphere

from unips_jax import DistantLights, Materials, relight
from unips_jax.lighting.environment import blurred, glossy_light, sphere, turned
from unips_jax.lighting.harmonics import BAND, COSINE_LOBE, harmonics
from unips_jax.lighting.reflectance import ggx

NORMALS, MASK, _ = hemisphere(24)
WHITE = Materials(jnp.ones(3), 0.5, 0.0, specular=0.0)
GLOSSY = Materials(jnp.array([0.5, 0.4, 0.3]), 0.4)


def lamp(direction, color=(np.pi,) * 3):
    return DistantLights(jnp.array([direction], jnp.float32), jnp.array([color]))


def test_a_matt_white_surface_under_a_lamp_is_the_cosine():
    image = np.asarray(relight(NORMALS, WHITE, lamp((2.0, 0, 0))))
    expected = np.maximum(NORMALS[..., 0], 0)
    np.testing.assert_allclose(image[MASK], expected[MASK][:, None] * [1, 1, 1], 1e-5)
    assert (image[~MASK] == 0).all()


def test_lamps_and_surroundings_add_up():
    lamps = DistantLights(jnp.eye(3), jnp.array([[1.0, 2, 3], [3, 1, 2], [2, 2, 2]]))
    around = jax.random.uniform(jax.random.key(0), (8, 16, 3))
    whole = relight(NORMALS, GLOSSY, lamps, around)
    parts = [relight(NORMALS, GLOSSY, environment=around)]
    for direction, color in zip(*lamps, strict=True):
        parts.append(relight(NORMALS, GLOSSY, lamp(direction, color)))
    np.testing.assert_allclose(whole, sum(parts), atol=1e-5)


def test_strict_promotion_is_enough():
    """Of types and of ranks."""
    lights = DistantLights(np.eye(3, dtype=np.float32), np.ones((3, 3), np.float32))

    def loss(normals, around):
        return relight(normals, GLOSSY, lights, around, focal=30).sum()

    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        for size in ((9, 3), (8, 16, 3)):
            around = jax.ShapeDtypeStruct(size, jnp.float32)
            slopes = jax.eval_shape(
                jax.grad(loss, (0, 1)), jnp.asarray(NORMALS), around
            )
            assert slopes[1].shape == size


def test_even_surroundings_show_the_albedo():
    """In the same light from everywhere a white furnace's matt surface is white."""
    image = relight(NORMALS, WHITE, environment=jnp.full((16, 32, 3), 0.7))
    np.testing.assert_allclose(np.asarray(image)[MASK], 0.7, atol=1e-4)
    same = relight(NORMALS, WHITE, environment=jnp.full((1, 3), 0.7 * 3.5449077))
    np.testing.assert_allclose(np.asarray(same)[MASK], 0.7, atol=1e-4)


def test_surroundings_come_from_where_the_picture_says():
    rows, columns = 16, 32
    axes = {
        (0, 0): (0, 1, 0),
        (8, 16): (0, 0, -1),
        (8, 24): (1, 0, 0),
        (8, 8): (-1, 0, 0),
        (8, 0): (0, 0, 1),
    }
    for (row, column), axis in axes.items():
        around = np.zeros((rows, columns, 3), np.float32)
        around[max(row - 1, 0) : row + 1, max(column - 1, 0) : column + 1] = 1
        if column == 0:
            around[row - 1 : row + 1, [0, -1]] = 1
        facing = np.array([[axis]], np.float32)
        back = -facing
        lit, dark = (
            float(relight(n, WHITE, environment=around).mean()) for n in (facing, back)
        )
        assert lit > 10 * dark + 1e-3, axis


def test_a_turn_moves_what_is_behind_to_the_left():
    around = np.zeros((8, 16, 3), np.float32)
    around[:, 8] = 1
    assert np.asarray(turned(around, 90.0))[0, :, 0].argmax() == 4
    np.testing.assert_allclose(turned(turned(around, 30.0), -30.0), around, atol=0.45)


def test_a_small_bright_lamp_and_its_picture_light_alike():
    directions, solid = sphere(32, 64)
    around = jnp.zeros((32, 64, 3)).at[9, 5].set(np.pi / solid[9, 5])
    metal = Materials(jnp.ones(3), 0.4, 1.0)
    for materials, tolerance in ((WHITE, 0.03), (metal, 0.1)):
        exact = np.asarray(relight(NORMALS, materials, lamp(directions[9, 5])))
        table = np.asarray(relight(NORMALS, materials, environment=around))
        # Measured 0.017 and 0.043: the lobe is taken as seen head-on.
        facing = NORMALS[..., 2] > 0.4
        assert np.abs(exact - table)[facing].max() < tolerance * exact.max()


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0)])
def test_a_small_lamp_in_a_large_picture_loses_no_light(axis):
    """Behind the camera, where the picture's ends meet, and at its poles, too."""
    directions, solid = sphere(128, 256)
    inside = directions @ jnp.float32(axis) > np.cos(np.radians(3))
    power = float((inside * solid).sum())
    around = (inside * np.pi / power)[..., None] * jnp.ones(3)
    facing = jnp.float32([[axis]])
    image = relight(facing, WHITE, environment=around)
    np.testing.assert_allclose(image, 1, atol=0.01)  # 0.81 to 1.7 by plain resizing


@pytest.mark.parametrize("roughness", [0.03, 0.05, 0.1, 0.3])
def test_a_mirror_under_a_lamp_loses_no_light(roughness):
    """Seen from above, half vectors all around: what is not lost is 1."""
    angle = jnp.linspace(0, 1, 40_000) ** 3 * (np.pi / 4)  # of the half vector
    light = 2 * angle
    n_l, one = jnp.cos(light), jnp.ones_like(angle)
    lobe = ggx(jnp.cos(angle), n_l, one, one * roughness**2)
    whole = jnp.trapezoid(2 * np.pi * jnp.sin(light) * lobe * n_l, light)
    assert float(whole) == pytest.approx(1, abs=0.03 if roughness < 0.3 else 0.1)


def test_a_perfect_mirror_is_a_very_smooth_one():
    """Its highlight would be infinite."""
    plane = np.broadcast_to(np.float32([0, 0, 1]), (2, 3, 3))
    perfect, smooth = (
        relight(plane, Materials(jnp.ones(3), roughness), lamp((0.0, 0, 1)))
        for roughness in (0.0, 0.03)
    )
    assert np.isfinite(perfect).all()
    np.testing.assert_array_equal(perfect, smooth)


def test_harmonics_are_in_the_order_that_is_stated():
    """In `lights.json`: 1, y, z, x, xy, yz, 3z^2 - 1, xz, x^2 - y^2."""
    x, y, z = 0.48, 0.6, 0.64
    stated = [1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    scale = np.sqrt(np.array([1, 3, 3, 3, 15, 15, 1.25, 15, 3.75]) / (4 * np.pi))
    np.testing.assert_allclose(
        harmonics(np.array([x, y, z])), scale * stated, rtol=1e-6
    )


def test_harmonics_are_orthonormal_and_give_irradiance():
    directions, solid = (np.asarray(v) for v in sphere(90, 180))
    basis = harmonics(directions)
    gram = np.einsum("hwi,hwj,hw->ij", basis, basis, solid)
    np.testing.assert_allclose(gram, np.eye(9), atol=2e-3)
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(9, 3)).astype(np.float32)
    coefficients[0] += 6
    image = relight(NORMALS, WHITE, environment=coefficients)
    irradiance = harmonics(NORMALS) @ (COSINE_LOBE[BAND][:, None] * coefficients)
    expected = irradiance[MASK] / np.pi
    np.testing.assert_allclose(np.asarray(image)[MASK], expected, atol=1e-5)
    # A picture of the same light shows the same, shiny surfaces too.
    picture = harmonics(np.asarray(sphere(32, 64)[0])) @ coefficients
    for materials in (WHITE, GLOSSY, Materials(jnp.ones(3), 0.7, 1.0)):
        exact = relight(NORMALS, materials, environment=coefficients)
        table = relight(NORMALS, materials, environment=picture)
        np.testing.assert_allclose(table, exact, atol=0.01 * exact.max())


def test_roughness_blurs_without_losing_light():
    around = jax.random.uniform(jax.random.key(1), (32, 64, 3))
    directions, solid = sphere(16, 32)
    levels = [
        glossy_light(blurred(around), directions, jnp.full(solid.shape, roughness))
        for roughness in (0.0, 0.2, 0.6, 1.0)
    ]
    means = [float((x * solid[..., None]).sum() / solid.sum() / 3) for x in levels]
    np.testing.assert_allclose(means, means[0], atol=0.01)
    spread = [float(x.std()) for x in levels]
    assert spread == sorted(spread, reverse=True) and spread[0] > 3 * spread[-1]


def test_derivatives_are_finite_and_true():
    @jax.jit
    def total(color, direction, roughness, coefficients):
        materials = Materials(color, roughness, 0.3)
        lights = DistantLights(direction[None], jnp.ones((1, 3)))
        return relight(NORMALS, materials, lights, coefficients).mean()

    color, direction = jnp.array([0.5, 0.4, 0.3]), jnp.array([0.3, 0.4, 0.8])
    given = (color, direction, jnp.float32(0.5), jnp.ones((9, 3)) * 0.1)
    gradients = jax.grad(total, (0, 1, 2, 3))(*given)
    for index, gradient in enumerate(gradients):
        assert np.isfinite(gradient).all()
        step = 1e-2 * jnp.ones_like(given[index])
        ends = [
            total(*given[:index], given[index] + sign * step, *given[index + 1 :])
            for sign in (1, -1)
        ]
        slope = float(ends[0] - ends[1]) / 2
        expected = float((gradient * step).sum())
        assert slope == pytest.approx(expected, rel=0.02, abs=1e-5)


def test_materials_without_a_surface_have_no_say_in_derivatives():
    inside = jnp.any(NORMALS != 0, -1)
    color = jnp.where(inside[..., None], jnp.float32([0.5, 0.4, 0.3]), jnp.nan)
    rough = jnp.where(inside, 0.5, jnp.nan)

    def total(direction, harmonics):
        lights = DistantLights(direction[None], jnp.ones((1, 3)))
        return relight(NORMALS, Materials(color, rough), lights, harmonics).sum()

    given = jnp.array([0.3, 0.4, 0.8]), 0.1 * jnp.ones((9, 3))
    for gradient in jax.grad(total, (0, 1))(*given):
        assert np.isfinite(gradient).all() and (gradient != 0).any()


def test_directions_of_lights_may_have_any_length():
    expected = relight(NORMALS, WHITE, lamp([0.3, 0.4, 0.8]))
    for length in (1e-25, 1e-8, 1e25):
        found = relight(NORMALS, WHITE, lamp(length * np.float64([0.3, 0.4, 0.8])))
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_lamps_inside_shard_map():
    kind = jax.sharding.AxisType.Auto
    mesh = jax.make_mesh((1,), ("lamps",), axis_types=(kind,))
    split = jax.sharding.PartitionSpec("lamps")

    @jax.shard_map(mesh=mesh, in_specs=split, out_specs=split)
    def one_by_one(directions):
        colors = jnp.ones((1, 3))
        return relight(NORMALS, WHITE, DistantLights(directions, colors))[None]

    expected = relight(NORMALS, WHITE, lamp([0.3, 0.4, 0.8], (1, 1, 1)))
    found = one_by_one(jnp.array([[0.3, 0.4, 0.8]]))
    np.testing.assert_allclose(found[0], expected, atol=1e-6)


@pytest.mark.parametrize("focal", [None, 30.0, np.float64(30)])
@pytest.mark.parametrize("around", [None, (9, 3), (4, 8, 3)])
def test_types_do_not_grow_with_wide_numbers(focal, around):
    lights = DistantLights(np.float32([[0, 0, 1]]), np.ones((1, 3), np.float32))
    environment = None if around is None else np.ones(around, np.float32)
    with jax.enable_x64(True):
        run = functools.partial(relight, focal=focal)
        found = jax.eval_shape(run, NORMALS, WHITE, lights, environment)
    assert found.dtype == jnp.float32


def test_vmap_is_a_loop():
    lights = jax.random.normal(jax.random.key(2), (3, 1, 3)) + jnp.array([0, 0, 2.0])
    colors = jnp.ones((1, 3))
    show = jax.jit(
        jax.vmap(lambda d: relight(NORMALS, GLOSSY, DistantLights(d, colors)))
    )
    looped = [relight(NORMALS, GLOSSY, DistantLights(d, colors)) for d in lights]
    np.testing.assert_allclose(show(lights), jnp.stack(looped), atol=3e-6)


def test_perspective_moves_highlights_alone():
    lights = lamp((0.2, 0.3, 1.0))
    flat, near = (relight(NORMALS, WHITE, lights, focal=f) for f in (None, 30.0))
    np.testing.assert_allclose(flat, near, atol=1e-6)
    flat, near = (relight(NORMALS, GLOSSY, lights, focal=f) for f in (None, 30.0))
    assert np.abs(flat - near).max() > 0.05
    # A plane is seen to mirror a lamp at the upper right from there.
    plane = np.broadcast_to(np.float32([0, 0, 1]), (24, 30, 3))
    image = relight(plane, GLOSSY, lights, focal=30.0)[..., 0]
    brightest = np.unravel_index(image.argmax(), image.shape)
    np.testing.assert_allclose(brightest, [11.5 - 9, 14.5 + 6], atol=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"normals": NORMALS[0]}, r"normals: expected \[H, W, 3\], got \(24, 3\)"),
        ({"materials": Materials(jnp.ones((2, 3)))}, "base_color: expected"),
        ({"materials": Materials(jnp.ones(3), jnp.ones(3))}, "roughness: expected"),
        ({"lights": lamp(np.ones(4))}, r"directions: expected \[L, 3\]"),
        ({"environment": jnp.ones((5, 3))}, "environment: expected"),
    ],
)
def test_shapes_that_do_not_fit_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        relight(**{"normals": NORMALS, "materials": WHITE, **arguments})
