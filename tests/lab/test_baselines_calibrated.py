"""Calibrated photometric stereo on scenes whose normals are known exactly."""

import itertools

import numpy as np
import pytest

from unips_jax.baselines import calibrated, constant, pixels
from unips_jax.baselines.method import Lights, Observed, Unsupported
from unips_jax.evaluation.scores import error_map
from unips_jax.metrics import mean_angular_error_deg

METHODS = {
    "woodham": calibrated.woodham,
    "robust_l1": calibrated.robust_l1,
    "sparse_bayesian": calibrated.sparse_bayesian,
    "low_rank": calibrated.low_rank,
}


def cap(size, *, bumps=0.0, radius=0.6):
    """A spherical cap, with bumps: normals, mask and a two-tone albedo."""
    rows, columns = np.mgrid[:size, :size]
    x = (columns + 0.5) / size * 2 - 1
    y = 1 - (rows + 0.5) / size * 2
    mask = x**2 + y**2 < 0.95**2
    height = np.sqrt(np.maximum(1 - radius**2 * (x**2 + y**2), 1e-6)) / radius
    slope_x = -x / height + bumps * 5 * np.cos(5 * x) * np.cos(4 * y)
    slope_y = -y / height - bumps * 4 * np.sin(5 * x) * np.sin(4 * y)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    albedo = np.where((rows // 6 + columns // 6) % 2, 0.9, 0.4)[..., None]
    return normals * mask[..., None], mask, albedo * np.array([1.0, 0.7, 0.5])


def lights_around(count, *, slant=25.0, seed=0):
    """Lights within `slant` degrees of the viewer, of unequal colours."""
    rng = np.random.default_rng(seed)
    azimuth = np.arange(count) * 2.399963
    polar = np.deg2rad(slant) * np.sqrt((np.arange(count) + 0.5) / count)
    directions = np.stack(
        [
            np.sin(polar) * np.cos(azimuth),
            np.sin(polar) * np.sin(azimuth),
            np.cos(polar),
        ],
        axis=-1,
    )
    return Lights(directions, rng.uniform(0.5, 2.0, (count, 3)))


def render(normals, albedo, lights):
    shading = np.einsum("hwc,nc->nhw", normals, lights.directions).clip(0)
    return (shading[..., None] * albedo * lights.intensities[:, None, None, :]).astype(
        np.float32
    )


@pytest.mark.parametrize("name", METHODS)
def test_exact_without_shadows(name):
    normals, mask, albedo = cap(41, bumps=0.05)
    lights = lights_around(24)
    images = render(normals, albedo, lights)
    assert (images[:, mask] > 0).all()
    predicted = METHODS[name]()(Observed(images, mask, lights=lights))
    error = float(mean_angular_error_deg(predicted, normals, mask))
    print(f"{name}: {error:.5f} degrees")
    assert error < 0.1
    assert predicted.dtype == np.float32
    assert (predicted[~mask] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(predicted[mask], axis=-1), 1, atol=1e-6)


def outliers():
    """40 lights; 12 % of the values are pushed up or down."""
    normals, mask, albedo = cap(41, bumps=0.05)
    lights = lights_around(40, slant=40.0)
    images = render(normals, albedo, lights)
    rng = np.random.default_rng(3)
    hit = rng.uniform(size=images.shape[:3]) < 0.12
    gain = np.where(rng.uniform(size=hit.shape) < 0.5, 0.0, 2.0)
    images *= np.where(hit, gain, 1.0)[..., None].astype(np.float32)
    noise = 1 + 0.01 * rng.standard_normal(images.shape)
    return images * noise.astype(np.float32), normals, mask, lights


def test_outliers_are_resisted_in_the_expected_order():
    images, normals, mask, lights = outliers()
    error = {
        name: float(
            mean_angular_error_deg(
                make()(Observed(images, mask, lights=lights)), normals, mask
            )
        )
        for name, make in METHODS.items()
    }
    trimmed = calibrated.woodham(keep=(0.2, 0.8))(Observed(images, mask, lights=lights))
    error["trimmed"] = float(mean_angular_error_deg(trimmed, normals, mask))
    print({name: round(value, 2) for name, value in error.items()})
    assert error["woodham"] > 5
    assert error["low_rank"] < 0.7 * error["woodham"]
    assert error["robust_l1"] < 0.35 * error["woodham"]
    assert error["sparse_bayesian"] < 0.35 * error["woodham"]


def test_light_from_above_brightens_upward_normals():
    normals, mask, albedo = cap(32)
    lights = lights_around(24)
    tilted = lights.directions + [0.0, 0.5, 0.0]
    tilted /= np.linalg.norm(tilted, axis=-1, keepdims=True)
    above = Lights(tilted, lights.intensities)
    images = render(normals, albedo, above)
    mean = images[..., 0].mean(0) / albedo[..., 0]
    assert mean[4, 16] > mean[16, 16] > mean[28, 16]  # brighter at the image's top
    for make in METHODS.values():
        predicted = make()(Observed(images, mask, lights=above))
        assert (predicted[:12, 12:20, 1][mask[:12, 12:20]] > 0).all()
        assert (predicted[12:20, -12:, 0][mask[12:20, -12:]] > 0).all()


def test_published_recipe_divides_takes_luma_and_clips():
    """By hand: one pixel, three orthogonal lights, one value above 1."""
    lights = Lights(np.eye(3), np.array([[1, 2, 4], [1, 1, 1], [2, 2, 2.0]]))
    pixel = np.array([[0.2, 0.4, 0.8], [3.0, 2.0, 1.0], [1.0, 0.6, 0.2]])
    images = pixel[:, None, None, :].astype(np.float32)
    mask = np.ones((1, 1), bool)
    luma = (pixel / lights.intensities) @ [0.299, 0.587, 0.114]
    expected = np.minimum(luma, 1)
    predicted = calibrated.woodham_diligent()(Observed(images, mask, lights=lights))
    np.testing.assert_allclose(
        predicted[0, 0], expected / np.linalg.norm(expected), atol=1e-6
    )


def test_shadow_threshold_and_ranks_recover_a_shadowed_sphere():
    normals, mask, albedo = cap(41, radius=0.9)
    lights = lights_around(24, slant=60.0)
    images = render(normals, albedo, lights)
    assert (images[:, mask] == 0).any()
    errors = {}
    for name, options in {
        "plain": {},
        "shadow": {"shadow": 0.01},
        "strongest": {"shadow": 0.01, "colour": "strongest"},
    }.items():
        predicted = calibrated.woodham(**options)(Observed(images, mask, lights=lights))
        errors[name] = float(mean_angular_error_deg(predicted, normals, mask))
    print(errors)
    assert errors["plain"] > 1
    assert errors["shadow"] < 0.1
    assert errors["strongest"] < 0.1


@pytest.mark.parametrize("name", METHODS)
def test_scale_does_not_matter(name):
    images, _, mask, lights = outliers()
    images = images[:10]
    lights = Lights(lights.directions[:10], lights.intensities[:10])
    one = METHODS[name]()(Observed(images, mask, lights=lights))
    other = METHODS[name]()(Observed(images * 4096, mask, lights=lights))
    np.testing.assert_allclose(one, other, atol=1e-4)


def test_chunks_do_not_matter_and_compile_once(monkeypatch):
    traces = 0

    def solve(values, directions):
        nonlocal traces
        traces += 1
        return values @ directions

    rng = np.random.default_rng(0)
    values, directions = rng.standard_normal((1301, 7)), rng.standard_normal((7, 3))
    monkeypatch.setattr(pixels, "CHUNK", 512)
    for count in (1301, 1100, 1500):
        some = np.resize(values, (count, 7))
        found = pixels.map_pixels(solve, some, directions)
        np.testing.assert_allclose(found, some @ directions, atol=1e-5)
    assert traces == 1


def test_split_recovers_a_planted_low_rank_matrix():
    rng = np.random.default_rng(0)
    low = rng.standard_normal((200, 2)) @ rng.standard_normal((2, 80))
    sparse = np.where(rng.uniform(size=low.shape) < 0.05, 5.0, 0.0)
    found, rest = calibrated.split_low_rank(low + sparse)
    np.testing.assert_allclose(found, low, atol=1e-4)
    np.testing.assert_allclose(rest, sparse, atol=1e-4)


def test_constant_faces_the_viewer():
    normals, mask, albedo = cap(16)
    images = render(normals, albedo, lights_around(1))
    predicted = constant.constant()(Observed(images, mask))
    np.testing.assert_array_equal(predicted[mask], [[0, 0, 1]] * mask.sum())
    assert (predicted[~mask] == 0).all()
    with pytest.raises(Unsupported, match="mask of the object"):
        constant.constant()(Observed(images, mask & False))


def test_refusals():
    normals, mask, albedo = cap(16)
    lights = lights_around(5)
    images = render(normals, albedo, lights)
    method = calibrated.woodham()
    with pytest.raises(Unsupported, match="needs known lights"):
        method(Observed(images, mask))
    with pytest.raises(Unsupported, match="at least 3 images, got 2"):
        method(
            Observed(images[:2], mask, lights=Lights(*(part[:2] for part in lights)))
        )
    with pytest.raises(Unsupported, match="mask of the object"):
        method(Observed(images, np.zeros_like(mask), lights=lights))
    flat = Lights(lights.directions * [1, 0, 1], lights.intensities)
    with pytest.raises(Unsupported, match="one plane"):
        method(Observed(images, mask, lights=flat))
    with pytest.raises(Unsupported, match="black or not finite"):
        method(Observed(images * np.nan, mask, lights=lights))
    with pytest.raises(ValueError, match="expected images"):
        method(Observed(images, mask[:-1], lights=lights))
    with pytest.raises(ValueError, match="expected directions"):
        method(Observed(images[:-1], mask, lights=lights))
    with pytest.raises(ValueError, match="keep"):
        calibrated.woodham(keep=(0.8, 0.2))


def test_lengths_of_directions_do_not_matter():
    lights = lights_around(4)
    longer = lights._replace(directions=lights.directions * [[1], [2], [0.5], [3]])
    images, mask = np.ones((4, 2, 2, 3), np.float32), np.ones((2, 2), bool)
    found, _ = calibrated.check_lights("woodham", Observed(images, mask, longer))
    np.testing.assert_allclose(found, lights.directions, atol=1e-12)


def test_values_kept_of_lights_in_a_plane_leave_no_normal_open():
    """A cross of six lamps: of four in a row any normal has the same shading."""
    normals, mask, albedo = cap(41)
    angles = np.deg2rad([-50, -25, 25, 50])
    row = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)
    cross = np.concatenate([row, row[[0, 3]][:, [1, 0, 2]]])
    lights = Lights(cross, np.ones((6, 3)))
    observed = Observed(render(normals, albedo, lights), mask, lights=lights)
    for method in (calibrated.woodham(keep=(0.2, 0.8)), calibrated.woodham(shadow=0.3)):
        error = error_map(method(observed), normals)[mask]
        assert np.quantile(error, 0.99) < 25 and error.mean() < 3, error.mean()


def test_ranks_begin_with_the_darkest():
    """Of five values the two brightest are no matte shading."""
    directions = lights_around(5).directions
    normal = np.array([0.3, -0.2, 0.933])
    values = directions @ normal
    values[np.argsort(values)[-2:]] += 1
    keep = {"keep": (0.0, 0.6), "shadow": None}
    (found,) = pixels.map_pixels(calibrated._trimmed, values[None], directions, **keep)
    np.testing.assert_allclose(found, normal, atol=1e-3)


def test_absolute_residuals_are_least():
    """The least have a solution that is exact for three of the values."""
    rng = np.random.default_rng(1)
    directions = lights_around(6).directions
    values = directions @ rng.normal(size=(3, 20)) + 0.3 * rng.normal(size=(6, 20))
    values /= np.abs(values).max(axis=0)
    triples = [list(t) for t in itertools.combinations(range(6), 3)]
    exact = [np.linalg.solve(directions[t], values[t]) for t in triples]
    least = np.min([np.abs(values - directions @ x).sum(0) for x in exact], axis=0)
    found = pixels.map_pixels(calibrated._l1, values.T, directions, iterations=50)
    residuals = np.abs(values - directions @ found.T).sum(0)
    np.testing.assert_allclose(residuals, least, rtol=0.02)


def test_the_strongest_colour_decides():
    normals, mask, _ = cap(9)
    lights = lights_around(6)._replace(intensities=np.ones((6, 3)))
    images = render(normals, np.array([0.02, 0.9, 0.02]), lights)
    images[..., [0, 2]] += 0.05 * np.random.default_rng(0).random(images[..., :2].shape)
    found = calibrated.woodham(colour="strongest")(Observed(images, mask, lights))
    np.testing.assert_allclose(found, normals, atol=1e-4)
