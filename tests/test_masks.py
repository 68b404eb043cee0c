"""Which pixels a mask marks."""

import cv2
import numpy as np
import pytest
from test_photos import HEIGHT, WIDTH, save, smooth

from unips_jax.errors import InputError
from unips_jax.io.images import read_image
from unips_jax.io.masks import mask_box, read_mask

FORMATS = [
    *((".png", np.uint8), (".png", np.uint16)),
    *((".tif", np.uint8), (".webp", np.uint8)),
]


@pytest.mark.parametrize("top", [1, 2, 255])
@pytest.mark.parametrize("channel", range(3))
def test_inside_is_above_half_of_the_largest_value_of_any_colour(
    tmp_path, top, channel
):
    mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    mask[:, 20:] = top // 2
    mask[2:5, 3:9, channel] = top
    mask[5:8, 3:9, channel] = top // 2 + 1
    read = read_mask(save(tmp_path / "mask.png", mask))
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[2:8, 3:9] = True
    assert read.dtype == bool
    np.testing.assert_array_equal(read, expected)


@pytest.mark.parametrize(("suffix", "dtype"), FORMATS)
@pytest.mark.parametrize("colour", [0, 255])
def test_mask_of_one_colour_is_where_it_is_opaque(tmp_path, suffix, dtype, colour):
    top = np.iinfo(dtype).max
    picture = np.full((HEIGHT, WIDTH, 4), colour, dtype)
    picture[..., 3] = 0
    picture[2:5, 3:9, 3] = top // 2
    picture[8:, :, 3] = top
    read = read_mask(save(tmp_path / f"mask{suffix}", picture))
    np.testing.assert_array_equal(read, picture[..., 3] == top)


def test_cut_out_photograph_is_a_mask(tmp_path):
    """Colours are kept below the transparent part."""
    picture = np.dstack([smooth(np.uint8), np.zeros((HEIGHT, WIDTH, 1), np.uint8)])
    picture[4:17, 5:30, 3] = 255
    read = read_mask(save(tmp_path / "mask.png", picture))
    np.testing.assert_array_equal(read, picture[..., 3] > 0)


def test_transparent_parts_of_a_black_and_white_mask_are_outside(tmp_path):
    picture = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    picture[..., 3] = 255
    path = tmp_path / "mask.png"
    with pytest.raises(InputError, match=r"mask\.png: .* got 0 at most; paint"):
        read_mask(save(path, picture))
    picture[3:9, 4:8, :3] = 255
    picture[5:, :, 3] = 0
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[3:5, 4:8] = True
    np.testing.assert_array_equal(read_mask(save(path, picture)), expected)


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".png"])
def test_noise_of_compression_is_no_object(tmp_path, suffix):
    y, x = np.mgrid[:60, :80]
    disc = np.hypot(x - 40, y - 30) < 17
    quality = [cv2.IMWRITE_JPEG_QUALITY, 70, cv2.IMWRITE_WEBP_QUALITY, 70]
    lossy = ".jpg" if suffix == ".png" else suffix
    stored = cv2.imencode(lossy, disc.astype(np.uint8) * 255, quality)[1]
    if suffix == ".png":  # of a JPEG's pixels
        stored = cv2.imencode(".png", cv2.imdecode(stored, cv2.IMREAD_UNCHANGED))[1]
    path = tmp_path / f"mask{suffix}"
    path.write_bytes(stored.tobytes())
    assert (read_image(path)[~disc] > 0).any()
    np.testing.assert_array_equal(read_mask(path), disc)


def test_box():
    mask = np.zeros((11, 13), bool)
    mask[2, 5] = mask[7, 3] = True
    assert mask_box(mask) == (slice(2, 8), slice(3, 6))
    assert mask_box(mask, 3) == (slice(0, 11), slice(0, 9))
