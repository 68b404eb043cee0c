"""Uncalibrated photometric stereo: exact up to bas-relief, then resolved."""

import tracemalloc

import numpy as np
import pytest

from unips_jax.baselines import bas_relief, silhouette, uncalibrated
from unips_jax.baselines.method import Observed, Unsupported
from unips_jax.baselines.pixels import normal_map
from unips_jax.metrics import mean_angular_error_deg


def bumpy(size, *, seed=0, paint="two"):
    """A bumpy cap: normals, mask and grey albedo."""
    rows, columns = np.mgrid[:size, :size]
    x, y = (columns + 0.5) / size * 2 - 1, 1 - (rows + 0.5) / size * 2
    mask = x**2 + y**2 < 0.85
    slope_x, slope_y = -1.1 * x, -1.1 * y
    rng = np.random.default_rng(seed)
    for _ in range(4):
        (kx, ky), phase = 3 * rng.standard_normal(2), rng.uniform(0, 2 * np.pi)
        wave = 0.06 * np.cos(kx * x + ky * y + phase)
        slope_x, slope_y = slope_x + kx * wave, slope_y + ky * wave
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    albedo = {
        "one": np.full_like(x, 0.7),
        "two": np.where((rows // 12 + columns // 12) % 2, 0.9, 0.4),
        "smooth": 0.6 + 0.3 * np.sin(rows / 7) * np.cos(columns / 9),
    }[paint]
    return normals * mask[..., None], mask, albedo


def lights_around(count, *, slant=35.0):
    azimuth = np.arange(count) * 2.399963
    polar = np.deg2rad(slant) * np.sqrt((np.arange(count) + 0.5) / count)
    x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
    return np.stack([x, y, np.cos(polar)], axis=-1)


def render(normals, albedo, directions, *, noise=0.0):
    shading = np.einsum("hwc,nc->nhw", normals, directions).clip(0) * albedo
    rng = np.random.default_rng(1)
    shading *= 1 + noise * rng.standard_normal(shading.shape)
    return np.repeat(shading[..., None], 3, axis=-1).astype(np.float32)


def best_bas_relief(vectors, normals):
    """The transformation that brings the vectors nearest to the true normals."""
    flat = np.cross(vectors * [1, 1, 0], normals)
    third = [np.cross(axis * vectors[:, 2:], normals) for axis in np.eye(3)]
    system = np.stack([flat, *third], axis=-1).reshape(-1, 4)
    scale, *row = np.linalg.eigh(system.T @ system)[1][:, 0]
    matrix = np.diag([scale, scale, 0.0])
    matrix[2] = row
    if np.sum(vectors @ matrix * normals) < 0:
        matrix = -matrix
    return matrix


def error_of(predicted, normals, mask):
    return float(mean_angular_error_deg(predicted, normals, mask))


@pytest.mark.parametrize("paint", ["one", "two", "smooth"])
def test_exact_up_to_bas_relief(paint):
    normals, mask, albedo = bumpy(96, paint=paint)
    directions = lights_around(24)
    errors = []
    for noise in (0.0, 0.01):
        images = render(normals, albedo, directions, noise=noise)
        grey = images[:, mask, 0].T
        field, lights = uncalibrated.integrable_field(grey, mask)
        product = field[mask] @ lights.T
        assert np.abs(product - grey).max() < (0.1 if noise else 1e-5)
        matrix = best_bas_relief(field[mask], normals[mask])
        predicted = normal_map(field[mask] @ matrix, mask)
        errors.append(error_of(predicted, normals, mask))
    print(f"{paint}: {errors[0]:.2f} clean, {errors[1]:.2f} with 1 % noise")
    assert errors[0] < 0.7
    assert errors[1] < 1.0


@pytest.mark.parametrize(
    ("resolve", "paint", "limit"),
    [
        ("entropy", "one", 1.5),
        ("entropy", "two", 1.5),
        ("diffuse_maxima", "one", 2.0),
        ("diffuse_maxima", "two", 4.0),
    ],
)
def test_resolved(resolve, paint, limit):
    method = uncalibrated.factorisation(resolve=resolve)
    errors = []
    for seed in (0, 2):
        normals, mask, albedo = bumpy(96, seed=seed, paint=paint)
        images = render(normals, albedo, lights_around(24), noise=0.01)
        predicted = method(Observed(images, mask))
        errors.append(error_of(predicted, normals, mask))
        assert (predicted[~mask] == 0).all()
        np.testing.assert_allclose(
            np.linalg.norm(predicted[mask], axis=-1), 1, atol=1e-6
        )
    flat = normal_map(np.zeros((mask.sum(), 3)), mask)
    print(resolve, paint, np.round(errors, 2), error_of(flat, normals, mask))
    assert max(errors) < limit


@pytest.mark.parametrize("depth", [1.0, 1.05, 1.2, 2.0])
def test_entropy_knows_one_paint_from_lengths_that_hardly_differ(depth):
    """Normals of one albedo, whose third components are known up to a factor."""
    normals = np.random.default_rng(0).normal(size=(3000, 3))
    normals[:, 2] = 1.2 * abs(normals[:, 2])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    found = bas_relief.by_entropy(normals * [1, 1, depth])
    np.testing.assert_allclose(found, [0, 0, 1 / depth], atol=0.02)


def test_shadows_cost_accuracy_but_not_the_shape():
    normals, mask, albedo = bumpy(96, paint="one")
    images = render(normals, albedo, lights_around(24, slant=65.0))
    share = (images[:, mask] == 0).mean()
    for resolve in ("entropy", "diffuse_maxima"):
        predicted = uncalibrated.factorisation(resolve=resolve)(Observed(images, mask))
        error = error_of(predicted, normals, mask)
        print(f"{resolve}: {error:.1f} with {share:.1%} in shadow")
        assert error < 25


def test_bumps_not_dents_and_y_up():
    normals, mask, albedo = bumpy(64, paint="one")
    images = render(normals, albedo, lights_around(24))
    for resolve in ("entropy", "diffuse_maxima"):
        predicted = uncalibrated.factorisation(resolve=resolve)(Observed(images, mask))
        assert predicted[4:14, 28:36, 1][mask[4:14, 28:36]].mean() > 0.2
        assert predicted[-14:-4, 28:36, 1][mask[-14:-4, 28:36]].mean() < -0.2
        assert predicted[28:36, -14:-4, 0][mask[28:36, -14:-4]].mean() > 0.2


def test_transform_is_the_bas_relief_group():
    b, light = np.array([0.3, -0.2, 0.8]), np.array([0.1, 0.4, 0.9])
    matrix = bas_relief.transform(np.array([0.5, -1.0, 2.0]))
    moved = np.linalg.solve(matrix, light)
    assert (b @ matrix) @ moved == pytest.approx(b @ light)
    np.testing.assert_allclose(b @ matrix, [0.3 + 0.4, -0.2 - 0.8, 1.6])


def test_diffuse_maxima_are_exact_on_exact_pairs():
    """Normals that face their lights, seen through a known transformation."""
    relief = np.array([0.4, -0.3, 1.5])
    directions = lights_around(9, slant=50.0)
    inverse = np.linalg.inv(bas_relief.transform(relief))
    b, light = directions @ inverse, directions @ bas_relief.transform(relief).T
    flat = light[:, 0] ** 2 + light[:, 1] ** 2
    start, end = bas_relief._segments(b, light, flat)
    crossing = np.concatenate([p for _, _, p in bas_relief._crossings(start, end)])
    assert len(crossing) > 3
    middle = np.median(crossing, axis=0)
    np.testing.assert_allclose(middle, relief[:2], atol=1e-9)
    lam = bas_relief._lam(b, light, flat, np.tile(relief[:2], (9, 1)))
    np.testing.assert_allclose(lam, relief[2], atol=1e-9)


def test_crossings_are_those_of_all_pairs():
    start, end = np.random.default_rng(0).uniform(-1, 1, (2, 40, 2))
    expected = {}
    for i in range(40):
        for j in range(i + 1, 40):
            sides = np.stack([end[i] - start[i], start[j] - end[j]], -1)
            s, t = np.linalg.solve(sides, start[j] - start[i])
            if 0 < s < 1 and 0 < t < 1:
                expected[i, j] = start[i] + s * (end[i] - start[i])
    found = {
        (i, int(j)): point
        for i, others, points in bas_relief._crossings(start, end)
        for j, point in zip(others, points, strict=True)
    }
    assert len(expected) > 100 and list(found) == list(expected)
    np.testing.assert_allclose(list(found.values()), list(expected.values()))


def test_crossings_take_memory_for_segments_and_crossings_not_for_pairs():
    start = np.random.default_rng(0).uniform(-1, 1, (3000, 2))
    tracemalloc.start()
    count = sum(1 for _ in bas_relief._crossings(start, start + 1e-6))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 0
    assert peak < 100 * 8 * 3000  # of the 4.5 million pairs, a number each takes 36 MB


def test_of_too_many_diffuse_maxima_some_are_used(monkeypatch):
    normals, mask, albedo = bumpy(96, paint="one")
    images = render(normals, albedo, lights_around(24), noise=0.01)
    sizes, segments = [], bas_relief._segments

    def counted(b, light, flat):
        sizes.append(len(b))
        return segments(b, light, flat)

    monkeypatch.setattr(bas_relief, "_segments", counted)
    method = uncalibrated.factorisation()
    method(Observed(images, mask))
    monkeypatch.setattr(bas_relief, "_MAXIMA", sizes[0] - 1)
    predicted = method(Observed(images, mask))
    assert sizes[1] == -(-sizes[0] // 2)
    assert error_of(predicted, normals, mask) < 4


@pytest.mark.parametrize("unit", [1e-7, 1e7])
def test_the_unit_of_the_images_does_not_matter(unit):
    normals, mask, albedo = bumpy(64, paint="one")
    images = render(normals, albedo, lights_around(24), noise=0.01)
    found, expected = (
        uncalibrated.factorisation()(Observed(images * scale, mask))
        for scale in (np.float32(unit), 1)
    )
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_flat_albedo_finds_the_paint():
    normals, mask, albedo = bumpy(64, paint="two")
    images = render(normals, albedo, lights_around(24))[..., 0]
    found = bas_relief.flat_albedo(images, mask)
    ratio = found[mask] / albedo[mask]
    assert np.std(ratio) / np.mean(ratio) < 0.02


def test_silhouette_points_outwards_and_up():
    mask = np.zeros((40, 50), bool)
    mask[10:30, 15:35] = True
    outline, outward = silhouette.silhouette(mask, name="test")
    directions = np.zeros((40, 50, 2))
    directions[outline] = outward
    np.testing.assert_allclose(directions[10, 25], [0, 1], atol=1e-6)
    np.testing.assert_allclose(directions[29, 25], [0, -1], atol=1e-6)
    np.testing.assert_allclose(directions[20, 34], [1, 0], atol=1e-6)
    assert not outline[20, 25]


def test_refusals():
    normals, mask, albedo = bumpy(48, paint="one")
    images = render(normals, albedo, lights_around(6))
    method = uncalibrated.factorisation()
    with pytest.raises(Unsupported, match="at least 3 images, got 2"):
        method(Observed(images[:2], mask))
    with pytest.raises(Unsupported, match="mask of the object"):
        method(Observed(images, mask & False))
    with pytest.raises(Unsupported, match="too alike"):
        method(Observed(np.repeat(images[:1], 6, axis=0), mask))
    full = np.ones_like(mask)
    with pytest.raises(Unsupported, match="outline"):
        uncalibrated.factorisation(resolve="entropy")(Observed(images + 0.01, full))
    small = np.zeros_like(mask)
    small[20:24, 20:24] = True
    with pytest.raises(Unsupported, match="too small"):
        method(Observed(images, small))
    with pytest.raises(ValueError, match="resolve"):
        uncalibrated.factorisation(resolve="hope")
