"""`relight`, and `unips relight`."""

import functools
import json
import os
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plain_objects import hemisphere

from unips_jax import DistantLights, Materials, estimate_lights, relight
from unips_jax.cli.relight import main
from unips_jax.io.color import as_linear
from unips_jax.io.door import NotWritten
from unips_jax.io.images import read_image
from unips_jax.lighting.environment import blurred, glossy_light, sphere, turned
from unips_jax.lighting.harmonics import BAND, COSINE_LOBE, harmonics
from unips_jax.lighting.light_files import write_lights
from unips_jax.lighting.reflectance import ggx
from unips_jax.pictures.animation import write_animation

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


@pytest.fixture
def result(tmp_path):
    folder = tmp_path / "thing"
    folder.mkdir()
    np.save(folder / "normals.npy", NORMALS)
    return folder


def test_command_writes_a_picture_and_a_turning_one(result, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [str(result), "-o", str(out), "--light", "1", "0", "0.5"]
    for kind in ("gif", "webp", "mp4"):
        assert main([*arguments, "--turn", kind, "--frames", "4"]) == 0
        image = cv2.imread(str(out / "relit.png"))
        assert image[12, 20].min() > 2 * image[12, 4].max()  # lit from the right
        record = json.loads((out / "relight.json").read_text())
        assert record["files"] == ["relit.exr", "relit.png", f"turning.{kind}"]
        frames = read_frames(out / f"turning.{kind}")
        assert len(frames) == 4
        # Counter-clockwise: right, up, left, down.
        for frame, (row, column) in zip(
            frames, ((12, 20), (3, 12), (12, 3), (20, 12)), strict=True
        ):
            assert frame[row, column].mean() > frame[23 - row, 23 - column].mean() + 40
    assert "grey, none given" in capsys.readouterr().out


def test_an_mp4_at_a_path_that_opencv_cannot_take(tmp_path):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    frames = [np.zeros((8, 8, 3), np.uint8)] * 2
    with pytest.raises(NotWritten, match="into a path in UTF-8 only; take gif or"):
        write_animation(folder / "turning.mp4", frames, fps=25)
    assert list(folder.iterdir()) == []


def read_frames(path):
    if path.suffix == ".mp4":
        video, frames = cv2.VideoCapture(str(path)), []
        while (read := video.read())[0]:
            frames.append(read[1])
        return frames
    from PIL import Image, ImageSequence

    with Image.open(path) as image:
        return [
            np.asarray(f.convert("RGB")).astype(int)
            for f in ImageSequence.Iterator(image)
        ]


def test_command_takes_an_environment_and_a_colour(result, tmp_path):
    around = np.zeros((16, 32, 3), np.float32)
    around[:, 24] = 5  # right
    cv2.imwrite(str(tmp_path / "around.hdr"), around)
    red = np.zeros((24, 24, 3), np.uint8)
    red[..., 2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), red)
    given = ["--environment", str(tmp_path / "around.hdr"), "--base-color"]
    out = ["-o", str(tmp_path / "out")]
    assert main([str(result), *out, *given, str(tmp_path / "red.png")]) == 0
    image = cv2.imread(str(tmp_path / "out" / "relit.png")).astype(int)
    assert image[12, 20, 2] > image[12, 4, 2] + 50
    assert image[12, 20, 2] > image[12, 20, 0] + 50
    # Turned by half a circle the light comes from the left.
    given = [*given[:2], "--yaw", "180"]
    assert main([str(result), *out, *given]) == 0
    image = cv2.imread(str(tmp_path / "out" / "relit.png")).astype(int)
    assert image[12, 4, 2] > image[12, 20, 2] + 50
    # What is behind comes to the left, counter-clockwise as seen from above.
    around[:], around[:, 16] = 0, 5
    cv2.imwrite(str(tmp_path / "around.hdr"), around)
    given, levels = [*given[:3], "90"], []
    for stops in ("0", "-1"):
        assert main([str(result), *out, *given, "--exposure", stops]) == 0
        linear = read_image(tmp_path / "out" / "relit.exr")
        picture = as_linear(read_image(tmp_path / "out" / "relit.png"), "srgb")
        np.testing.assert_allclose(picture, np.clip(linear, 0, 1), atol=0.006)
        assert linear[12, 4, 1] > 2 * linear[12, 20, 1]
        levels.append(linear)
    np.testing.assert_allclose(levels[1], levels[0] / 2, rtol=1e-4, atol=1e-6)


def test_command_takes_the_lights_of_photographs(result, tmp_path):
    """As the photographs of another object were lit, one picture for each."""
    directions = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8]])
    images = np.maximum(np.einsum("hwk,nk->nhw", NORMALS, directions), 0)
    images = np.repeat(images[..., None], 3, -1).astype(np.float32)
    images[1] *= 0.5
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    lights = estimate_lights(images, NORMALS, MASK, guesses=directions)
    write_lights(earlier, ["a.png", "b.png"], lights)
    given = [str(result), "-o", str(tmp_path / "out"), "--roughness", "1"]
    for source, share in ((earlier, 0.5), (earlier / "lights.lp", 1)):
        assert main([*given, "--lights-from", str(source)]) == 0
        first, second = (
            as_linear(read_image(tmp_path / "out" / name), "srgb")[..., 0]
            for name in ("relit.png", "relit-01.png")
        )
        assert first[12, 19] > 2 * first[12, 4]
        np.testing.assert_allclose(
            second[:, ::-1][MASK], share * first[MASK], atol=0.05
        )
        record = json.loads((tmp_path / "out" / "relight.json").read_text())
        assert record["files"] == ["relit-01.png", "relit.exr", "relit.png"]
        assert record["lights_from"] == str(source) and record["light"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--light", "0", "0", "0"], "--light: expected a direction, not 0"),
        (["--lights-from", "thing"], "expected a result with lights.json"),
        (
            ["--light", "1", "0", "1", "--lights-from", "thing"],
            "--light: expected one kind of light, got --lights-from too",
        ),
        (["--lights-from", "thing", "--turn", "gif"], "--turn: expected a light that"),
        (["--roughness", "2"], "--roughness: expected 0.03 to 1.0, got 2.0"),
        (["--environment", "absent.hdr"], "absent.hdr: "),
        (["--base-color", "small.png"], "expected the normals' size, 24 x 24"),
        (["--yaw", "90"], "--yaw: expected something to use it for, got none"),
        (["--fps", "12"], "--fps: expected something to use it for, got none; add --t"),
        (["--lights-from", "empty.lp"], "empty.lp: expected lights, one a line"),
        (["--lights-from", "zero.lp"], "zero.lp: expected lights, one a line"),
    ],
)
def test_bad_options_are_one_line(options, message, result, capsys, monkeypatch):
    monkeypatch.chdir(result.parent)
    cv2.imwrite("small.png", np.full((4, 5), 255, np.uint8))
    Path("empty.lp").write_text("")
    Path("zero.lp").write_text("0\n")
    assert main(["thing", "-o", "out", *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (result.parent / "out").exists()
