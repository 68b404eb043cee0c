"""Meshes as grids of signed distances, and scenes of them."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_objects import CONFIG, make_shape

from unips_jax.errors import InputError
from unips_jax.metrics import angular_error_deg
from unips_jax.scenes import SceneConfig, load_meshes, render_batch
from unips_jax.scenes import render as scenes_render
from unips_jax.scenes.draws import Draws
from unips_jax.scenes.geometry import finish_geometry, render_geometry
from unips_jax.scenes.meshes import grid_distance
from unips_jax.scenes.shapes import as_mesh
from unips_jax.scenes.tracing import Camera

TOOLS = Path(__file__).resolve().parents[2] / "tools"
BALL = 0.7


@pytest.fixture(scope="module")
def tool():
    pytest.importorskip("trimesh")
    with pytest.MonkeyPatch.context() as patched:
        patched.syspath_prepend(TOOLS)
        import mesh_grids
    return mesh_grids


def ball_grid(size=48):
    axis = np.linspace(-1, 1, size)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    return (np.sqrt(x * x + y * y + z * z) - BALL).astype(np.float16)


def test_distances_between_nodes_and_beyond_the_cube():
    grid = jnp.asarray(np.arange(27.0).reshape(3, 3, 3))
    point = tuple(jnp.asarray(c) for c in ([-1.0, 0.5, 3], [0.5, 0, 0], [-0.5, 0, 0]))
    # 9 per step along x, 3 along y, 1 along z; 2 beyond the cube.
    np.testing.assert_allclose(grid_distance(grid, point), [5.0, 17.5, 24.0], rtol=1e-6)


@functools.partial(jax.jit, static_argnames="rate")
def seen(grids, rate):
    shape = as_mesh(Draws(jax.random.key(4), 8), make_shape(), grids, rate)
    shape = shape._replace(stretch=jnp.asarray([-1.0, 1, 0.8]))
    camera = Camera(jnp.float32(0), jnp.float32(1e4), jnp.asarray([0.0, 0, 0.75]))
    options = {"size": 64, "config": CONFIG}
    return finish_geometry(jax.random.key(0), shape, jnp.eye(3), camera, **options)


def test_a_ball_in_a_grid_has_the_normals_of_an_ellipsoid():
    found = seen(jnp.asarray(ball_grid())[None], 1.0)
    points = np.asarray(found.positions)
    true = points / np.array([1, 1, 0.64])
    true /= np.linalg.norm(true, axis=-1, keepdims=True) + 1e-9
    mask = np.asarray(found.mask)
    radius = 64 / 1.5 * BALL
    assert abs(np.sqrt(mask.sum() / np.pi) - radius) < 0.5
    level = np.linalg.norm(points / np.array([1, 1, 0.8]), axis=-1)[mask]
    np.testing.assert_allclose(level, BALL, atol=4e-3)
    inside = mask & (np.hypot(*np.moveaxis(points[..., :2], -1, 0)) < 0.9 * BALL)
    error = np.asarray(angular_error_deg(found.normals, jnp.asarray(true)))[inside]
    assert error.mean() < 0.5 and error.max() < 2.5
    # No steps between cells: neighbours differ as little as on the true surface.
    steps = np.linalg.norm(
        np.diff(np.asarray(found.normals)[32, 20:44], axis=0), axis=1
    )
    assert steps.max() < 1.5 * steps.mean()


def test_grids_of_meshes_and_of_open_ones(tool, monkeypatch):
    import trimesh

    monkeypatch.setattr(tool, "_SAMPLES", 30_000)

    whole = trimesh.creation.icosphere(3, radius=3.0)
    whole.apply_translation([5, 0, 0])
    size = 40
    grid = tool.grid_of(tool.normalized(whole), size)
    axis = np.linspace(-1, 1, size)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    wall = 0.7 * 2 / (size - 1)
    true = np.sqrt(x * x + y * y + z * z) - tool.RADIUS - wall
    near = np.abs(true) < 0.1
    off = np.abs(grid - true)[near]
    assert off.mean() < 4e-3 and off.max() < 8e-3
    assert grid[20, 20, 20] < -0.8
    half = whole.copy()
    half.update_faces(half.triangles_center[:, 2] > 0)
    half.invert()
    bowl = tool.grid_of(tool.normalized(half), size)
    assert bowl[20, 20, 5] > 0.3  # open: nothing is enclosed
    assert 0.005 < np.mean(bowl < 0) < 0.2


def test_a_batch_has_its_share_of_meshes(tmp_path, monkeypatch):
    path = tmp_path / "shapes.npz"
    np.savez(path, distance=ball_grid(16)[None], names=["ball"])
    config = SceneConfig(mesh_rate=0.3, mesh_file=str(path))
    assert load_meshes(config).shape == (1, 16, 16, 16)
    assert load_meshes(SceneConfig()) is None

    def rate(key, *, config, **_):
        return {"rate": jnp.float32(config.mesh_rate), "key": jax.random.key_data(key)}

    monkeypatch.setattr(scenes_render, "render_scene", rate)
    keys = jax.random.split(jax.random.key(5), 4)
    found = render_batch(keys, size=20, num_images=1, config=config)
    assert np.asarray(found["rate"]).tolist() == [1, 0, 0, 0]
    np.testing.assert_array_equal(found["key"], jax.random.key_data(keys))
    found = render_batch(keys[:1], size=20, num_images=1, config=config)
    assert found["rate"] == np.float32([0.3])


def test_a_scene_wants_its_meshes():
    config = SceneConfig(mesh_rate=0.3, mesh_file="shapes.npz")
    with pytest.raises(ValueError, match="expected meshes=load_meshes"):
        jax.eval_shape(
            functools.partial(render_geometry, size=16, config=config),
            jax.random.key(0),
        )


def test_files_that_are_no_meshes_are_named(tmp_path):
    with pytest.raises(ValueError, match="mesh_file: expected a file of meshes"):
        SceneConfig(mesh_rate=0.5)
    path = tmp_path / "none.npz"
    config = SceneConfig(mesh_rate=0.5, mesh_file=str(path))
    with pytest.raises(InputError, match="none.npz': expected a file by"):
        load_meshes(config)
    np.savez(path, distance=np.zeros((2, 3, 4, 5)))
    with pytest.raises(InputError, match=r"expected \[M, G, G, G\] distances, got"):
        load_meshes(config)
