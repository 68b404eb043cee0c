"""Wide colours that a file states without a profile."""

import struct

import numpy as np
import OpenEXR
import pytest
from colour_profiles import ADOBE, P3, chunk, tagged_png
from picture_files import save, smooth
from PIL import Image, features

from unips_jax.io.color import (
    ADOBE_RGB,
    PRIMARIES,
    encoding_of,
    icc_to_srgb,
    primaries_to_srgb,
    srgb_encode,
)
from unips_jax.io.images import read_image, read_image_file, read_linear
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select

BT2020, DISPLAY_P3 = PRIMARIES[9], PRIMARIES[12]
# IEC 61966-2-1: XYZ to linear sRGB.
TO_SRGB = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)


@pytest.mark.parametrize("primaries", [BT2020, DISPLAY_P3, ADOBE_RGB])
def test_colours_have_their_chromaticities(primaries):
    """Red, green and blue as sRGB are, as XYZ, where the standard has them."""
    matrix = primaries_to_srgb(primaries)
    xyz = np.linalg.solve(TO_SRGB, np.column_stack([matrix, np.ones(3)]))
    expected = np.reshape(primaries, (4, 2)).T
    np.testing.assert_allclose(xyz[:2] / xyz.sum(axis=0), expected, atol=1e-3)
    np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-6)  # white is white


def test_published_matrices():
    """ITU-R BT.2087 (BT.709 to BT.2020), and Adobe RGB (1998), 4.3.5.3 (to XYZ)."""
    to_2020 = [
        [0.6274, 0.3293, 0.0433],
        [0.0691, 0.9195, 0.0114],
        [0.0164, 0.0880, 0.8956],
    ]
    found = primaries_to_srgb(BT2020)
    np.testing.assert_allclose(np.linalg.inv(found), to_2020, atol=1e-4)
    to_xyz = [
        [0.57667, 0.18556, 0.18823],
        [0.29734, 0.62736, 0.07529],
        [0.02703, 0.07069, 0.99134],
    ]
    found = primaries_to_srgb(ADOBE_RGB)
    np.testing.assert_allclose(found, TO_SRGB @ to_xyz, atol=1e-3)
    for primaries, icc in ((DISPLAY_P3, P3), (ADOBE_RGB, ADOBE)):
        found = primaries_to_srgb(primaries)
        np.testing.assert_allclose(found, icc_to_srgb(icc), atol=2e-3)


def test_another_white_is_adapted():
    """ACEScg's is near D60; its matrix to sRGB as OpenColorIO's ACES has it."""
    aces = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    expected = [
        [1.70505, -0.62179, -0.08326],
        [-0.13026, 1.14080, -0.01055],
        [-0.02400, -0.12897, 1.15297],
    ]
    np.testing.assert_allclose(primaries_to_srgb(aces), expected, atol=1e-3)


@pytest.mark.parametrize(
    "chromaticities",
    [
        (),
        (0.64, 0.33),
        (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329),
        (0.0,) * 8,
        (float("nan"),) * 8,
        (0.3,) * 8,
    ],
)
def test_colours_that_are_srgb_or_none(chromaticities):
    assert primaries_to_srgb(chromaticities) is None
    encoding = encoding_of(np.uint8, primaries=chromaticities)
    assert encoding.to_srgb is None and encoding.rule == "8-bit values"


def require_colors(path, primaries):
    """Requires colours of chromaticities, whose pixels are as stored."""
    file = read_image_file(path)
    expected = primaries_to_srgb(primaries)
    np.testing.assert_allclose(file.encoding.to_srgb, expected, atol=1e-6)
    assert file.encoding.rule.endswith("; colours of its own")
    return file


@pytest.mark.parametrize("transfer", [1, 8, 13, 16])
@pytest.mark.parametrize("code", [1, 2, 9, 12])
def test_codes_of_png(tmp_path, code, transfer):
    coded = chunk(b"cICP", bytes([code, transfer, 0, 1]))
    path = tagged_png(tmp_path / "a.png", smooth(np.uint8), coded)
    if code in PRIMARIES:
        require_colors(path, PRIMARIES[code])
    else:
        assert read_image_file(path).encoding.to_srgb is None
    np.testing.assert_array_equal(read_image(path), smooth(np.uint8))


def test_a_colour_of_a_phone(tmp_path):
    """sRGB's red, as Display P3 has it."""
    light = np.linalg.inv(primaries_to_srgb(DISPLAY_P3)) @ [0.6, 0.03, 0.03]
    pixels = np.rint(255 * srgb_encode(light)).astype(np.uint8)
    pixels = np.broadcast_to(pixels, (8, 9, 3))
    coded = chunk(b"cICP", bytes([12, 13, 0, 1]))
    path = tagged_png(tmp_path / "a.png", pixels, coded)
    np.testing.assert_allclose(read_linear(path)[4, 4], [0.6, 0.03, 0.03], atol=4e-3)
    save(tmp_path / "b.png", pixels)
    (note,) = read_capture(select(tmp_path)).notes
    assert "of other colours than a.png's: b.png" in note


@pytest.mark.parametrize(
    ("kind", "profile"), [("avif", b""), ("avif", ADOBE), ("heic", b"")]
)
def test_codes_of_avif_and_heic(tmp_path, kind, profile):
    path = tmp_path / f"a.{kind}"
    image = Image.fromarray(smooth(np.uint8, height=48, width=64))
    if kind == "avif":
        if not features.check("avif"):
            pytest.skip("Pillow has no AVIF here")
        image.save(path, quality=90, icc_profile=profile)
    else:
        heif = pytest.importorskip("pillow_heif")
        file = heif.from_bytes("RGB", image.size, image.tobytes())
        file.save(path, quality=-1, chroma=444)
    data = path.read_bytes()
    at = data.index(b"colrnclx") + 8
    for code in (9, 12):
        path.write_bytes(data[:at] + struct.pack(">H", code) + data[at + 2 :])
        if profile:  # comes first
            found = read_image_file(path).encoding.to_srgb
            np.testing.assert_array_equal(found, icc_to_srgb(profile))
        else:
            require_colors(path, PRIMARIES[code])


def dcf(index, space=0xFFFF):
    """EXIF data of a camera's colour space."""
    exif = Image.Exif()
    exif[0x010F] = "Camera"
    exif.get_ifd(0x8769)[0xA001] = space
    exif.get_ifd(0x8769)[0xA005] = {1: index}
    return exif


def test_adobe_rgb_of_cameras(tmp_path):
    image = Image.fromarray(smooth(np.uint8))
    path = tmp_path / "a.jpg"
    for suffix in ("jpg", "webp"):
        path = tmp_path / f"a.{suffix}"
        image.save(path, exif=dcf("R03"))
        assert require_colors(path, ADOBE_RGB).encoding.transfer == "srgb"
        assert read_image_file(path).header.camera == "Camera"
    for index, space in (("R98", 0xFFFF), ("R98", 1), ("R03", 1)):
        image.save(path, exif=dcf(index, space))
        assert read_image_file(path).encoding.to_srgb is None
    image.save(path, exif=dcf("R03"), icc_profile=P3)
    found = read_image_file(path).encoding.to_srgb
    np.testing.assert_array_equal(found, icc_to_srgb(P3))
    plain = Image.Exif()  # without a mark colours are not known
    plain.get_ifd(0x8769)[0xA001] = 0xFFFF
    image.save(path, exif=plain)
    assert read_image_file(path).encoding.to_srgb is None


def test_an_srgb_chunk_overrules_exif_data(tmp_path):
    exif = chunk(b"eXIf", dcf("R03").tobytes()[6:])
    path = tagged_png(tmp_path / "a.png", smooth(np.uint8), exif)
    require_colors(path, ADOBE_RGB)
    tagged_png(path, smooth(np.uint8), chunk(b"sRGB", b"\0"), exif)
    assert read_image_file(path).encoding.to_srgb is None


def test_chromaticities_of_exr(tmp_path):
    path = tmp_path / "a.exr"
    pixels = smooth(np.float32)
    header = {"chromaticities": DISPLAY_P3}
    OpenEXR.File(header, {"RGB": pixels}).write(str(path))
    found = require_colors(path, DISPLAY_P3)
    np.testing.assert_array_equal(found.pixels, pixels)
    matrix = primaries_to_srgb(DISPLAY_P3)
    expected = np.maximum(pixels @ matrix.T, 0)
    np.testing.assert_allclose(read_linear(path), expected, atol=1e-5)
