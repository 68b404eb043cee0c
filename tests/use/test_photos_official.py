"""The authors' reader, against the arrays that theirs produces."""

import numpy as np
import pytest

from unips_jax.errors import InputError
from unips_jax.io.images import write_image
from unips_jax.io.official_photographs import official_crop, read_official
from unips_jax.io.selection import select


@pytest.mark.parametrize(
    ("name", "size"),
    [("tall16", 128), ("wide8", 128), ("border8", 128), ("nomask16", 128)],
)
def test_test_folders(shared_dir, name, size):
    golden = np.load(shared_dir / "golden/reader_official.npz")
    folder = shared_dir / f"golden/reader/{name}.data"
    images, mask, normals = read_official(select(folder), size=size)
    np.testing.assert_array_equal(mask, golden[f"{name}.mask"] > 0)
    # Theirs is a float32 mean over some 10^4 values.
    np.testing.assert_allclose(images, golden[f"{name}.images"], rtol=0, atol=1e-5)
    assert normals is None


def test_training_folder(shared_dir):
    golden = np.load(shared_dir / "golden/reader_official.npz")
    folder = shared_dir / "golden/reader/train.data"
    images, mask, normals = read_official(select(folder), size=96)
    np.testing.assert_array_equal(mask, golden["train.mask"] > 0)
    np.testing.assert_allclose(images, golden["train.images"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(normals, golden["train.normals"], rtol=0, atol=1e-7)


def box(height, width, top, bottom, left, right):
    mask = np.zeros((height, width), bool)
    mask[top : bottom + 1, left : right + 1] = True
    return mask


def test_crop_is_square_around_the_mask():
    # Rows 20..59, columns 30..49: 4 pixels more each way, and 10 on the shorter side.
    crop = official_crop(box(100, 90, 20, 59, 30, 49))
    assert crop == (slice(16, 63), slice(30 - 4 - 10, 49 + 4 + 10))


@pytest.mark.parametrize("edges", [(4, 59, 30, 49), (20, 97, 30, 49), (20, 59, 30, 87)])
def test_no_crop_where_the_margin_touches_the_border(edges):
    assert official_crop(box(100, 90, *edges)) == (slice(None), slice(None))


def test_crop_is_clamped_to_the_image():
    rows, columns = official_crop(box(100, 40, 20, 79, 15, 24))
    assert (rows, columns) == (slice(16, 83), slice(0, 40))


def test_what_would_be_squashed_can_be_refused(tmp_path):
    for name in ("0.png", "1.png"):
        write_image(tmp_path / name, np.full((32, 64, 3), 90, np.uint8))
    whole = np.full((32, 64), 255, np.uint8)
    write_image(tmp_path / "mask.png", whole)
    assert read_official(select(tmp_path), size=32)[0].shape == (2, 32, 32, 3)
    with pytest.raises(InputError, match="makes 64 x 32 pixels square, and no depth"):
        read_official(select(tmp_path), size=32, keep_aspect=True)
    whole[:, :24] = whole[:, -24:] = 0
    whole[:8] = whole[-8:] = 0
    write_image(tmp_path / "mask.png", whole)
    read_official(select(tmp_path), size=32, keep_aspect=True)
