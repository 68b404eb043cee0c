"""First-order harmonics: exact up to a Lorentz transformation, then resolved."""

import numpy as np
import pytest
from scipy import optimize

from unips_jax.baselines import spherical_harmonics as harmonics
from unips_jax.baselines.method import Observed, Unsupported
from unips_jax.baselines.pixels import normal_map
from unips_jax.metrics import mean_angular_error_deg

METRIC = np.diag([-1.0, 1.0, 1.0, 1.0])


def blob(size, *, seed=0):
    """A closed bumpy object: normals, mask and a two-tone albedo."""
    rows, columns = np.mgrid[:size, :size]
    x = ((columns + 0.5) / size * 2 - 1) * 1.1
    y = (1 - (rows + 0.5) / size * 2) * 1.1
    rng = np.random.default_rng(seed)
    waves = [(3 * rng.standard_normal(2), rng.uniform(0, 7)) for _ in range(4)]

    def height(x, y):
        bumps = sum(np.cos(k[0] * x + k[1] * y + phase) for k, phase in waves)
        dome = np.maximum(1 - x**2 - (y / 0.85) ** 2, 1e-12)
        return np.sqrt(dome) * (1 + 0.12 * bumps)

    mask = x**2 + (y / 0.85) ** 2 < 0.995
    h = 1e-5
    slope_x = (height(x + h, y) - height(x - h, y)) / (2 * h)
    slope_y = (height(x, y + h) - height(x, y - h)) / (2 * h)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    albedo = np.where((rows // 12 + columns // 12) % 2, 0.9, 0.4)
    return normals * mask[..., None], mask, albedo


def first_order(normals, albedo, count, *, noise=0.0):
    rng = np.random.default_rng(0)
    light = rng.standard_normal((count, 3))
    light *= rng.uniform(0.3, 0.9, (count, 1)) / np.linalg.norm(
        light, axis=-1, keepdims=True
    )
    images = albedo * (1 + np.einsum("hwc,nc->nhw", normals, light))
    return images * (1 + noise * rng.standard_normal(images.shape))


def environment(normals, mask, albedo, count):
    """Irradiance of the hemisphere under two broad lobes and a constant."""
    rng = np.random.default_rng(0)
    sky = rng.standard_normal((800, 3))
    sky /= np.linalg.norm(sky, axis=-1, keepdims=True)
    facing = np.maximum(normals[mask] @ sky.T, 0) / 200
    images = np.zeros((count, *mask.shape))
    for image in images:
        lobes = rng.standard_normal((2, 3))
        lobes /= np.linalg.norm(lobes, axis=-1, keepdims=True)
        strength = rng.uniform(0.5, 2, 2)
        radiance = 0.3 + np.exp(3 * (sky @ lobes.T - 1)) @ strength
        image[mask] = facing @ radiance
    return images * albedo


def colour(images, mask):
    return np.repeat((images * mask)[..., None], 3, axis=-1).astype(np.float32)


def error_of(predicted, normals, mask):
    return float(mean_angular_error_deg(predicted, normals, mask))


def test_exact_up_to_a_lorentz_transformation():
    """The linear map to the truth is a scaled Lorentz one, and leaves no error."""
    normals, mask, albedo = blob(64)
    images = first_order(normals, albedo, 12)
    field = harmonics.cone_field(images[:, mask].T)
    cone = field**2 @ np.diag(METRIC)
    np.testing.assert_allclose(cone / field[:, 0] ** 2, 0, atol=1e-7)
    truth = np.concatenate([np.ones((mask.sum(), 1)), normals[mask]], axis=-1)
    truth *= albedo[mask][:, None]
    matrix = np.linalg.lstsq(field, truth, rcond=None)[0].T
    metric = matrix.T @ METRIC @ matrix
    np.testing.assert_allclose(metric / metric[1, 1], METRIC, atol=1e-6)
    predicted = normal_map(field @ matrix[1:].T, mask)
    error = error_of(predicted, normals, mask)
    print(f"up to Lorentz: {error:.5f} degrees")
    assert error < 0.01


def best_lorentz(rays, start, normals):
    def residual(parameters):
        found = rays @ (harmonics.lorentz(parameters) @ start)[1:].T
        found /= np.linalg.norm(found, axis=-1, keepdims=True)
        return (found - normals).ravel()

    fit = optimize.least_squares(residual, np.zeros(6))
    return harmonics.lorentz(fit.x) @ start


@pytest.mark.parametrize(
    ("light", "limit"), [("first", 2.0), ("noise", 3.0), ("environment", 16.0)]
)
def test_resolved(light, limit):
    found, best = [], []
    for seed in (0, 1):
        normals, mask, albedo = blob(64, seed=seed)
        if light == "environment":
            images = environment(normals, mask, albedo, 20)
        else:
            noise = 0.01 if light == "noise" else 0.0
            images = first_order(normals, albedo, 20, noise=noise)
        images = colour(images, mask)
        predicted = harmonics.first_order_harmonics()(Observed(images, mask))
        found.append(error_of(predicted, normals, mask))
        assert (predicted[~mask] == 0).all()
        rays = harmonics.cone_directions(
            harmonics.cone_field(images[:, mask, 0].astype(np.float64).T)
        )
        matrix = best_lorentz(rays, harmonics.resolve(rays, mask), normals[mask])
        nearest = normal_map(rays @ matrix[1:].T, mask)
        best.append(error_of(nearest, normals, mask))
    print(light, "resolved", np.round(found, 2), "best Lorentz", np.round(best, 2))
    assert max(best) < {"first": 0.05, "noise": 1.0, "environment": 4.0}[light]
    assert max(found) < limit


def test_bumps_not_dents_and_y_up():
    normals, mask, albedo = blob(64)
    images = colour(first_order(normals, albedo, 12), mask)
    predicted = harmonics.first_order_harmonics()(Observed(images, mask))
    top, bottom = predicted[8:14, 28:36, 1], predicted[-14:-8, 28:36, 1]
    assert top[mask[8:14, 28:36]].mean() > 0.3
    assert bottom[mask[-14:-8, 28:36]].mean() < -0.3
    assert predicted[28:36, -10:-4, 0][mask[28:36, -10:-4]].mean() > 0.3


def test_lorentz_keeps_the_cone():
    parameters = np.array([0.3, -0.5, 0.2, 0.1, 0.7, -0.4])
    matrix = harmonics.lorentz(parameters)
    np.testing.assert_allclose(matrix.T @ METRIC @ matrix, METRIC, atol=1e-12)
    boost = harmonics.lorentz(np.array([0.3, -0.5, 0.2, 0, 0, 0]))
    back = harmonics.lorentz(np.array([-0.3, 0.5, -0.2, 0, 0, 0]))
    np.testing.assert_allclose(boost @ back, np.eye(4), atol=1e-12)
    turn = harmonics.lorentz(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    np.testing.assert_allclose(turn @ [1, 1, 0, 0], [1, 0, 1, 0], atol=1e-12)


def test_starts_turn_three_rays_outwards():
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    outward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    truth = np.concatenate([np.ones((40, 1)), outward, np.zeros((40, 1))], axis=-1)
    hidden = harmonics.lorentz(np.array([0.4, 0.2, -0.3, 1.0, 0.5, -0.2]))
    seen = truth @ hidden.T
    rim = harmonics._Rim(seen / seen[:, :1], outward)
    starts = harmonics._starts(rim, hidden @ [1, 0.1, 0, 0.5])
    assert len(starts) == harmonics._STARTS
    for start in starts:
        np.testing.assert_allclose(start @ hidden, np.eye(4), atol=1e-6)


def test_refusals():
    normals, mask, albedo = blob(48)
    images = colour(first_order(normals, albedo, 8), mask)
    method = harmonics.first_order_harmonics()
    with pytest.raises(Unsupported, match="at least 4 images, got 3"):
        method(Observed(images[:3], mask))
    with pytest.raises(Unsupported, match="mask of the object"):
        method(Observed(images, mask & False))
    with pytest.raises(Unsupported, match="too alike"):
        method(Observed(np.repeat(images[:2], 4, axis=0), mask))
    with pytest.raises(Unsupported, match="outline"):
        method(Observed(images + 0.01, np.ones_like(mask)))
    rng = np.random.default_rng(0)
    one, other = rng.uniform(0, 7, (2, 200))
    saddle = np.stack([np.cos(one), np.sin(one), np.cos(other), np.sin(other)], axis=-1)
    with pytest.raises(Unsupported, match="light cone"):
        harmonics.cone_field(saddle @ rng.standard_normal((4, 9)))
