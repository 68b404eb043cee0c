"""Which pixels a mask marks."""

import cv2
import numpy as np
import pytest
from picture_files import HEIGHT, WIDTH, save, smooth
from PIL import Image

from unips_jax.errors import InputError
from unips_jax.io.color import srgb_encode
from unips_jax.io.images import read_image
from unips_jax.io.masks import lit_pixels, lit_without_mask, mask_box, read_mask
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select

FORMATS = [
    (".png", np.uint8),
    (".png", np.uint16),
    (".tif", np.uint8),
    (".webp", np.uint8),
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


@pytest.mark.parametrize("greys", [(0, 128, 255), (40, 180, 255)])
def test_cut_out_photograph_of_strong_contrast_is_a_mask(tmp_path, greys):
    """Its dark parts are the object's, as they would not be in a mask."""
    picture = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    picture[..., :3] = np.repeat(greys, WIDTH // 3 + 1)[None, :WIDTH, None]
    picture[4:17, 3:-3, 3] = 255
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
    picture[3:5, 4:8, :3], picture[5:, :, :3] = 100, 255  # hidden white decides nothing
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


def lit_disc(folder, suffix=".png", dtype=np.uint8, background=0):
    """Photographs of a disc, none of which shows all of it; gives the disc."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    disc = np.hypot(x - 18, y - 11) < 9
    for i in range(3):
        light = np.where(disc & (x % 3 != i), 0.5, 0)[..., None] * np.ones(3)
        top = np.iinfo(dtype).max if np.dtype(dtype).kind == "u" else 1
        image = np.where(disc[..., None], light * top, background).astype(dtype)
        save(folder / f"{i}{suffix}", image)
    return disc


@pytest.mark.parametrize(
    ("suffix", "dtype", "background"),
    [
        (".png", np.uint8, 0),
        (".png", np.uint8, 2),
        (".png", np.uint16, 0),
        (".exr", np.float32, 0),
    ],
)
def test_what_is_black_in_all_photographs_is_left_out(
    tmp_path, suffix, dtype, background
):
    disc = lit_disc(tmp_path, suffix, dtype, background)
    capture = read_capture(select(tmp_path))
    np.testing.assert_array_equal(capture.mask, disc)
    assert capture.notes == (
        f"{(~disc).sum()} pixels of the whole image (no mask) are black in all "
        "photographs: left out",
    )
    wide = np.zeros((HEIGHT, WIDTH), np.uint8)
    wide[:, 10:30] = 255
    save(tmp_path / "mask.png", wide)
    capture = read_capture(select(tmp_path))
    np.testing.assert_array_equal(capture.mask, disc & (wide > 0))
    assert "pixels of the mask are black in all photographs" in capture.notes[0]
    capture = read_capture(select(tmp_path), mask=wide > 0)  # benchmarks' are obeyed
    np.testing.assert_array_equal(capture.mask, wide > 0)
    assert capture.notes == ()


@pytest.mark.parametrize("quality", [75, 90])
def test_what_a_jpeg_leaves_around_an_object_is_left_out(tmp_path, quality):
    y, x = np.mgrid[:60, :80]
    disc = np.hypot(x - 40, y - 30) < 17
    for i in range(3):
        light = np.where(disc, 120 + 80 * np.sin(x / 9 + 2 * i), 0)
        image = np.repeat(light[..., None], 3, axis=-1).astype(np.uint8)
        stored = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        (tmp_path / f"{i}.jpg").write_bytes(stored.tobytes())
    capture = read_capture(select(tmp_path))
    noise = capture.images.max(axis=(0, 3)) > 2
    assert (noise & ~disc).sum() > 100
    assert (capture.mask & ~disc).sum() < 20 and not (disc & ~capture.mask).any()


def test_next_to_black_less_than_32_levels_are_left_out():
    """Of white light; of a darker picture as much less."""
    for level, black, white, kept in (
        (30, 0, 255, False),
        (36, 0, 255, True),
        (30, 4, 255, True),
        (30, 0, 150, True),
        (12, 0, 150, False),
    ):
        brightest = np.full((5, 9), white, np.uint8)
        brightest[:, :3], brightest[:, 3:6] = black, level
        lit = lit_pixels(brightest, "srgb", np.ones((5, 9), bool))
        assert lit[:, 6:].all() and (lit[:, 3:6] == kept).all()
        assert lit[:, :3].all() == (black > 2)


def test_white_is_the_objects_not_a_lamps_beside_it():
    brightest = np.full((5, 12), 255, np.uint8)
    brightest[:, :9] = np.repeat([0, 30, 150], 3)
    mask = np.zeros((5, 12), bool)
    mask[:, :9] = True
    assert lit_pixels(brightest, "srgb", mask)[:, 3:].all()


def test_nearly_black_is_a_share_of_light_however_values_encode_it():
    brightest = np.full((5, 9), 255, np.uint8)
    every = np.ones((5, 9), bool)
    brightest[:, :3], brightest[:, 3:6] = 0, 4  # 1.6 % of linear light
    assert lit_pixels(brightest, "linear", every)[:, 3:].all()
    assert not lit_pixels(brightest, "srgb", every)[:, 3:6].any()
    brightest[:, 3:6] = 3
    assert not lit_pixels(brightest, "linear", every)[:, 3:6].any()


def test_black_paint_of_photographs_that_are_dark_is_kept(tmp_path):
    """A ball half of which is black, 2 stops underexposed, as in 16 bits."""
    y, x = np.mgrid[-1:1:80j, -1:1:80j]
    disc = np.hypot(x, y) < 0.8
    z = np.sqrt(np.maximum(0.64 - x**2 - y**2, 0))
    for bits, top in ((8, 255), (16, 65535)):
        folder = tmp_path / str(bits)
        for i, light in enumerate([(0.5, 0, 0.8), (-0.5, 0, 0.8), (0, 0.5, 0.8)]):
            shade = np.maximum(np.tensordot(light, [x, y, z], 1), 0) * disc
            linear = shade * np.where(x < 0, 0.25, 0.012)
            values = linear if bits == 16 else srgb_encode(linear)
            image = np.rint(values * top).astype(f"uint{bits}")
            save(folder / f"{i}.png", np.dstack([image] * 3))
        save(folder / "mask.png", disc.astype(np.uint8) * 255)
        mask = read_capture(select(folder)).mask
        assert (mask & (x >= 0)).sum() > 0.95 * (disc & (x >= 0)).sum()


def test_dark_parts_of_an_object_are_kept(tmp_path):
    disc = lit_disc(tmp_path)
    for path in tmp_path.iterdir():
        image = read_image(path).copy()
        image[9:12, 15:20] = 20
        save(path, image)
    np.testing.assert_array_equal(read_capture(select(tmp_path)).mask, disc)


def test_dark_grey_is_not_black(tmp_path):
    lit_disc(tmp_path, background=60)  # 4.5% of light
    capture = read_capture(select(tmp_path))
    assert capture.mask.all() and capture.notes == ()


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
def test_photographs_that_are_cut_out(tmp_path, suffix):
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    alpha[5:19, 8:31] = 127
    alpha[6:18, 9:30] = 255
    for i in range(3):
        save(tmp_path / f"{i}{suffix}", np.dstack([smooth(np.uint8, i), alpha]))
    capture = read_capture(select(tmp_path))
    np.testing.assert_array_equal(capture.mask, alpha == 255)
    assert "are transparent in a photograph: left out" in capture.notes[0]
    half = np.full((HEIGHT, WIDTH), 255, np.uint8)
    half[:, :15] = 127  # nowhere transparent: no cut
    for i in range(3):
        save(tmp_path / f"{i}{suffix}", np.dstack([smooth(np.uint8, i), half]))
    assert read_capture(select(tmp_path)).mask.all()
    save(tmp_path / f"1{suffix}", np.dstack([smooth(np.uint8, 1), alpha]))
    alpha = np.roll(alpha, 7, axis=1)
    save(tmp_path / f"0{suffix}", np.dstack([smooth(np.uint8), alpha]))
    both = (alpha == 255) & (np.roll(alpha, -7, axis=1) == 255)
    np.testing.assert_array_equal(read_capture(select(tmp_path)).mask, both)


def test_masks_of_other_formats(tmp_path):
    save(tmp_path / "a.png", smooth(np.uint8))
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[3:9, 4:30] = True
    Image.fromarray(mask.astype(np.uint8) * 255).save(tmp_path / "mask.gif")
    np.testing.assert_array_equal(read_capture(select(tmp_path)).mask, mask)
    (tmp_path / "mask.gif").unlink()
    for name, top in (("mask.pgm", 255), ("mask.pnm", 7), ("mask.PGM", 1000)):
        stored = (mask * top).astype(">u2" if top > 255 else np.uint8).tobytes()
        header = f"P5\n# drawn by hand\n{WIDTH} {HEIGHT}\n{top}\n".encode()
        (tmp_path / name).write_bytes(header + stored)
        np.testing.assert_array_equal(read_capture(select(tmp_path)).mask, mask)
        (tmp_path / name).unlink()
    Image.fromarray(~mask).save(tmp_path / "mask.pbm")
    np.testing.assert_array_equal(read_capture(select(tmp_path)).mask, ~mask)


STORED = {
    "8 bits, sRGB": (np.uint8, "srgb"),
    "8 bits, linear": (np.uint8, "linear"),
    "16 bits": (np.uint16, "linear"),
    "16 bits, dark": (np.uint16, "linear"),
    "floats": (np.float32, "linear"),
}


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.012])
def test_black_is_black_whatever_the_bits(noise):
    """The brightest of photographs of an object in a dark room, without a mask."""
    rng = np.random.default_rng(3)
    height, width = 120, 160
    y, x = np.mgrid[:height, :width]
    distance = np.hypot(x - 80, y - 60) / 45
    inside = distance < 1
    light = np.where(inside, 0.05 + 0.8 * np.sqrt(np.maximum(1 - distance**2, 0)), 0)
    light = light + noise * (0.6 + 0.4 * rng.random(light.shape))
    found = {}
    for name, (dtype, transfer) in STORED.items():
        values = srgb_encode(light) if transfer == "srgb" else light
        values = values * 0.15 if "dark" in name else values
        if dtype != np.float32:
            values = np.rint(values * np.iinfo(dtype).max)
        found[name] = lit_without_mask(values.astype(dtype), transfer)
    for name, lit in found.items():
        assert (lit != inside).sum() < 0.01 * inside.sum(), name
    with_light = np.where(inside, light, 0.1).astype(np.float32)
    assert lit_without_mask(with_light, "linear").all()  # no black background


def test_noise_hides_no_object_of_four_percent_of_white():
    """Dim parts that reach the frame, before a dark background of much noise."""
    rng = np.random.default_rng(0)
    light = rng.uniform(0, 0.05, (60, 80)).astype(np.float32)
    light[20:40, 30:] = 0.04
    light[20:40, 30:60] = 1
    assert lit_without_mask(light, "linear")[20:40, 30:].all()


def test_hot_pixels_in_the_dark_are_no_object():
    light = np.zeros((90, 120), np.float32)
    light[20:70, 30:90] = 0.5
    inside = light > 0
    light[5::20, 7::20] = np.where(inside[5::20, 7::20], 0.5, 0.2)
    assert ((light > 0) & ~inside).sum() > 10
    np.testing.assert_array_equal(lit_without_mask(light, "linear"), inside)


def test_a_set_of_16_bits_and_its_twin_of_8(shared_dir):
    folder = shared_dir / "cases/black_background_16_bit"
    truth = read_mask(folder / "true_mask.png")
    masks = [
        read_capture(select(folder / name), transfer="linear").mask
        for name in ("bits8", "bits16")
    ]
    assert (masks[0] != masks[1]).sum() < 0.002 * truth.sum()
    for mask in masks:
        assert (mask != truth).sum() < 0.01 * truth.sum()
