import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_objects import look, make_shape

from unips_jax.scenes import SceneConfig, render_batch, shading
from unips_jax.scenes.backdrop import (
    Backdrop,
    above,
    draw_backdrop,
    open_sky,
    ray_clearance,
)
from unips_jax.scenes.draws import Draws

TABLE = np.float32([0, 0.8, 0.6])  # seen from 37 degrees above it


@pytest.fixture(scope="module")
def backdrop():
    return Backdrop(
        present=jnp.bool_(True),
        normals=jnp.stack([jnp.asarray(TABLE), jnp.asarray([0.0, 0.0, 1.0])]),
        offsets=jnp.asarray([0.4, 2.0]),
        waves=jnp.ones((2, 3)),
        slopes=jnp.zeros(2),
    )


@pytest.fixture(scope="module")
def scene(backdrop):
    """A ball of radius 0.4 on the table, before a wall."""
    ball = make_shape([(np.zeros(3), 0.4)])
    return look(ball, size=64, half=1.5, backdrop=backdrop)


def test_everything_has_a_normal(scene):
    assert np.all(scene.mask)
    length = np.linalg.norm(scene.normals, axis=-1)
    np.testing.assert_allclose(length, 1, atol=1e-5)
    ball = ~np.asarray(scene.ground)
    radius = 0.4 * 64 / 3
    assert abs(np.sqrt(ball.sum() / np.pi) - radius) < 0.6


def test_the_ground_is_table_and_wall(scene):
    ground = np.asarray(scene.ground)
    table = ground & (np.asarray(scene.normals) @ TABLE > 0.999)
    wall = ground & ~table
    points = np.asarray(scene.positions)
    np.testing.assert_allclose(points[table] @ TABLE, -0.4, atol=1e-4)
    np.testing.assert_allclose(points[wall, 2], -2.0, atol=1e-4)
    np.testing.assert_allclose(scene.normals[wall] @ np.float32([0, 0, 1]), 1)
    # They meet where both planes do: 0.8 y - 1.2 = -0.4.
    rows = np.nonzero(wall.any(1))[0]
    assert abs(rows.max() - (1 - 1.0 / 1.5) * 32) < 1.5
    assert table[40:].sum() > 1000


def test_the_ball_throws_its_shadow_on_the_table(scene):
    light = np.float32([0.6, 0.64, 0.48])
    clear = shading.key_clearance(scene, jnp.asarray(light), jnp.float32(0.0))
    clear = np.asarray(clear).reshape(64, 64)
    points, ground = np.asarray(scene.positions), np.asarray(scene.ground)
    # How far the ray to the light passes from the ball's centre.
    t = -points @ light
    away = np.linalg.norm(points + t[..., None] * light, axis=-1)
    shadow = ground & (away < 0.32) & (t > 0)
    lit = ground & ((away > 0.48) | (t < 0))
    assert shadow.sum() > 30 and lit.sum() > 2000
    assert np.mean(clear[shadow] < 0) > 0.95
    assert np.mean(clear[lit] > 0) > 0.95


def test_no_light_comes_from_below_the_table(scene, backdrop):
    below = -jnp.asarray(TABLE)
    clear = shading.key_clearance(scene, below, jnp.float32(0.0))
    assert np.asarray(clear).max() <= -0.4
    open_ = np.asarray(open_sky(backdrop, jnp.stack([below, -below])))
    np.testing.assert_array_equal(open_, [0, 1])
    directions = np.asarray(scene.directions)
    hidden = directions @ TABLE < -0.5
    assert hidden.sum() >= 2
    assert np.asarray(scene.visibility)[hidden].max() == 0


def test_near_lights_before_a_plane_are_seen(backdrop):
    origin = tuple(jnp.zeros(1) for _ in range(3))
    down = tuple(jnp.full(1, -c) for c in TABLE)
    assert ray_clearance(backdrop, origin, down, jnp.float32(0.39)) == 1
    assert ray_clearance(backdrop, origin, down, jnp.float32(0.41)) == -0.5


def test_lights_are_mirrored_to_the_open_side(backdrop):
    vectors = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    found = np.asarray(above(backdrop, jnp.asarray(vectors)))
    open_ = (vectors @ TABLE > 0) & (vectors[:, 2] > 0)
    assert 5 < open_.sum() < 45
    np.testing.assert_array_equal(found[open_], vectors[open_])
    assert found[:, 2].min() >= 0
    length = np.linalg.norm(vectors, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), length, rtol=1e-5)
    absent = backdrop._replace(present=jnp.bool_(False))
    np.testing.assert_array_equal(above(absent, jnp.asarray(vectors)), vectors)


def test_drawn_backdrops_are_seen_from_the_front():
    draw = jax.jit(
        jax.vmap(lambda key: draw_backdrop(Draws(key, 32), 0.5, jnp.bool_(True)))
    )
    drawn = draw(jax.random.split(jax.random.key(0), 200))
    assert 70 < drawn.present.sum() < 130
    np.testing.assert_allclose(jnp.linalg.norm(drawn.normals, axis=-1), 1, atol=1e-5)
    assert drawn.normals[..., 2].min() > 0.2
    table = np.asarray(drawn.offsets[:, 0] < 10)
    assert np.all(table <= np.asarray(drawn.present))
    assert 0.45 < table.sum() / drawn.present.sum() < 0.85


@pytest.mark.slow
def test_scenes_of_the_whole_frame_are_masked_everywhere():
    config = SceneConfig(
        **dict(rotation_candidates=2, num_directions=8, whole_frame_rate=0.5),
        **dict(rim_rate=0.5, shape_weights=(1, 1, 1, 1, 1, 0, 0)),
    )
    keys = jax.random.split(jax.random.key(2), 16)
    scenes = render_batch(keys, size=32, num_images=2, config=config)
    for leaf in jax.tree.leaves(scenes):
        assert np.all(np.isfinite(leaf))
    whole = np.asarray(scenes.mask).all((1, 2))
    assert 3 <= whole.sum() <= 13
    length = np.linalg.norm(scenes.normals, axis=-1)
    np.testing.assert_allclose(length[np.asarray(scenes.mask)], 1, atol=1e-5)
