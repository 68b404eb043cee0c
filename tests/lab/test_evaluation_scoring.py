"""Protocols, scores and methods."""

import json
import re
import tracemalloc
from pathlib import Path

import evaluation_data as data
import numpy as np
import pytest

from unips_jax.baselines.gcnet import pipeline
from unips_jax.baselines.gcnet.parameters import save_params
from unips_jax.baselines.method import Lights, Observed
from unips_jax.errors import InputError
from unips_jax.estimation import streaming
from unips_jax.evaluation import protocols
from unips_jax.evaluation.benchmarks import Item
from unips_jax.evaluation.methods import UnipsOptions, load_variants
from unips_jax.evaluation.protocols import Box, Protocol
from unips_jax.evaluation.registry import CLASSICAL
from unips_jax.evaluation.scores import best_signs, from_json, score

NO_WEIGHTS = UnipsOptions(())


def item_of(images, mask, normals=None, **rest):
    fields = {"lights": None, "focal": None, "tags": {"object": "x"}, "notes": ()}
    return Item("x", images, mask, normals, **{**fields, **rest})


# Protocols


def test_box_is_square_around_the_mask_with_a_margin():
    mask = np.zeros((40, 60), bool)
    mask[10:17, 20:40] = True
    assert protocols.square_box(mask) == Box(10 - (28 - 7) // 2, 20 - 4, 28)


def test_crop_of_its_own_size_passes_unchanged():
    rng = np.random.default_rng(0)
    mask = np.zeros((30, 33), bool)
    mask[7:15, 9:20] = rng.random((8, 11)) < 0.7
    mask[7, 9] = mask[14, 19] = True
    images = rng.integers(0, 65536, (3, 30, 33, 3), dtype=np.uint16)
    normals = rng.normal(size=(30, 33, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    case = protocols.show(
        item_of(images, mask, normals, focal=50.0), Protocol("crop", 19), [2, 0]
    )
    rows, columns = slice(2, 21), slice(5, 24)
    np.testing.assert_array_equal(case.observed.mask, mask[rows, columns])
    expected = images[[2, 0], rows, columns] / np.float32(65535)
    np.testing.assert_array_equal(
        case.observed.images, np.where(case.observed.mask[..., None], expected, 0)
    )
    np.testing.assert_allclose(
        case.normals[case.observed.mask],
        normals[rows, columns][case.observed.mask],
        atol=1e-6,
    )
    assert case.observed.focal == 50


def test_a_pixel_of_the_crop_is_the_objects_if_half_of_it_is():
    mask = np.zeros((16, 16), bool)
    mask[4:12, 4:12] = True
    mask[4, 4:6] = mask[5, 4] = False  # a quarter is left
    mask[4, 10:12] = False  # a half
    expected = np.zeros((8, 8), bool)
    expected[2:6, 2:6] = True
    expected[2, 2] = False
    found = protocols.shown_mask(mask, Protocol("crop", 8))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("protocol", [Protocol("native"), Protocol("crop", 8)])
def test_chosen_images_have_their_own_lights(protocol):
    lights = Lights(np.eye(3), np.arange(9.0).reshape(3, 3))
    images = np.arange(3.0)[:, None, None, None] * np.ones((3, 12, 12, 3))
    item = item_of(images, np.ones((12, 12), bool), lights=lights)
    seen = protocols.show(item, protocol, [2, 0]).observed
    assert [image.max() for image in seen.images] == [2, 0]
    np.testing.assert_array_equal(seen.lights.directions, np.eye(3)[[2, 0]])
    np.testing.assert_array_equal(seen.lights.intensities, [[6, 7, 8], [0, 1, 2]])


def test_crop_averages_masked_pixels_alone():
    mask = np.zeros((16, 16), bool)
    mask[4:12, 4:12] = True
    mask[4, 4] = False
    images = np.full((1, 16, 16, 3), 7.0, np.float32)
    images[0, 4, 4] = 1000
    images[0, 5, 4] = 10
    case = protocols.show(item_of(images, mask, focal=32.0), Protocol("crop", 8), [0])
    assert case.observed.mask[2:6, 2:6].all() and case.observed.mask.sum() == 16
    np.testing.assert_allclose(case.observed.images[0, 2, 2], 8)
    np.testing.assert_allclose(case.observed.images[0, 3, 3], 7)
    assert (case.observed.images[0, 0] == 0).all()
    assert case.observed.focal == 16


def test_crop_beyond_the_border_is_black():
    mask = np.ones((10, 10), bool)
    images = np.full((1, 10, 10, 3), 255, np.uint8)
    case = protocols.show(item_of(images, mask), Protocol("crop", 18), [0])
    np.testing.assert_array_equal(case.observed.mask, np.pad(mask, 4))
    np.testing.assert_array_equal(case.observed.images[0, ..., 0], np.pad(mask, 4))


def test_crop_keeps_zero_normals_zero_and_others_unit():
    mask, normals = data.sphere(64, 64)
    normals = np.where(np.arange(64)[:, None, None] < 32, normals, 0)
    images = np.ones((1, 64, 64, 3), np.float32)
    case = protocols.show(
        item_of(images, mask, normals.astype(np.float32)), Protocol("crop", 24), [0]
    )
    length = np.linalg.norm(case.normals, axis=-1)
    assert set(np.round(length, 5).ravel()) == {0, 1}
    assert (length[case.observed.mask] == 0).sum() > 50


@pytest.mark.parametrize("radius", [14, 60])  # the crop enlarges, or shrinks
@pytest.mark.parametrize("background", [np.nan, np.inf])
def test_what_is_not_finite_counts_on_the_object_alone(radius, background):
    mask, normals = data.sphere(150, 150, radius=radius)
    protocol = Protocol("crop", 64)
    shown = protocols.shown_mask(mask, protocol)
    true = protocols.shown_normals(normals, mask, protocol)
    around = np.where(mask[..., None], normals, background)
    found = protocols.shown_normals(around, mask, protocol)
    np.testing.assert_array_equal(found, true)
    around[75, 75] = np.nan
    counted = score(protocols.shown_normals(around, mask, protocol), true, shown)
    assert 0 < counted.invalid < 60 and counted.mae > 0.02


@pytest.mark.parametrize("protocol", [Protocol("native"), Protocol("crop", 64)])
def test_images_are_held_once(protocol):
    mask = np.zeros((64, 64), bool)
    mask[4:60, 4:60] = True  # the crop is the whole image
    item = item_of(np.ones((40, 64, 64, 3), np.uint8), mask)
    tracemalloc.start()
    case = protocols.show(item, protocol, range(40))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert case.observed.images.shape == (40, 64, 64, 3)
    assert peak < 1.3 * case.observed.images.nbytes


def test_focal_of_unknown_cameras_is_the_papers():
    mask, _ = data.sphere(32, 32)
    item = item_of(np.ones((1, 32, 32, 3), np.float32), mask)
    crop = Protocol("crop", 16)
    assert protocols.show(item, crop, [0]).observed.focal is None
    assert protocols.show(item, crop, [0], crop_focal_ratio=1.0).observed.focal == 16
    flat = item._replace(focal=np.inf)  # an orthographic camera is a known one
    assert (
        protocols.show(flat, crop, [0], crop_focal_ratio=1.0).observed.focal == np.inf
    )
    native = protocols.show(item, Protocol("native"), [0], crop_focal_ratio=1.0)
    assert native.observed.focal is None


def test_subsets_are_nested_fixed_and_sorted():
    chosen = [protocols.choose_images(n, 32, seed=0) for n in (1, 4, 8, 16, 32)]
    for smaller, larger in zip(chosen, chosen[1:], strict=False):
        assert set(smaller) < set(larger)
    np.testing.assert_array_equal(chosen[-1], np.arange(32))
    np.testing.assert_array_equal(chosen[1], FOUR_OF_32)
    other = protocols.choose_images(4, 32, seed=1)
    assert other.tolist() != chosen[1].tolist()


FOUR_OF_32 = [7, 8, 21, 27]


def test_protocol_is_checked():
    with pytest.raises(InputError, match="crop or native"):
        Protocol("squint")
    with pytest.raises(InputError, match="at least 8"):
        Protocol("crop", 4)


# Scores


def test_score_by_hand():
    true = data.tilted(0, 10, 20, 40, 80, 100, 0, 15.1, 44.9, 0, 7)
    true[0, 6] = 0
    estimate = data.tilted(0, 14, 30, 65, 40, 100, 5, 26.5, 56.0, 178.6, 7)
    estimate[0, 5] = np.nan
    estimate[0, 10] = 0
    mask = np.ones((1, 11), bool)
    found = score(estimate.astype(np.float32), true.astype(np.float32), mask)
    errors = [0, 4, 10, 25, 40, 90, 90, 11.4, 11.1, 178.6, 90]
    assert found.pixels == 11
    assert found.mae == pytest.approx(np.mean(errors), abs=1e-4)
    assert found.median == pytest.approx(25, abs=1e-4)
    shares = [100 * n / 11 for n in (2, 4, 5, 6)]  # below 5, 11.25, 22.5, 30 degrees
    np.testing.assert_allclose(found.within, shares)
    assert found.histogram[90] == 3 and found.histogram[178] == 1
    assert sum(found.histogram) == 11 and len(found.histogram) == 180
    assert found.histogram[11] == 2
    # The true normal of zero length is 90 degrees from the viewer: the last bin.
    assert found.view_pixels == (4, 2, 2, 0, 0, 3)
    sums = (4 + 178.6 + 90, 21.4, 36.1, 0, 0, 220)
    np.testing.assert_allclose(found.view_sums, sums, atol=1e-3)
    assert (found.zero_truth, found.invalid) == (1, 2)
    again = from_json(json.loads(json.dumps(found._asdict())))
    assert again == found


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, -1)])
def test_best_signs_are_those_closest_on_the_object(signs):
    mask, normals = data.sphere(24, 24, radius=6)
    around = np.array([0.6, 0.64, 0.48])  # which other signs would suit
    estimate = np.where(mask[..., None], normals * signs, around)
    true = np.where(mask[..., None], normals, -around * signs)
    found = best_signs(estimate.astype(np.float32), true, mask)
    np.testing.assert_allclose(found[mask], normals[mask], atol=1e-6)


def test_score_counts_only_the_mask():
    true, estimate = data.tilted(0, 0), data.tilted(10, 90)
    found = score(estimate, true, np.array([[True, False]]))
    assert found.pixels == 1 and found.mae == pytest.approx(10, abs=1e-4)


# Methods


def test_options_are_read_and_reach_the_method():
    request = "least-squares:colour=mean,keep=(0.2,0.8)"
    variant, constant = load_variants([request], NO_WEIGHTS)
    assert variant.label == "least-squares:colour=mean,keep=(0.2, 0.8)"
    assert constant.label == "constant"
    assert variant.key["options"] == {"colour": "mean", "keep": (0.2, 0.8)}


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ("phong", "no method 'phong'"),
        ("l1:iterations", "expected option=value"),
        ("l1:steps=3", "steps"),
        ("least-squares:keep=(0.9,0.1)", "0 <= low < high <= 1"),
        ("least-squares:colour=stronges", "colour: expected .*'stronges'"),
        ("l1:iterations=2.5", "iterations: expected int, got 2.5"),
        ("rpca:growth=fast", "growth: expected float, got 'fast'"),
        ("mpm:merge=range", "merge: expected .*, got 'range'"),
        ("hemisphere:volume=-1", "volume: expected pixels > 0"),
        ("gcnet", "expected a file of weights"),
        ("gcnet:weights=nowhere.safetensors", "expected a file of weights"),
        ("unips:size=3", "--canonical-size"),
        ("unips:lights=False", "expected fast=true, lights=true, lights=20"),
    ],
)
def test_bad_requests(request_, message):
    with pytest.raises(InputError, match=message):
        load_variants([request_], NO_WEIGHTS)


def test_classical_is_what_is_said_of_it():
    page = Path(__file__).parents[2] / "docs" / "evaluation.md"
    (said,) = re.findall(r"`classical` stands for ([^.]*)\.", page.read_text())
    assert re.findall(r"`([^`]*)`", said) == CLASSICAL


@pytest.mark.parametrize("name", ["classical", "variational", "mpm"])
def test_baselines_are_where_the_registry_says(name):
    assert load_variants([name], NO_WEIGHTS)[-1].label == "constant"


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ("gcnet:weights=GCNET", "add ,normals=woodham"),
        ("lcnet:weights=LCNET,margin=3", "add ,normals=woodham"),
        ("gcnet:weights=LCNET,normals=woodham", "expected the weights of gcnet, but"),
        ("ps-fcn:weights=GCNET", "expected the weights of ps_fcn, but"),
        ("gcnet:weights=GCNET,normals=LCNET", "expected the weights of ps_fcn, but"),
        ("gcnet:weights=GCNET,normals=ps-fcn", "such as woodham, got 'ps-fcn'"),
        ("gcnet:weights=GCNET,normals=no.file", "such as woodham, got 'no.file'"),
        ("gcnet:weights=OTHER,normals=woodham", "cannot read the weights"),
    ],
)
def test_what_gcnet_lacks_is_told_before_any_work(request_, message, tmp_path):
    (tmp_path / "OTHER").write_bytes(b"of something else")
    for network in ("gcnet", "lcnet"):
        path = tmp_path / network.upper()
        save_params(path, {"a": {"b": np.zeros(1)}}, network)
    for name in ("GCNET", "LCNET", "OTHER"):
        request_ = request_.replace(name, str(tmp_path / name))
    with pytest.raises(InputError, match=message):
        load_variants([request_], NO_WEIGHTS)


def test_estimated_lights_need_no_scale(tmp_path, monkeypatch):
    save_params(tmp_path / "w", {"a": {"b": np.zeros(1)}}, "gcnet")
    request = f"gcnet:weights={tmp_path / 'w'},normals=woodham"
    variant, _ = load_variants([request], NO_WEIGHTS)
    mask, normals = data.sphere(20, 20)
    directions = data.lights(6)
    images = data.shade(normals, directions).astype(np.float32)
    estimates = []
    for scale in (0.1, 1, 10):
        found = Lights(directions, np.full((6, 3), scale, np.float32))
        monkeypatch.setattr(pipeline, "estimate_lights", lambda *_, f=found, **__: f)
        estimates.append(variant.run(Observed(images, mask)).normals)
    assert score(estimates[0], normals, mask).mae < 6
    for estimate in estimates[1:]:
        np.testing.assert_allclose(estimate, estimates[0], atol=1e-4)


def test_what_a_row_must_tell_is_in_its_label(tmp_path):
    weights = tmp_path / "mine.safetensors"
    save_params(weights, {"a": {"b": np.zeros(1)}}, "gcnet")
    request = f"gcnet:weights={weights},normals=woodham,per=stack"
    oracle, gcnet, _ = load_variants(["mpm:sign=oracle", request], NO_WEIGHTS)
    assert gcnet.label == "gcnet:weights=mine,normals=woodham,per=stack,norm=range01"
    assert oracle.label == "mpm\N{DAGGER}" and oracle.oracle
    assert "chosen by the truth" in oracle.about


def test_unips_variants_get_their_own_settings(tmp_path, monkeypatch):
    def estimate(network, images, mask, *, lights, fast, uniform_contexts):
        assert lights is None and not fast
        return network.config.canonical_size, uniform_contexts

    monkeypatch.setattr(streaming, "estimate_photographs", estimate)
    weights = data.small_weights(tmp_path / "a.safetensors")
    options = UnipsOptions([str(weights)], (32, 48), True)
    variants = load_variants(["unips"], options)
    assert {
        variant.label: variant.run(Observed(None, None)) for variant in variants[:-1]
    } == {
        "unips canonical 32": (32, False),
        "unips canonical 32 uniform contexts": (32, True),
        "unips canonical 48": (48, False),
        "unips canonical 48 uniform contexts": (48, True),
    }
    keys = {json.dumps(variant.key, sort_keys=True) for variant in variants}
    assert len(keys) == 5
    for sizes, label in (((48,), "unips canonical 48"), ((32,), "unips")):
        options = UnipsOptions([str(weights)], sizes)
        assert load_variants(["unips"], options)[0].label == label
    monkeypatch.setattr(streaming, "estimate_photographs", lambda *_, fast, **__: fast)
    fast, plain, _ = load_variants(
        ["unips:fast=true", "unips"], UnipsOptions([str(weights)])
    )
    assert fast.run(Observed(None, None)) and not plain.run(Observed(None, None))


def test_the_oracle_works_for_unips_too(tmp_path):
    weights = data.small_weights(tmp_path / "a.safetensors")
    options = UnipsOptions([str(weights)])
    oracle, plain, _ = load_variants(["unips:sign=oracle", "unips"], options)
    assert (oracle.label, plain.label) == ("unips\N{DAGGER}", "unips")
    assert oracle.oracle and not plain.oracle and oracle.key != plain.key
    assert "chosen by the truth" in oracle.about


def test_weights_are_known_by_their_contents(tmp_path):
    first = data.small_weights(tmp_path / "a.safetensors")
    copy = data.small_weights(tmp_path / "b.safetensors")
    other = data.small_weights(tmp_path / "c.safetensors", seed=1)
    options = UnipsOptions([str(first), str(copy), str(other)])
    a, b, c, _ = load_variants(["unips"], options)
    assert a.key == b.key != c.key
    assert [a.label, c.label] == ["unips a", "unips c"]
    with pytest.raises(InputError, match="two methods"):
        load_variants(["unips"], UnipsOptions([str(first), str(first)]))
    with pytest.raises(InputError, match="multiple of 4"):
        load_variants(["unips"], UnipsOptions([str(first)], (33,)))
