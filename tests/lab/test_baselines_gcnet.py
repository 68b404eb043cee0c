"""GCNet, PS-FCN and LCNet against numbers from the authors' network classes.

The weights are made here by the reference's recipe, from each array's name. The
tolerances are the reference's: its own rounding is about 1e-5 on logits and normals,
2e-6 on lights.
"""

import functools

import jax
import numpy as np
import pytest
from reference_arrays import made_up

from unips_jax.baselines.gcnet import crops, networks
from unips_jax.baselines.gcnet import lights as gcnet_lights
from unips_jax.baselines.gcnet import parameters as gcnet_weights
from unips_jax.baselines.gcnet import pipeline as gcnet
from unips_jax.errors import InputError

soft_lights = jax.jit(gcnet_lights.soft_lights)

LOOSE = 1e-4  # logits, features and normals
TIGHT = 1e-5  # lights


@pytest.fixture(scope="module")
def golden(shared_dir):
    path = shared_dir / "golden" / "golden_gcnet.npz"
    if not path.is_file():
        pytest.skip(f"no reference arrays at {path}")
    return np.load(path)


@pytest.fixture(scope="module")
def params():
    return {
        network: gcnet_weights.from_official(made_up(network))
        for network in ("gcnet", "ps_fcn", "lcnet")
    }


def unpacked(golden, case):
    """Images `[B, N, H, W, 3]` and mask `[B, H, W]`."""
    stacked = golden[f"{case}_img"]
    images = stacked.reshape(len(stacked), -1, 3, *stacked.shape[2:])
    return images.transpose(0, 1, 3, 4, 2), golden[f"{case}_mask"][:, 0]


def channels_last(array):
    return np.moveaxis(array, -3, -1)


def resized(images, mask):
    return jax.vmap(functools.partial(crops.resized, side=128))(images, mask)


def run(params, images, mask):
    return jax.jit(networks.gcnet_of(params).apply)({"params": params}, images, mask)


def assert_close(found, expected, tolerance, name):
    print(f"{name}: {np.abs(np.asarray(found) - expected).max():.1e}", end="  ")
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def assert_stages_match(stages, golden, case):
    for net, logits in (("L1", stages.first), ("L2", stages.second)):
        directions, intensities = soft_lights(logits)
        features = channels_last(golden[f"{case}_{net}_feat"])
        assert_close(logits.features, features, LOOSE, f"{case}_{net}_feat")
        for name, found, tolerance in (
            ("logit_x", logits.azimuth, LOOSE),
            ("logit_y", logits.elevation, LOOSE),
            ("logit_i", logits.intensity, LOOSE),
            ("dirs", directions, TIGHT),
            ("intens", np.repeat(intensities, 3, axis=-1), TIGHT),
        ):
            name = f"{case}_{net}_{name}"
            assert_close(found, golden[name], tolerance, name)
    normals = channels_last(golden[f"{case}_N_normal"])
    assert_close(stages.normals, normals, LOOSE, f"{case}_N_normal")
    assert_close(stages.shading, golden[f"{case}_N_shading"], LOOSE, "shading")


def test_recipe_makes_the_reference_weights():
    """The reference's spot checks: the recipe, the names and the shapes."""
    arrays = made_up("gcnet")
    for key, expected in {
        "L_Net1.featExtractor.conv1.0.weight": (-0.05621824, 0.15166913, -0.056442227),
        "N_Net.extractor.conv6.0.weight": (-0.01578025, -0.027567403, 0.013512287),
        "L_Net2.classifier.int_est.1.0.bias": (0.010885361, -0.10919072, 0.050176188),
    }.items():
        np.testing.assert_allclose(arrays[key].ravel()[:3], expected, rtol=1e-6)


def test_case_a(golden):
    arrays = made_up("gcnet", gain=1.0, out_gain=1.0)
    params = gcnet_weights.from_official(arrays)
    assert_stages_match(run(params, *unpacked(golden, "a")), golden, "a")


def test_case_b_resizes_and_ends_in_native_normals(golden, params):
    images, mask = unpacked(golden, "b")
    stages = run(params["gcnet"], *resized(images, mask))
    assert_stages_match(stages, golden, "b")
    directions, intensities = soft_lights(stages.second)
    expected = channels_last(golden["b_final_normal"])
    for b in range(2):
        found = gcnet._normals(
            params["ps_fcn"], images[b], directions[b], intensities[b], 2
        )
        assert_close(found, expected[b], LOOSE, "b_final_normal")


def test_case_c_ps_fcn_alone(golden, params):
    images, _ = unpacked(golden, "e")
    x = networks.with_lights(images, golden["c_dirs"][None], golden["c_ints"][None])
    found = jax.jit(networks.NormalNet().apply)({"params": params["ps_fcn"]}, x)
    assert_close(found, channels_last(golden["c_normal"]), LOOSE, "c_normal")


def test_case_d_lcnet(golden, params):
    images, mask = unpacked(golden, "a")
    masks = np.broadcast_to(mask[:, None, ..., None], (*images.shape[:-1], 1))
    net = networks.light_net_of(params["lcnet"])
    x = np.concatenate([images, masks], axis=-1)
    logits = jax.jit(net.apply)({"params": params["lcnet"]}, x)
    for found, name in zip(logits, ("dirs_x", "dirs_y", "ints"), strict=False):
        assert_close(found, golden[f"d_{name}"], LOOSE, f"d_{name}")
    directions, intensities = gcnet_lights.hard_lights(logits)
    assert_close(directions, golden["d_dirs"], TIGHT, "d_dirs")
    found = np.repeat(intensities, 3, axis=-1)
    assert_close(found, golden["d_intens"], TIGHT, "d_intens")


def test_case_e_every_stage(golden, params):
    images, mask = unpacked(golden, "e")
    stages = run(params["gcnet"], images, mask)
    assert_stages_match(stages, golden, "e")
    x = networks.with_lights(images, *soft_lights(stages.first))
    coarse = params["gcnet"]["coarse"]
    extract = functools.partial(networks.normal_net_of(coarse).apply, method="extract")
    features = jax.jit(extract)({"params": coarse}, x).max(1)
    expected = channels_last(golden["e_N_fused_feat"])
    assert_close(features, expected, LOOSE, "e_N_fused_feat")


def test_case_f_classes(golden):
    """Values on a class's edge may fall to either side."""
    encode = jax.jit(gcnet_lights.encode)
    azimuth, elevation, _ = encode(golden["f_dirs"], np.ones(70))
    intensity = encode(np.array([0.0, 0, 1]), golden["f_ints"])[2]
    for found, name in ((azimuth, "x"), (elevation, "y"), (intensity, "i")):
        off = np.abs(np.asarray(found) - golden[f"f_cls_{name}"])
        assert off.max() <= 1
        assert (off == 0).mean() > 0.9
    decode = jax.jit(gcnet_lights.decode)
    directions, _ = decode(golden["f_cls_x"], golden["f_cls_y"], 0)
    assert_close(directions, golden["f_dirs_back"], TIGHT, "f_dirs_back")
    _, back = decode(0, 0, golden["f_cls_i"])
    assert_close(back[:, 0], golden["f_ints_back"], TIGHT, "f_ints_back")


def test_kernels_lie_the_right_way_round():
    """What one bright pixel becomes, by the definition of either convolution."""
    dot = np.zeros((1, 3, 3, 1), np.float32)
    dot[0, 1, 1] = 1
    weight = np.arange(1.0, 33, dtype=np.float32).reshape(1, 2, 4, 4)  # in, out
    kernel = gcnet_weights._convert(weight, transposed=True)
    found = networks.Deconv(2).apply({"params": {"conv": {"kernel": kernel}}}, dot)
    # y[2 i - 1 + k] = x[i] w[k]: the weight itself about the pixel.
    expected = np.pad(np.moveaxis(weight[0], 0, -1), ((1, 1), (1, 1), (0, 0)))
    np.testing.assert_allclose(found[0], expected)
    weight = np.arange(1.0, 19, dtype=np.float32).reshape(2, 1, 3, 3)  # out, in
    kernel = gcnet_weights._convert(weight, transposed=False)
    layer = {"conv": {"kernel": kernel, "bias": np.array([0, -100], np.float32)}}
    found = networks.Conv(2).apply({"params": layer}, dot)
    # y[i] = x[i - 1 + k] w[k]: the weight upside down; LeakyReLU leaves a tenth.
    np.testing.assert_allclose(found[0, ..., 0], weight[0, 0, ::-1, ::-1])
    expected = 0.1 * (weight[1, 0, ::-1, ::-1] - 100)
    np.testing.assert_allclose(found[0, ..., 1], expected, rtol=1e-6)


def test_classes_are_read_at_their_centres():
    middle = np.sqrt(0.5)  # 45 degrees: between the classes 26 and 27
    azimuth = np.array([0, 17.5, 26.5, 17.5, 35])
    elevation = np.array([17.5, 17.5, 17.5, 26.5, 35])
    intensity = np.array([0, 9.5, 19, 4, 1])
    directions, intensities = gcnet_lights.decode(azimuth, elevation, intensity)
    lean, stand = np.sin(np.deg2rad(87.5)), np.cos(np.deg2rad(87.5))
    expected = [
        [-lean, 0, stand],
        [0, 0, 1],
        [middle, 0, middle],
        [0, middle, middle],
        [stand * lean, lean, stand * stand],
    ]
    np.testing.assert_allclose(directions, expected, atol=1e-6)
    np.testing.assert_allclose(intensities[:, 0], [0.245, 1.1, 1.955, 0.605, 0.335])
    # Every centre belongs to its class.
    every = np.arange(36)
    directions, _ = gcnet_lights.decode(every, every[::-1], 0)
    _, intensities = gcnet_lights.decode(0, 0, every[:20])
    found = gcnet_lights.encode(directions, np.ones(36))
    np.testing.assert_array_equal(found[0], every)
    np.testing.assert_array_equal(found[1], every[::-1])
    _, _, found = gcnet_lights.encode(np.array([0.0, 0, 1]), intensities[:, 0])
    np.testing.assert_array_equal(found, every[:20])


def test_soft_lights_expect_and_hard_lights_choose():
    logits = np.full((3, 36), -50.0)
    logits[0, [20, 22]] = np.log([1, 3])  # 21.5 expected
    logits[1, [4, 8]] = np.log([1, 3])  # 7 expected
    logits[2, [0, 10]] = np.log([1, 3])  # 7.5 expected
    given = gcnet_lights.Logits(logits[0], logits[1], logits[2, :20], np.zeros(0))
    for read, classes in (
        (soft_lights, (21.5, 7, 7.5)),
        (gcnet_lights.hard_lights, (22, 8, 10)),
    ):
        for found, expected in zip(
            read(given), gcnet_lights.decode(*classes), strict=True
        ):
            np.testing.assert_allclose(found, expected, atol=1e-5)


def test_counts_of_parameters(params):
    def count(tree):
        return sum(leaf.size for leaf in jax.tree.leaves(tree))

    assert count(params["gcnet"]["light_1"]) == 1_784_252
    assert count(params["gcnet"]["light_2"]) == 1_785_404
    assert count(params["gcnet"]["coarse"]) == 1_083_152
    assert count(params["gcnet"]) == 4_652_808
    assert count(params["ps_fcn"]) == 2_210_048
    assert count(params["lcnet"]) == 4_409_692


def test_converter_reports_everything_at_once():
    arrays = made_up("gcnet")
    assert len(arrays) == 91
    del arrays["L_Net1.featExtractor.conv1.0.bias"]
    del arrays["N_Net.regressor.est_normal.0.weight"]
    arrays["L_Net1.surprise"] = np.zeros(3, np.float32)
    arrays["L_Net2.featExtractor.conv1.0.weight"] = np.zeros((32, 4, 3, 3), np.float32)
    with pytest.raises(InputError, match="gcnet: 4 problems") as error:
        gcnet_weights.from_official(arrays)
    for part in (
        "missing L_Net1.featExtractor.conv1.0.bias",
        "missing N_Net.regressor.est_normal.0.weight",
        "unexpected L_Net1.surprise",
        r"L_Net2.featExtractor.conv1.0.weight: expected shape (32, 8, 3, 3), got "
        "(32, 4, 3, 3)",
    ):
        assert part in str(error.value)
    with pytest.raises(InputError, match="not the arrays of GCNet"):
        gcnet_weights.from_official({"weight": np.zeros(3)})


def test_converter_tells_networks_apart_and_strips_a_prefix():
    for network, count in (("gcnet", 91), ("ps_fcn", 19), ("lcnet", 34)):
        arrays = {f"module.{k}": v for k, v in made_up(network).items()}
        assert len(arrays) == count
        assert gcnet_weights.identify(arrays) == network
        found = gcnet_weights.from_official(arrays)
        plain = gcnet_weights.from_official(made_up(network), network)
        jax.tree.map(np.testing.assert_array_equal, found, plain)


def test_files_return_what_was_saved(tmp_path, params):
    path = tmp_path / "lcnet.safetensors"
    gcnet_weights.save_params(path, params["lcnet"], "lcnet")
    found, network = gcnet_weights.load_params(path)
    assert network == "lcnet"
    jax.tree.map(np.testing.assert_array_equal, found, params["lcnet"])
    with pytest.raises(InputError, match="cannot read the weights"):
        gcnet_weights.load_params(tmp_path / "absent.safetensors")
    path.write_bytes(b"not weights")
    with pytest.raises(InputError, match="cannot read the weights"):
        gcnet_weights.load_params(path)
