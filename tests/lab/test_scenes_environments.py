import jax
import jax.numpy as jnp
import numpy as np
import pytest

from unips_jax.scenes import lamps, surroundings
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.environments import (
    BLURS,
    FLUX,
    TABLE_SIZE,
    Photograph,
    directions_of,
    load_tables,
    look_up,
)


def photograph(number, *, mirror=1.0, tint=(1.0, 1.0, 1.0)):
    ones = jnp.ones(())
    return Photograph(jnp.int32(number), ones, mirror * ones, jnp.asarray(tint))


def test_environments_have_the_same_flux():
    tables = load_tables()
    assert tables.radiance.shape == (16, len(BLURS), *TABLE_SIZE, 3)
    assert tables.radiance.min() >= 0
    _, solid = directions_of(*TABLE_SIZE)
    assert solid.sum() == pytest.approx(4 * np.pi, rel=1e-3)
    flux = np.sum(tables.radiance.mean(-1) * solid, (2, 3))
    total = flux + tables.sun_colors.mean(-1)[:, None]
    np.testing.assert_allclose(total, FLUX, rtol=0.03)
    np.testing.assert_allclose(np.linalg.norm(tables.sun_directions, axis=-1), 1, 1e-5)
    suns = tables.sun_colors.mean(-1) > 0
    assert 3 <= suns.sum() <= 9 and np.all(tables.sun_directions[suns, 1] > 0)


@pytest.mark.parametrize("level", range(len(BLURS)))
def test_pixels_are_found_by_their_directions(level):
    towards, _ = directions_of(*TABLE_SIZE)
    point = tuple(jnp.asarray(c, jnp.float32) for c in np.moveaxis(towards, -1, 0))
    table = load_tables().radiance[7, level]
    found = np.stack(look_up(photograph(7), point, jnp.float32(BLURS[level])), -1)
    np.testing.assert_allclose(found, table, atol=2e-3 * table.max())
    swapped = (-point[0], *point[1:])
    found = look_up(photograph(7, mirror=-1.0), swapped, jnp.float32(BLURS[level]))
    np.testing.assert_allclose(np.stack(found, -1), table, atol=2e-3 * table.max())


def test_it_closes_around_and_is_tinted():
    angle = np.linspace(-0.2, 0.2, 81)
    point = (jnp.cos(angle), jnp.full(81, 0.2), jnp.sin(angle))
    found = np.stack(look_up(photograph(3), point, jnp.float32(0.1)), -1)
    assert np.abs(np.diff(found, axis=0)).max() < 0.15 * found.max()
    tinted = look_up(photograph(3, tint=(2.0, 1.0, 0.5)), point, jnp.float32(0.1))
    np.testing.assert_allclose(np.stack(tinted, -1), found * [2, 1, 0.5], rtol=1e-5)


def _drawn(seed, rate, kind):
    key = jax.random.key(seed)
    photographs = (Draws(jax.random.fold_in(key, 2), 8), rate)
    return lamps.draw_lights(
        Draws(key, 400), jnp.int32(kind), 6, photographs=photographs
    )


def test_the_sun_is_the_key_light_or_a_lobe():
    sky, mixed = (
        jax.jit(lambda seed, kind=kind: _drawn(seed, 1.0, kind)) for kind in (1, 2)
    )
    tables, suns = load_tables(), 0
    for seed in range(12):
        keys, environment = sky(seed)
        picture = environment.photograph
        expected = tables.sun_colors[picture.number] * picture.tint * picture.share
        expected = environment.scale[:, None] * expected
        np.testing.assert_allclose(keys.color, expected, rtol=1e-4, atol=1e-6)
        assert environment.color[0].max() == 0
        # It stands where the picture has it, however that is turned and mirrored.
        found = np.einsum("nij,nj->ni", environment.rotation, keys.vector)
        place = tables.sun_directions[picture.number] * [picture.mirror, 1, 1]
        np.testing.assert_allclose(found, [place] * 6, atol=1e-5)
        _, environment = mixed(seed)
        flux = environment.color[0] * 4 * np.prod(environment.half[0])
        expected = tables.sun_colors[picture.number] * picture.tint * picture.share
        np.testing.assert_allclose(flux, expected, rtol=1e-4, atol=1e-6)
        suns += bool(flux.max() > 0)
    assert 1 <= suns <= 10


def test_without_photographs_lights_are_as_ever():
    keys, environment = _drawn(3, 0.0, 1)
    plain_keys, plain = lamps.draw_lights(
        Draws(jax.random.key(3), 400), jnp.int32(1), 6
    )
    direction = tuple(jnp.asarray([[0.6, 0.0], [0.0, 1.0], [0.8, 0.0]]))
    seen, expected = (
        surroundings.environment_radiance(e, e.rotation[0], direction, jnp.float32(0.2))
        for e in (environment, plain)
    )
    np.testing.assert_allclose(seen, expected, rtol=1e-6)
    np.testing.assert_array_equal(keys.color, plain_keys.color)
    np.testing.assert_array_equal(keys.vector, plain_keys.vector)
    # The sun turns with its sky, where it is always above.
    found = np.einsum("nij,nj->ni", plain.rotation, keys.vector)
    np.testing.assert_allclose(found, [found[0]] * 6, atol=1e-5)
    assert found[0, 1] > 0
