"""GCNet, PS-FCN and LCNet as methods: invariances, lights, what they refuse."""

import jax
import numpy as np
import pytest
from reference_arrays import made_up

from unips_jax.baselines import calibrated
from unips_jax.baselines.gcnet import crops, networks
from unips_jax.baselines.gcnet import lights as gcnet_lights
from unips_jax.baselines.gcnet import parameters as gcnet_weights
from unips_jax.baselines.gcnet import pipeline as gcnet
from unips_jax.baselines.method import Lights, Observed, Unsupported
from unips_jax.evaluation.methods import _calibrated


@pytest.fixture(scope="module")
def params():
    return {
        network: gcnet_weights.from_official(made_up(network))
        for network in ("gcnet", "ps_fcn", "lcnet")
    }


def sphere(size=48, count=5):
    rows, columns = np.mgrid[:size, :size]
    x = (columns + 0.5) / size * 2.4 - 1.2
    y = 1.2 - (rows + 0.5) / size * 2.4
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    normals = np.stack([x, y, z], axis=-1) * mask[..., None]
    azimuth = np.arange(count) * 2.4
    directions = np.stack(
        [0.5 * np.cos(azimuth), 0.5 * np.sin(azimuth), np.full(count, 0.75**0.5)],
        axis=-1,
    )
    shading = np.einsum("hwc,nc->nhw", normals, directions).clip(0)
    gain = np.linspace(0.5, 1.5, count)[:, None, None, None]
    images = shading[..., None] * gain * np.array([1.0, 0.8, 0.6])
    return images.astype(np.float32), mask, directions


@pytest.mark.parametrize("network", ["gcnet", "lcnet"])
def test_order_of_images_does_not_matter(params, network):
    images, mask, _ = sphere()
    order = np.array([3, 0, 4, 2, 1])
    one = gcnet.estimate_lights(params[network], Observed(images, mask))
    other = gcnet.estimate_lights(params[network], Observed(images[order], mask))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a[order], b, rtol=1e-5, atol=1e-5)
    make = {"gcnet": gcnet.gcnet, "lcnet": gcnet.lcnet}[network]
    method = make(params[network], normals=gcnet.ps_fcn(params["ps_fcn"]))
    first = method(Observed(images, mask)).normals
    second = method(Observed(images[order], mask)).normals
    np.testing.assert_allclose(first, second, atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(first[mask], axis=-1), 1, atol=1e-5)
    assert (first[~mask] == 0).all()


def test_chunks_of_images_do_not_matter(params):
    images, mask, directions = sphere(46)  # sides are padded to a multiple of 4
    lights = Lights(directions, np.ones((5, 3)))
    whole = gcnet.ps_fcn(params["ps_fcn"], chunk=8)(
        Observed(images, mask, lights=lights)
    )
    parts = gcnet.ps_fcn(params["ps_fcn"], chunk=2)(
        Observed(images, mask, lights=lights)
    )
    np.testing.assert_allclose(parts, whole, atol=1e-5)


def test_normalisations():
    images, mask, _ = sphere()
    for norm, peak in (("range01", 0.1), ("literal10", 10.0)):
        scaled, gain = crops.normalise(images, mask, norm=norm, per="image")
        np.testing.assert_allclose(scaled.max(axis=(1, 2, 3)), peak, rtol=1e-6)
        np.testing.assert_allclose(
            scaled / gain[:, None, None, None], images, rtol=1e-5
        )
        scaled, gain = crops.normalise(images, mask, norm=norm, per="stack")
        assert scaled.max() == pytest.approx(peak)
        assert np.ptp(gain) == 0
    scaled, gain = crops.normalise(images, mask, norm="none", per="image")
    np.testing.assert_array_equal(scaled, images)
    with pytest.raises(ValueError, match="norm: expected one of"):
        crops.normalise(images, mask, norm="max", per="image")


def test_intensities_refer_to_the_given_images(params):
    """Per image, exposures vanish for the network and come back in its answer."""
    images, mask, _ = sphere()
    one = gcnet.estimate_lights(params["gcnet"], Observed(images, mask))
    gain = np.array([1.0, 2.0, 0.5, 4.0, 3.0], np.float32)
    other = gcnet.estimate_lights(
        params["gcnet"], Observed(images * gain[:, None, None, None], mask)
    )
    np.testing.assert_allclose(other.directions, one.directions, atol=1e-5)
    np.testing.assert_allclose(
        other.intensities, one.intensities * gain[:, None], rtol=1e-4
    )


def test_errors_of_lights():
    directions = np.eye(3, dtype=np.float32)[[2, 2]]
    true = Lights(directions, np.array([[1.0, 1, 1], [2, 2, 2]]))
    tilted = np.array([[0, np.sin(0.2), np.cos(0.2)], [0, 0, 1]])
    found = gcnet_lights.light_errors(Lights(tilted, 7 * true.intensities), true)
    degrees, relative = found.values()
    np.testing.assert_allclose(degrees, np.rad2deg(0.2) / 2)
    np.testing.assert_allclose(relative, 0, atol=1e-7)
    # Fitting (1, 1) to (1, 2) gives 1.5 and errors of a half and a quarter.
    _, relative = gcnet_lights.light_errors(
        Lights(tilted, np.ones((2, 3))), true
    ).values()
    np.testing.assert_allclose(relative, 0.375)


def test_lights_feed_any_calibrated_method(params):
    images, mask, _ = sphere()
    found = gcnet.estimate_lights(params["gcnet"], Observed(images, mask))
    expected = calibrated.woodham()(Observed(images, mask, lights=found))
    method = gcnet.gcnet(params["gcnet"], normals=calibrated.woodham())
    np.testing.assert_allclose(
        method(Observed(images, mask)).normals, expected, atol=1e-6
    )
    measured = method(Observed(images, mask, lights=found)).measures
    assert measured == {
        "light direction error (degrees)": pytest.approx(0, abs=0.05)
    } | {"light intensity error (relative)": pytest.approx(0, abs=1e-6)}


def test_small_networks_of_the_same_design_work():
    net = networks.GCNet(
        networks.LightNet(widths=(8, 8, 8, 8, 8, 8, 16), classifier=8, hidden=8),
        networks.NormalNet(widths=(4, 4, 8, 8, 8, 8, 8), regressor_widths=(8, 8, 4)),
    )
    images, mask, _ = sphere()
    inputs = np.zeros((1, 2, 64, 64, 3), np.float32), np.zeros((1, 64, 64), np.float32)
    shapes = jax.eval_shape(net.init, jax.random.key(0), *inputs)["params"]
    rng = np.random.default_rng(0)
    params = jax.tree.map(
        lambda leaf: (0.1 * rng.standard_normal(leaf.shape)).astype(np.float32), shapes
    )
    lights = gcnet.estimate_lights(params, Observed(images, mask))
    assert lights.directions.shape == lights.intensities.shape == (5, 3)
    assert (lights.directions[:, 2] > 0).all()


def test_refusals(tmp_path, params):
    images, mask, directions = sphere()
    lights = Lights(directions, np.ones((5, 3)))
    with pytest.raises(Unsupported, match="GCNet.pth"):
        gcnet.gcnet()(Observed(images, mask))
    with pytest.raises(Unsupported, match="LCNet_CVPR2019.pth"):
        gcnet.lcnet()(Observed(images, mask))
    with pytest.raises(Unsupported, match="PS-FCN_B_S_32.pth"):
        gcnet.ps_fcn()(Observed(images, mask, lights=lights))
    with pytest.raises(Unsupported, match="calibrated method"):
        gcnet.gcnet(params["gcnet"])(Observed(images, mask))
    with pytest.raises(Unsupported, match="needs known lights"):
        gcnet.ps_fcn(params["ps_fcn"])(Observed(images, mask))
    with pytest.raises(Unsupported, match="at least 2 images"):
        gcnet.estimate_lights(params["gcnet"], Observed(images[:1], mask))
    with pytest.raises(Unsupported, match="mask of the object"):
        gcnet.estimate_lights(params["gcnet"], Observed(images, mask & False))
    path = tmp_path / "lcnet.safetensors"
    gcnet_weights.save_params(path, params["lcnet"], "lcnet")
    with pytest.raises(Unsupported, match="holds the weights of lcnet"):
        gcnet.gcnet(path, normals=calibrated.woodham())(Observed(images, mask))


def test_woodham_after_a_network_does_not_clip():
    """The scale of estimated lights is any."""
    images, mask, directions = sphere()
    dim, bright = (
        _calibrated("gcnet", "woodham")(
            Observed(images, mask, Lights(directions, np.full((5, 3), power)))
        )
        for power in (0.1, 10.0)
    )
    np.testing.assert_allclose(dim, bright, atol=1e-4)
