"""The doctor for normal maps: honest ones pass in silence, odd ones are put right."""

import json

import cv2
import numpy as np
import pytest
from plain_objects import blob, hemisphere

from unips_jax.cli.check import main as check
from unips_jax.cli.relight import main as relight
from unips_jax.cli.surface import main as surface
from unips_jax.errors import InputError
from unips_jax.io.color import as_linear, srgb_encode
from unips_jax.io.images import encode_image, read_image
from unips_jax.io.normal_axes import integrability
from unips_jax.io.normal_maps import examine_normals, read_normal_map
from unips_jax.io.normals import turn_normals


def dome(size=96, bumps=0.0, seed=0):
    """A dome on nothing: `[H, W, 3]`, unit or 0; its mask; its height."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    distance = np.hypot(x, y) / (0.42 * size)
    mask = distance < 1
    z = 0.3 * size * np.cos(np.minimum(distance, 1) * 1.2)
    rough = np.random.default_rng(seed).standard_normal((size, size))
    z += bumps * 6 * cv2.GaussianBlur(rough, (0, 0), 3)
    down, right = np.gradient(z)
    normals = np.stack([-right, down, np.ones_like(z)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where(mask[..., None], normals, 0).astype(np.float32), mask, z


def encoded(normals, background=None, dtype=np.uint8):
    top = np.iinfo(dtype).max
    values = np.rint((normals + 1) / 2 * top).astype(dtype)
    if background is not None:
        values[~normals.any(-1)] = np.rint(np.multiply(background, top))
    return values


def degrees(found, normals):
    """Mean angle to the truth; the surfaces must be the same to 2 %."""
    there, mask = found.any(-1), normals.any(-1)
    assert (there ^ mask).sum() < 0.02 * mask.sum()
    cosine = (found * normals).sum(-1)[there & mask]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()


def honest():
    """Maps with nothing wrong, of many kinds."""
    for seed in range(6):
        yield dome(bumps=seed / 3, seed=seed)[0]
        mask, normals = blob(seed)
        yield (normals * mask[..., None]).astype(np.float32)
    sphere = hemisphere()[0]
    yield sphere
    yield sphere * np.float32([-1, -1, 1])  # a bowl
    yield np.where((np.indices((48, 48))[0] < 24)[..., None], sphere, 0)
    y, x = np.mgrid[:80, :90].astype(float)
    for z in (
        0.3 * x + 0.2 * y,  # a tilted plane
        0.33 * (y - x),  # all of whose normals have no number below 0
        0 * x,
        4 * np.floor(x / 20) + 5 * np.floor(y / 20),  # steps
        4 * np.cos(np.hypot(x - 40, y - 30) / 3),
        x * y / 100,
        5 * np.exp(-np.square(np.hypot(x - 45, y - 40) / 12)),  # a relief on a plane
        cv2.GaussianBlur(((x % 20 > 3) & (y % 20 > 3)).astype(float), (0, 0), 1) * 6,
    ):
        down, right = np.gradient(z)
        normals = np.stack([-right, down, np.ones_like(z)], -1)
        yield (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype("f4")


def jpeg(values, quality=92):
    data = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(data, cv2.IMREAD_COLOR)


def halved(values):
    size = values.shape[1] // 2, values.shape[0] // 2
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(
    "form",
    [
        lambda normals: normals,
        lambda normals: normals.astype(np.float64),
        encoded,
        lambda normals: encoded(normals, dtype=np.uint16),
        lambda normals: jpeg(encoded(normals)),
        lambda normals: halved(encoded(normals)),
        halved,
    ],
)
def test_honest_maps_raise_no_alarm(form):
    for index, normals in enumerate(honest()):
        found = examine_normals(form(normals))
        assert not found.doubts and not found.mended, index


def test_estimates_and_truth_by_others_raise_no_alarm(shared_dir):
    import scipy.io

    files = sorted((shared_dir / "diligent_dev" / "pmsData").glob("*/Normal_gt.mat"))
    if not files:
        pytest.skip(f"no DiLiGenT objects in {shared_dir}")
    for file in files:
        content = scipy.io.loadmat(file)
        normals = next(v for k, v in content.items() if not k.startswith("_"))
        for values in (normals, encoded(normals), encoded(normals, dtype=np.uint16)):
            found = examine_normals(values)
            assert not found.doubts and not found.mended, file
            assert found.integrability > 0.8


@pytest.mark.parametrize(
    "background", [(0, 0, 0), (1, 1, 1), (1, 0, 0), (0.25,) * 3, (0.75,) * 3]
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_backgrounds_of_any_colour_are_no_surface(background, dtype):
    normals, mask, _ = dome(bumps=1)
    found = examine_normals(encoded(normals, background, dtype))
    np.testing.assert_array_equal(found.normals.any(-1), mask)
    assert degrees(found.normals, normals) < 0.5
    assert "no surface there; --mask FILE" in found.mended[0] and not found.doubts


@pytest.mark.parametrize("background", [None, (0, 0, 0), (1, 1, 1), (1, 0, 0)])
@pytest.mark.parametrize("quality", [75, 92, 95])
def test_jpeg_moves_no_outline_and_leaves_no_cliffs(background, quality):
    for bumps in (0, 1):
        normals, mask, _ = dome(bumps=bumps)
        found = examine_normals(jpeg(encoded(normals, background), quality))
        there = found.normals.any(-1)
        assert (there ^ mask).sum() < 0.05 * mask.sum()
        steep = there & (found.normals[..., 2] < 0.2)  # the dome's least is 0.35
        assert steep.sum() <= 0.001 * mask.sum()
        assert bool(found.mended) == (background is not None) and not found.doubts


@pytest.mark.parametrize(
    "name", ["grey95.jpg", "black95.jpg", "black.png", "white.png"]
)
def test_depth_is_that_of_the_object_on_any_background(name, shared_dir, tmp_path):
    folder = shared_dir / "cases" / "normal_map_other_backgrounds"
    if not folder.is_dir():
        pytest.skip(f"no normal maps in {shared_dir}")
    truth = np.load(folder / "truth.npz")
    assert surface([str(folder / name), "-o", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "surface.json").read_text())
    expected = np.ptp(truth["z"][truth["inside"]])
    assert abs((record["far"] - record["near"]) / expected - 1) < 0.05


def test_a_flat_blue_background_is_doubted():
    normals, _, _ = dome()
    found = examine_normals(encoded(normals, (0.5, 0.5, 1)))
    assert "one plane: it counts as surface; --mask FILE" in found.doubts[0]


def test_what_is_transparent_is_no_surface():
    normals, mask, _ = dome()
    for background in ((0, 0, 0), (0.5, 0.5, 1)):
        alpha = np.uint8(255 * mask)
        found = examine_normals(encoded(normals, background), alpha=alpha)
        np.testing.assert_array_equal(found.normals.any(-1), mask)
        assert "are transparent" in found.mended[0]
    rim = mask & ~(cv2.erode(mask.astype(np.uint8), np.ones((3, 3))) > 0)
    for level in (126, 129):  # a soft edge
        alpha = np.where(rim, level, np.uint8(255 * mask)).astype(np.uint8)
        found = examine_normals(encoded(normals), alpha=alpha)
        expected = mask & ~rim if level < 127 else mask
        np.testing.assert_array_equal(found.normals.any(-1), expected)
    found = examine_normals(encoded(normals), alpha=np.zeros_like(alpha))
    np.testing.assert_array_equal(found.normals.any(-1), mask)  # no program set it
    assert not found.mended
    heights = np.linspace(0, 255, mask.size).reshape(mask.shape).astype(np.uint8)
    found = examine_normals(encoded(normals), alpha=heights)
    np.testing.assert_array_equal(found.normals.any(-1), mask)
    assert "alpha has many values" in found.doubts[0]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda n: (n + 1) / 2, "values lie between 0 and 1: read as (n + 1) / 2"),
        (lambda n: np.where(n.any(-1, keepdims=True), (n + 1) / 2, 0), "0 and 1"),
        (lambda n: np.rint((n + 1) * 127.5), "values lie between 0 and 255"),
        (lambda n: ((n + 1) / 2).astype(np.float16), "values lie between 0 and 1"),
        (
            lambda n: np.rint(255 * srgb_encode((n + 1) / 2)).astype(np.uint8),
            "as a display's values (sRGB)",
        ),
        (lambda n: srgb_encode((n + 1) / 2), "as a display's values (sRGB)"),
        (lambda n: as_linear((n + 1) / 2, "srgb"), "a display's curve taken from them"),
        (lambda n: np.where(n.any(-1, keepdims=True), n, np.nan), "are not finite"),
        (lambda n: n * np.float32([1, 1, -1]), "z points away from the viewer: turned"),
        (lambda n: n * np.float32([1, -1, -1]), "read as --normal-map opencv"),
        (lambda n: -n, "normals point into the surface"),
    ],
)
def test_what_is_certain_is_mended_and_reported(change, line):
    for bumps in (0, 1):
        normals = dome(bumps=bumps)[0]
        found = examine_normals(change(normals))
        assert degrees(found.normals, normals) < 1.5
        assert line in " ".join(found.mended) and not found.doubts


def test_floats_that_stand_for_others_may_be_0():
    """As those of a sphere's left side, stored as levels."""
    normals = hemisphere(200)[0]
    levels = np.floor((normals + 1) * 127.5)
    assert levels[normals.any(-1)].min() == 0
    found = examine_normals(levels)
    assert degrees(found.normals, normals) < 1.5
    assert "values lie between 0 and 255" in found.mended[0]


@pytest.mark.parametrize(
    ("signs", "line"),
    [
        ((1, 1, -1), "z points away from the viewer: turned"),
        ((1, -1, -1), "read as --normal-map opencv"),
        ((-1, -1, -1), "normals point into the surface"),
    ],
)
def test_the_outline_tells_where_slopes_do_not(signs, line):
    """Leaves, say, whose slopes fit together in no way."""
    normals, mask, _ = dome()
    noise = np.random.default_rng(0).normal(0, 0.25, (*mask.shape, 2))
    normals[..., :2] += mask[..., None] * noise
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    assert abs(integrability(normals)) < 0.2
    found = examine_normals(normals * np.float32(signs))
    assert degrees(found.normals, normals) < 0.1 and line in found.mended[0]


def test_what_faces_away_a_little_is_kept():
    """Wide lenses see it, at one side of an object."""
    angle = np.deg2rad(np.linspace(-70, 109, 90))  # of a pipe's normals
    turned = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    turned = np.broadcast_to(turned.astype(np.float32), (60, 90, 3))
    assert (turned[..., 2] < 0).mean() > 0.1
    found = examine_normals(turned)
    np.testing.assert_allclose(found.normals, turned, atol=1e-6)
    assert not found.mended and not found.doubts


@pytest.mark.parametrize("blue", [0, 255])
def test_a_missing_blue_channel_is_worked_out(blue):
    normals, mask, _ = dome(bumps=1)
    values = encoded(normals)
    values[..., 2] = blue
    values[40:42, 40:42, :2] = 255  # too long for any z
    found = examine_normals(values)
    assert not found.normals[40:42, 40:42].any()
    mask[40:42, 40:42] = False
    cosine = (found.normals * normals).sum(-1)[mask]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 1
    assert "the blue channel is constant" in found.mended[0]


def test_lengths_of_slopes_do_not_matter():
    """(-p, -q, 1), or any factor, are normals too."""
    normals, mask, _ = dome(bumps=1)
    slopes = normals / np.where(mask, normals[..., 2], 1)[..., None]
    for values in (slopes, 3 * normals, 1e20 * normals, 0.01 * normals):
        assert degrees(examine_normals(values).normals, normals) < 0.1


@pytest.mark.parametrize(
    ("convention", "first"), [("directx", "directx"), ("x-left", "x-left")]
)
def test_an_axis_that_is_the_other_way_is_doubted(convention, first):
    for seed in range(4):
        normals = dome(bumps=seed / 2, seed=seed)[0]
        turned = encoded(turn_normals(normals, convention))
        found = examine_normals(turned)
        assert found.integrability < -0.5
        assert f"try --normal-map {first} or" in found.doubts[0]
        found = examine_normals(turned, convention=convention)
        assert found.integrability > 0.5 and not found.doubts
        assert degrees(found.normals, normals) < 0.5


def test_integrability_has_the_sign_of_the_slopes_derivatives():
    """z = x y has dp/dy = dq/dx = 1, which varies for z = x^2 y + x y^2."""
    y, x = np.mgrid[40:0:-1, :50] / 50  # y is up
    z_x, z_y = 2 * x * y + y**2, x**2 + 2 * x * y
    normals = np.stack([-z_x, -z_y, np.ones_like(x)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    assert integrability(normals) > 0.99
    assert integrability(normals * [1, -1, 1]) < -0.99
    assert integrability(normals * [-1, 1, 1]) < -0.99
    assert integrability(normals * [-1, -1, 1]) > 0.99


def test_commands_use_the_doctor(tmp_path, capsys):
    normals, _, z = dome(bumps=1)
    path = tmp_path / "black.png"
    path.write_bytes(encode_image(".png", encoded(normals, (0, 0, 0))))
    out = tmp_path / "out"
    assert surface([str(path), "-o", str(out)]) == 0
    assert "no surface there" in capsys.readouterr().out
    record = json.loads((out / "surface.json").read_text())
    assert record["far"] - record["near"] < 1.2 * np.ptp(z)  # 11,560 for 51 before
    assert "no surface there" in record["mended"][0] and record["warnings"] == []
    path = tmp_path / "down.png"
    down = encoded(turn_normals(normals, "directx"))
    path.write_bytes(encode_image(".png", down))
    assert relight([str(path), "-o", str(tmp_path / "lit")]) == 0
    assert "warning: slopes do not fit" in capsys.readouterr().err
    assert check([str(path), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert "--normal-map directx" in found["findings"][0]
    assert check([str(path), "--normal-map", "directx"]) == 0
    assert "nothing found that is wrong" in capsys.readouterr().out
    assert surface([str(path), "-o", str(out), "--as-stored"]) == 0
    assert "warning" not in capsys.readouterr().err


def test_arrays_of_bytes_are_read_as_pictures(tmp_path):
    normals = dome()[0]
    np.save(tmp_path / "bytes.npy", encoded(normals))
    found = read_normal_map(tmp_path / "bytes.npy")
    assert degrees(found.normals, normals) < 0.5
    assert "the array holds uint8" in found.mended[0]


def test_a_folder_of_results_needs_no_convention(tmp_path):
    normals = dome(bumps=1)[0]
    np.save(tmp_path / "normals.npy", normals)
    found = read_normal_map(tmp_path, "directx")
    np.testing.assert_allclose(found.normals, normals, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_stands_for_zero_is_zero_as_stored_too(tmp_path, dtype):
    """Of unit length it would be a normal."""
    normals, mask, _ = dome()
    path = tmp_path / "n.png"
    path.write_bytes(encode_image(".png", encoded(normals, dtype=dtype)))
    for values in (encoded(normals, dtype=dtype), read_image(path)):
        assert (values[~mask] == np.iinfo(dtype).max // 2 + 1).all()
    found = read_normal_map(path, as_stored=True).normals
    np.testing.assert_array_equal(found.any(-1), mask)


@pytest.mark.parametrize(
    "write",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"PK\x03\x04" + bytes(60)),
        lambda path: path.write_bytes(b"\x93NUMPY\x01\x00\x76\x00{'descr': ("),
        lambda path: np.save(path, np.zeros((0, 0, 3))),
        lambda path: np.save(path, np.zeros((0, 5, 3))),
        lambda path: np.save(path, np.zeros((5, 5, 3))),
        lambda path: np.save(path, np.full((5, 5, 3), np.nan)),
        lambda path: np.save(path, np.array("text")),
        lambda path: np.save(path, np.ones((4, 4, 3), complex)),
        lambda path: path.mkdir(),
    ],
)
def test_files_that_hold_no_normals_are_one_line(write, tmp_path):
    path = tmp_path / "n.npy"
    write(path)
    with pytest.raises(InputError) as caught:
        read_normal_map(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_part_of_a_cone_is_no_encoding():
    """Its z is constant, and all of its numbers may be from 0 to 1."""
    y, x = np.mgrid[1:60, 1:60].astype("f4")
    angle, slope = np.arctan2(y, x), np.float32(0.6)
    flank = np.stack([slope * np.cos(angle), slope * np.sin(angle)], -1)
    normals = np.concatenate([flank, np.full((59, 59, 1), 0.8, "f4")], -1)
    found = examine_normals(normals)
    assert not found.mended
    np.testing.assert_allclose(found.normals, normals, atol=1e-6)
