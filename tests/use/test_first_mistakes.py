"""What newcomers do first, and the answers."""

import jax.numpy as jnp
import numpy as np
import pytest
from plain_objects import hemisphere
from small_networks import SHALLOW_OURS, lively_network

import unips_jax
from unips_jax.cli import main as cli
from unips_jax.io.color import srgb_encode
from unips_jax.lighting.relight import Materials, relight
from unips_jax.surface.outputs import focal_of
from unips_jax.training import write_folder

NORMALS, MASK, _ = hemisphere(40)


def test_millimetres_are_not_pixels():
    """Depth would be nonsense, of a lens that sees nearly all."""
    with pytest.raises(
        unips_jax.InputError, match=r"sees 137 degrees .* mm / 36 \* 256"
    ):
        focal_of("50", None, None, (200, 256))
    assert focal_of("70", None, None, (200, 256)) == 70
    assert focal_of("exif", 9.0, "a.jpg", (200, 256)) == 9.0


def test_arrays_of_8_bits_are_srgb_as_files_are():
    lights = np.array(
        [[0.5, 0.2, 0.8], [-0.6, 0.1, 0.7], [0, 0.7, 0.6], [0.1, -0.5, 1]]
    )
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    linear = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, lights), 0)[..., None]
    linear = np.repeat(linear, 3, -1).astype(np.float32)
    stored = np.rint(255 * srgb_encode(linear)).astype(np.uint8)
    found = unips_jax.estimate_lights(stored, NORMALS, MASK)
    assert np.einsum("nk,nk->n", found.directions, lights).min() > 0.9999
    again = unips_jax.estimate_lights(linear, NORMALS, MASK)
    np.testing.assert_allclose(again.directions, found.directions, atol=0.02)
    network = lively_network(SHALLOW_OURS)
    usual, stated = (
        unips_jax.estimate_photographs(network, stored, MASK, **options)
        for options in ({}, {"transfer": "srgb"})
    )
    np.testing.assert_array_equal(usual, stated)


@pytest.mark.parametrize(
    ("images", "said"),
    [
        (np.full((1, 8, 8, 3), 200.0), "got values up to 200; divide all"),
        (np.full((1, 8, 8, 3), 200, np.uint8), "linear floats in .0, 1., got uint8"),
    ],
)
def test_photographs_that_are_not_linear_are_not_written(tmp_path, images, said):
    mask, normals = np.ones((8, 8), bool), np.zeros((8, 8, 3)) + [0, 0, 1]
    with pytest.raises(ValueError, match=said):
        write_folder(tmp_path / "a.data", images, mask, normals, {})
    assert not (tmp_path / "a.data").exists()


def test_a_folder_of_results_is_not_those_of_an_object(tmp_path, capsys):
    (tmp_path / "out" / "cup").mkdir(parents=True)
    (tmp_path / "out" / "cup" / "normals.json").write_text("{}")
    (tmp_path / "cup").mkdir()
    (tmp_path / "cup" / "1.jpg").touch()
    to = ["-o", str(tmp_path / "new")]
    for command in (["view"], ["surface", *to], ["relight", *to]):
        name, *rest = command
        assert cli.main([name, str(tmp_path / "out"), *rest]) == 2
        said = capsys.readouterr().err
        assert f"it holds those of 1: give {tmp_path / 'out' / 'cup'}" in said
        assert cli.main([name, str(tmp_path / "cup"), *rest]) == 2
        assert "`unips estimate" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("shape", "hint"),
    [
        ((1, 4, 8, 8, 3), "one object at a time"),
        ((4, 3, 8, 8), r"transpose\(0, 2, 3, 1\)"),
        ((4, 8, 8, 4), r"images\[..., :3\]"),
        ((8, 8, 3), r"images\[None\]"),
        ((4, 8, 8), "grey images"),
    ],
)
def test_images_of_another_shape_have_a_hint(shape, hint):
    network = unips_jax.UniversalNetwork(SHALLOW_OURS, {})
    with pytest.raises(ValueError, match=hint):
        unips_jax.estimate_normals(network, jnp.zeros(shape))


def test_normal_maps_of_integers_are_no_normals(tmp_path):
    stored = np.rint(255 * (NORMALS + 1) / 2).astype(np.uint8)
    with pytest.raises(ValueError, match="read_normals decodes a normal map"):
        unips_jax.write_normals(tmp_path, stored)
    with pytest.raises(ValueError, match=r"got float64 of \(3, 40, 40\)"):
        unips_jax.write_normals(tmp_path, NORMALS.transpose(2, 0, 1).astype(float))
    with pytest.raises(ValueError, match=r"normal_map: expected one of \('opengl', "):
        unips_jax.write_normals(tmp_path, NORMALS, normal_map="unity")
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="read_normals decodes a normal map"):
        relight(stored, Materials(0.5))
    with pytest.raises(ValueError, match=r"predicted: expected vectors .* got uint8"):
        unips_jax.mean_angular_error_deg(stored, NORMALS, MASK)
    with pytest.raises(ValueError, match=r"mask: .* \(40, 40\), got \(2, 40\)"):
        unips_jax.mean_angular_error_deg(NORMALS, NORMALS, MASK[:2])
    with pytest.raises(ValueError, match=r"true: expected vectors .*\(40, 40, 2\)"):
        unips_jax.angular_error_deg(NORMALS, NORMALS[..., :2])


def test_read_normals_takes_the_array_that_the_questions_name(tmp_path):
    unips_jax.write_normals(tmp_path, NORMALS)
    found = unips_jax.read_normals(tmp_path / "normals.npy")
    np.testing.assert_array_equal(found, NORMALS.astype(np.float32))
    np.save(tmp_path / "other.npy", np.zeros((4, 4)))
    with pytest.raises(unips_jax.InputError, match=r"floats \[H, W, 3\], got float64"):
        unips_jax.read_normals(tmp_path / "other.npy")


def test_the_mean_error_is_that_inside_the_mask():
    assert float(unips_jax.angular_error_deg(NORMALS, NORMALS).mean()) > 30
    assert float(unips_jax.mean_angular_error_deg(NORMALS, NORMALS, MASK)) < 1e-3


def test_where_all_folders_fail_no_others_are_named(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    given = [str(tmp_path / "a"), str(tmp_path / "b"), "-o", str(tmp_path / "out")]
    assert cli.main(["estimate", *given]) == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("error: 2 of 2 folders") and "the others" not in last
