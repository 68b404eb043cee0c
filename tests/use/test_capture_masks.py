"""Masks suggested from photographs, and by a box or strokes."""

import json

import cv2
import numpy as np
import pytest
from estimate_runs import run
from plain_objects import HARD, PLAIN, photographs

from unips_jax.capture.grabcut import grabcut_mask, strokes
from unips_jax.capture.masks import TRUSTED, mask_picture, suggest_mask
from unips_jax.errors import InputError
from unips_jax.io.color import as_linear, srgb_encode
from unips_jax.io.images import read_image
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select


def overlap(mask, truth):
    return (mask & truth).sum() / (mask | truth).sum()


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("name", PLAIN)
def test_masks_on_plain_backgrounds(name, seed):
    options = PLAIN[name]
    images, truth = photographs(seed, **options)
    transfer = "srgb" if options.get("srgb", True) else "linear"
    mask, figure = suggest_mask(images, transfer=transfer)
    assert figure >= TRUSTED and mask.dtype == bool
    assert overlap(mask, truth) >= 0.97


@pytest.mark.parametrize("name", HARD)
def test_no_guess_where_the_background_is_not_plain(name):
    images, _ = photographs(3, **HARD[name])
    mask, figure = suggest_mask(images)
    assert mask is None and 0 <= figure < TRUSTED


@pytest.mark.parametrize("table", [0.08, 0.2, 0.5])
@pytest.mark.parametrize("wall", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("albedo", [0.08, 0.6])
def test_a_table_before_a_wall_misleads_nobody(albedo, wall, table):
    images, truth = photographs(5, albedo=(albedo,) * 3, count=4)
    height = len(truth)
    behind = np.where(np.arange(height) < 0.7 * height, wall, table)[:, None, None]
    cover = cv2.GaussianBlur(truth.astype(np.float32), (0, 0), 0.7)[..., None]
    lit = as_linear(images, "srgb") * cover + 0.7 * behind * (1 - cover)
    mask, _ = suggest_mask(np.rint(srgb_encode(lit) * 255).astype(np.uint8))
    assert mask is None or overlap(mask, truth) >= 0.93


def test_nothing_to_see():
    for images in (np.zeros((2, 40, 50, 3), np.uint8), np.full((1, 9, 9, 3), 7.0, "f")):
        assert suggest_mask(images) == (None, 0.0)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_types_and_scale_do_not_matter(dtype):
    images, truth = photographs(5, background=0.02, count=3)
    expected = suggest_mask(images).mask
    scale = 257 if dtype == np.uint16 else 0.01
    mask, _ = suggest_mask((images * np.float64(scale)).astype(dtype))
    assert overlap(mask, expected) > 0.995


def test_large_photographs_have_outlines_of_their_own_pixels():
    images, truth = photographs(6, size=(900, 1200), background=0.02, count=3)
    mask, _ = suggest_mask(images)
    edge = cv2.morphologyEx(truth.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((7, 7)))
    assert not ((mask != truth) & (edge == 0)).any()
    assert overlap(mask, truth) > 0.995


def test_holes_that_show_the_background_stay_open_others_are_filled():
    images, truth = photographs(7, background=0.02)
    y, x = np.mgrid[: truth.shape[0], : truth.shape[1]]
    cy, cx = (int(n.mean()) for n in np.nonzero(truth))
    hole = np.hypot(y - cy, x - cx - 25) < 9
    speck = np.hypot(y - cy, x - cx + 20) < 2.5
    images[:, hole | speck] = images[:, :1, :1].mean(axis=(1, 2))[:, None]
    mask, _ = suggest_mask(images)
    assert overlap(~mask & hole, hole) > 0.8 and mask[speck].all()


@pytest.mark.parametrize("name", [*HARD][:2])
def test_a_box_or_strokes_find_the_object_where_colours_differ(name):
    images, truth = photographs(3, **HARD[name])
    picture = mask_picture(images)
    rows, columns = (np.flatnonzero(truth.any(axis=axis)) for axis in (1, 0))
    box = columns[0] - 4, rows[0] - 4, columns[-1] + 5, rows[-1] + 5
    y, x = int(rows.mean()), int(columns.mean())
    drawn = strokes(truth.shape, [[(x - 20, y), (x + 20, y)], [(x, y - 25)]])
    frame = strokes(truth.shape, [[(3, 3), (210, 3)], [(3, 175), (210, 175)]])
    assert drawn.sum() > 200 and drawn[y - 25, x]
    for how in ({"box": box}, {"inside": drawn}, {"inside": drawn, "outside": frame}):
        mask = grabcut_mask(picture, **how)
        assert overlap(mask, truth) > 0.93
        np.testing.assert_array_equal(mask, grabcut_mask(picture, **how))
    assert not (grabcut_mask(picture, box=box, outside=drawn) & drawn).any()


def test_what_grabcut_refuses():
    picture = np.zeros((40, 50, 3), np.uint8)
    nothing = np.zeros((40, 50), bool)
    for how, said in (
        ({}, "got neither; draw one"),
        ({"inside": nothing}, "got neither"),
        ({"box": (9, 3, 9, 20)}, "expected left < right"),
        ({"box": (0, 0, 50, 40)}, "got all of the picture"),
        ({"box": (3, 3, 20, 20), "inside": nothing[1:]}, "expected the picture's size"),
    ):
        with pytest.raises(InputError, match=said):
            grabcut_mask(picture, **how)
    with pytest.raises(InputError, match="expected .H, W, 3. of uint8"):
        grabcut_mask(picture / 255, box=(1, 1, 9, 9))


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "pot"
    folder.mkdir()
    images, truth = photographs(8, background=0.02, count=6)
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / f"{index}.png"), image[..., ::-1])
    return folder, truth


def test_estimate_takes_a_suggested_mask(folder, tmp_path, calls, capsys):  # noqa: F811
    folder, truth = folder
    assert run(folder, "-o", tmp_path / "out") == 0
    out, err = capsys.readouterr()
    assert "mask      suggested (contrast 0.9" in out and err == ""
    assert overlap(calls[0]["mask"], truth) > 0.97
    record = json.loads((tmp_path / "out/pot/normals.json").read_text())
    assert record["mask_suggested"] and record["mask_contrast"] >= TRUSTED
    written = read_image(tmp_path / "out/pot/mask.png")[..., 0]
    np.testing.assert_array_equal(written > 0, calls[0]["mask"])
    assert run(folder, "-o", tmp_path / "out") == 0
    assert len(calls) == 1  # up to date


def test_estimate_takes_the_whole_image_if_told(folder, tmp_path, calls, capsys):  # noqa: F811
    folder, truth = folder
    assert run(folder, "-o", tmp_path / "out", "--mask", "none") == 0
    assert calls[0]["mask"].all()
    assert not (tmp_path / "out/pot/mask.png").exists()
    cv2.imwrite(str(folder / "mask.png"), truth.astype(np.uint8) * 255)
    assert run(folder, "-o", tmp_path / "out") == 0
    np.testing.assert_array_equal(calls[1]["mask"], truth)
    assert run(folder, "-o", tmp_path / "out", "--mask", "none") == 0
    assert calls[2]["mask"].all()
    assert "mask.png (by --mask none)" in capsys.readouterr().out
    assert run(folder, "-o", tmp_path / "o", "--mask", folder / "mask.png") == 0
    np.testing.assert_array_equal(calls[3]["mask"], truth)


REAL = {  # figure at least, or at most; the overlap
    "photos/psbox_cat.data": 0.98,
    "photos/key.data": None,
    "diligent_dev/pmsData/ballPNG": 0.98,
    "diligent_dev/pmsData/pot1PNG": 0.96,
    "diligent_dev/pmsData/cowPNG": None,
    "diligent_dev/pmsData/readingPNG": None,
}


@pytest.mark.parametrize("name", REAL)
def test_real_photographs(shared_dir, name):
    selection = select(shared_dir / name, max_images=12)
    capture = read_capture(selection)
    transfer = "srgb" if "key" in name else "linear"
    mask, figure = suggest_mask(capture.images, transfer=transfer)
    if REAL[name] is None:
        assert mask is None and figure < 0.4
    else:
        assert overlap(mask, capture.mask) > REAL[name]


@pytest.mark.parametrize("size", [1, 2, 8, 16])
def test_tiny_photographs_have_no_mask_or_one_of_their_size(size):
    images = np.zeros((2, size, size, 3), np.uint8)
    images[:, size // 4 : size - size // 4, size // 4 : size - size // 4] = 200
    found = suggest_mask(images)
    assert 0 <= found.figure <= 1
    assert found.mask is None or found.mask.shape == (size, size)
