"""A file's own tags say how its values encode light, before its type does."""

import dataclasses
import io
import struct
import zlib

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from colour_profiles import (
    ADOBE,
    P3,
    chunk,
    gamma_curve,
    parametric,
    tagged_png,
)
from picture_files import save, smooth
from PIL import Image, ImageCms
from plain_objects import hemisphere

from unips_jax import estimate_lights
from unips_jax.errors import InputError
from unips_jax.io.color import (
    CURVES,
    as_linear,
    encoding_of,
    icc_curve,
    icc_to_srgb,
    srgb_encode,
)
from unips_jax.io.images import read_image, read_image_file, read_linear
from unips_jax.io.photographs import read_capture, read_photographs
from unips_jax.io.selection import select
from unips_jax.lighting.light_files import base_color

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
X = np.linspace(0, 1, 1024)


def profile(curve: bytes) -> bytes:
    """No more of a profile than its tone curve."""
    tags = struct.pack(">I4sII", 1, b"gTRC", 144, len(curve))
    return bytes(128) + tags + curve


def png_profile(icc: bytes) -> bytes:
    return chunk(b"iCCP", b"name\0\0" + zlib.compress(icc))


LINEAR = profile(b"curv" + struct.pack(">II", 0, 0))
GAMMA_22 = chunk(b"gAMA", struct.pack(">I", 45455))
GAMMA_1 = chunk(b"gAMA", struct.pack(">I", 100000))


@pytest.mark.parametrize(
    ("curve", "expected"),
    [
        (gamma_curve(1.8), X**1.8),
        (b"curv" + struct.pack(">II3H", 0, 3, 0, 16384, 65535), None),
        (parametric(0, 1.8), X**1.8),
        (parametric(1, 2, 1.5, -0.5), np.maximum(1.5 * X - 0.5, 0) ** 2),
        (parametric(2, 2, 0.9, -0.2, 0.1), np.maximum(0.9 * X - 0.2, 0) ** 2 + 0.1),
        (parametric(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045), "srgb"),
        (parametric(4, 2, 0.9, 0.1, 0.5, 0.2, -0.05, 0.05), "seven"),
    ],
)
def test_tone_curves_of_profiles(curve, expected):
    if expected is None:
        expected = np.interp(X, [0, 0.5, 1], [0, 16384 / 65535, 1])
    elif isinstance(expected, str) and expected == "srgb":
        expected = as_linear(X.astype(np.float32), "srgb")
    elif isinstance(expected, str):
        expected = np.where(X >= 0.2, (0.9 * X + 0.1) ** 2 - 0.05, 0.5 * X + 0.05)
    found = icc_curve(profile(curve))
    np.testing.assert_allclose(found, np.clip(expected, 0, 1), atol=2e-4)


@pytest.mark.parametrize("cut", [0, 20, 131, 140, 143, 150])
def test_damaged_profiles_are_none(cut):
    assert icc_curve(profile(gamma_curve(1.8))[:cut]) is None
    tables = profile(b"mft2" + bytes(40))
    assert icc_curve(tables) is None
    assert encoding_of(np.uint16, icc=tables).transfer == "srgb"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    ("chunks", "transfer", "rule"),
    [
        ([png_profile(SRGB)], "srgb", "colour profile in the file, sRGB"),
        ([png_profile(LINEAR)], "linear", "colour profile in the file, linear"),
        ([chunk(b"sRGB", b"\0"), GAMMA_22], "srgb", "sRGB tag in the file"),
        ([GAMMA_22], "srgb", "gamma of 0.455 in the file, sRGB"),
        ([GAMMA_1], "linear", "gamma of 1 in the file, linear"),
        ([png_profile(LINEAR), chunk(b"sRGB", b"\0")], "linear", "profile"),
        ([chunk(b"cICP", b"\x01\x08\0\1"), png_profile(SRGB)], "linear", "linear code"),
        ([chunk(b"cICP", b"\x01\x0d\0\1"), GAMMA_1], "srgb", "sRGB code in the file"),
    ],
)
def test_tags_of_png(tmp_path, dtype, chunks, transfer, rule):
    pixels = smooth(dtype)
    tagged_png(tmp_path / "a.png", pixels, *chunks)
    capture = read_capture(select(tmp_path))
    assert capture.transfer == transfer and rule in capture.transfer_rule
    np.testing.assert_array_equal(capture.images[0], pixels)
    assert read_photographs(tmp_path).transfer == transfer


def test_tags_of_tiff_jpeg_and_webp(tmp_path):
    pixels = smooth(np.uint16)
    tags = [(34675, "B", len(SRGB), SRGB, True)]
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, pixels, photometric="rgb", extratags=tags)
    encoding = read_image_file(path).encoding
    assert (encoding.transfer, "profile" in encoding.rule) == ("srgb", True)
    jpeg = save(tmp_path / "a.jpg", smooth(np.uint8)).read_bytes()
    body = b"ICC_PROFILE\0\1\1" + LINEAR
    segment = b"\xff\xe2" + struct.pack(">H", len(body) + 2) + body
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])
    assert read_image_file(tmp_path / "a.jpg").encoding.transfer == "linear"
    webp = cv2.imencode(".webp", smooth(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])[1]
    chunk = b"ICCP" + struct.pack("<I", len(LINEAR)) + LINEAR
    body = b"WEBP" + webp.tobytes()[12:] + chunk + b"\0" * (len(LINEAR) % 2)
    path = tmp_path / "a.webp"
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
    assert read_image_file(path).encoding.transfer == "linear"


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.uint8, 6e-3), (np.uint16, 3e-5)])
def test_other_curves_are_made_srgb(tmp_path, dtype, tolerance):
    """As of ProPhoto, which raw converters write by default."""
    icc = png_profile(profile(gamma_curve(1.8)))
    path = tagged_png(tmp_path / "a.png", smooth(dtype), icc)
    capture = read_capture(select(tmp_path))
    assert capture.images.dtype == dtype and capture.transfer == "srgb"
    light = as_linear(capture.images[0], "srgb")
    expected = (read_image(path) / np.iinfo(dtype).max) ** (461 / 256)
    assert np.abs(light - expected).max() < tolerance
    np.testing.assert_array_equal(read_linear(path), light)
    chosen = read_capture(select(tmp_path), transfer="linear")
    np.testing.assert_array_equal(chosen.images[0], smooth(dtype))
    assert (chosen.transfer, chosen.transfer_rule) == ("linear", "--transfer")


LIGHT = np.linspace(0.002, 0.8, 40)


def values_of(code, light):
    """Values in [0, 1] that encode light by a transfer code."""
    x = np.linspace(0, 1, 100_001)
    return np.interp(light, CURVES[code][1](x), x)


@pytest.mark.parametrize("code", sorted(set(CURVES) - {9, 10}))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_transfer_codes_of_png(tmp_path, code, dtype):
    top = np.iinfo(dtype).max
    stored = np.rint(values_of(code, LIGHT) * top).astype(dtype)
    pixels = np.broadcast_to(stored[:, None, None], (40, 30, 3))
    coded = chunk(b"cICP", bytes([9, code, 0, 1]))
    tagged_png(tmp_path / "a.png", pixels, coded, png_profile(LINEAR), GAMMA_1)
    capture = read_capture(select(tmp_path))
    light = as_linear(capture.images[0, :, 0, 0], capture.transfer)
    step = np.gradient(CURVES[code][1](np.linspace(0, 1, 256))).max()
    tolerance = step if dtype == np.uint8 else 1e-3
    if capture.images.dtype == dtype:
        tolerance += 0.01  # so near to linear or sRGB that it is taken as such
    np.testing.assert_allclose(light, LIGHT, atol=tolerance)
    assert f"{CURVES[code][0]} code in the file" in capture.transfer_rule


def test_published_values_of_the_curves():
    """BT.2100: table 4 and annex; BT.709: 18% grey is 0.409; PQ: 203 cd/m2 is 0.581.

    H.273, table 3: SMPTE 240M meets its line at a light of 0.0228, logarithms reach
    over two decades, and two and a half; SMPTE 428 is of 48 cd/m2.
    """
    for code, value, light in (
        (1, 0.4090, 0.18),
        (1, 0.045, 0.01),
        (4, 0.5, 0.5**2.2),
        (8, 0.3, 0.3),
        (13, 0.5, 0.21404),
        (16, 0.5807, 0.0203),
        (16, 0.7518, 0.1),
        (16, 1.0, 1.0),
        (16, 0.0, 0.0),
        (18, 0.5, 1 / 12),
        (18, 1.0, 1.0),
        (18, 0.75, 0.26496),
        (7, 1.0, 1.0),
        (7, 0.0913, 0.0228),
        (7, 0.04, 0.01),
        (5, 0.5, 0.5**2.8),
        (9, 0.5, 0.1),
        (10, 0.6, 0.1),
        (10, 0.0, 0.0),
        (17, 1.0, 52.37 / 48),
    ):
        found = CURVES[code][1](np.array([value]))[0]
        assert found == pytest.approx(light, rel=2e-3, abs=1e-6)


@pytest.mark.parametrize("bits", [8, 10, 12])
@pytest.mark.parametrize("code", [0, 1, 8, 16, 18])
@pytest.mark.parametrize("kind", ["avif", "heic"])
def test_transfer_codes_of_avif_and_heic(tmp_path, kind, code, bits):
    light = np.linspace(0.004, 0.6, 32)
    values = srgb_encode(light) if code == 0 else values_of(code, light)
    top = 2**bits - 1
    stored = np.rint(np.broadcast_to(values[:, None, None], (32, 40, 3)) * top)
    path = tmp_path / f"a.{kind}"
    if kind == "avif":
        kept = stored.astype(np.uint8 if bits == 8 else np.uint16)
        data = imagecodecs.avif_encode(kept, level=100, bitspersample=bits)
    else:
        heif = pytest.importorskip("pillow_heif")
        wide = bits > 8
        mode = "RGB;16" if wide else "RGB"
        kept = (stored * 2 ** (16 - bits) if wide else stored).astype(
            np.uint16 if wide else np.uint8
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(heif.options, "SAVE_HDR_TO_12_BIT", bits == 12)
            file = heif.from_bytes(mode=mode, size=(40, 32), data=kept.tobytes())
            stream = io.BytesIO()
            file.save(stream, quality=-1, chroma=444)
        data = stream.getvalue()
    at = data.index(b"colrnclx") + 10
    path.write_bytes(data[:at] + struct.pack(">H", code or 2) + data[at + 2 :])
    file = read_image_file(path)
    assert file.pixels.dtype == (np.uint8 if bits == 8 else np.uint16)
    capture = read_capture(select(tmp_path))
    found = as_linear(capture.images[0], capture.transfer)[:, 20].mean(-1)
    # A level of the stored values, and one of the codec's conversion.
    curve = CURVES[code or 13][1]
    steps = [curve(np.clip(values + s * 2.5 / top, 0, 1)) for s in (-1, 1)]
    assert (found >= steps[0] - 1e-3).all() and (found <= steps[1] + 1e-3).all()
    path.write_bytes(data[:at] + struct.pack(">H", 99) + data[at + 2 :])
    with pytest.raises(InputError, match=rf"a\.{kind}: .*unknown transfer code 99"):
        read_image_file(path)


def test_without_tags_the_type_decides():
    rules = {np.uint8: "srgb", np.uint16: "linear", np.float32: "linear"}
    for dtype, transfer in rules.items():
        assert encoding_of(dtype).transfer == transfer
        assert "values" in encoding_of(dtype).rule
    assert encoding_of(np.float32, icc=profile(gamma_curve(1.8))).transfer == "linear"


def test_photographs_encode_light_alike(tmp_path):
    save(tmp_path / "a.png", smooth(np.uint16))
    tagged_png(tmp_path / "b.png", smooth(np.uint16, 1), GAMMA_22)
    with pytest.raises(InputError, match=r"b\.png: expected linear values as a\.png"):
        read_capture(select(tmp_path))
    assert read_capture(select(tmp_path), transfer="srgb").transfer == "srgb"
    tagged_png(tmp_path / "b.png", smooth(np.uint16, 1), GAMMA_1)
    capture = read_capture(select(tmp_path))
    assert dataclasses.asdict(capture)["transfer_rule"] == "16-bit values"
    curves = [png_profile(profile(gamma_curve(g))) for g in (1.8, 1.4)]
    tagged_png(tmp_path / "a.png", smooth(np.uint16), curves[0])
    for other in (png_profile(SRGB), curves[1]):  # both are sRGB, once by a table
        tagged_png(tmp_path / "b.png", smooth(np.uint16, 1), other)
        with pytest.raises(InputError, match=r"b\.png: expected srgb values as a\.png"):
            read_capture(select(tmp_path))
    tagged_png(tmp_path / "b.png", smooth(np.uint16, 1), curves[0])
    assert len(read_capture(select(tmp_path)).images) == 2


# A gamma of 2.2 is taken as sRGB's curve.
@pytest.mark.parametrize(("icc", "levels"), [(P3, 1.1), (ADOBE, 5)])
def test_colours_of_wide_profiles_are_a_colour_engines(icc, levels, tmp_path):
    rng = np.random.default_rng(0)
    pixels = rng.integers(60, 200, (8, 8, 3), dtype=np.uint8)
    path = tagged_png(tmp_path / "a.png", pixels, png_profile(icc))
    image = Image.fromarray(pixels)
    expected = ImageCms.profileToProfile(
        image,
        ImageCms.ImageCmsProfile(io.BytesIO(icc)),
        ImageCms.createProfile("sRGB"),
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
    )
    found = 255 * srgb_encode(read_linear(path))
    np.testing.assert_allclose(found, np.asarray(expected), atol=levels)
    assert np.abs(found - pixels).max() > 10
    np.testing.assert_array_equal(read_image(path), pixels)  # what networks see
    assert read_image_file(path).encoding.rule.endswith("colours of its own")
    assert icc_to_srgb(SRGB) is None and icc_to_srgb(icc[:200]) is None


def test_base_colours_are_srgb_whatever_the_photographs_profile_is(tmp_path):
    normals, mask, _ = hemisphere(40)
    lights = np.array(
        [[0.5, 0.2, 0.8], [-0.6, 0.1, 0.7], [0, 0.7, 0.6], [0.1, -0.5, 0.9]]
    )
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    paint = np.full((40, 40, 3), 0.5)
    paint[:, 20:] = 0.5, 0.1, 0.1
    cosine = np.maximum(np.einsum("hwk,nk->nhw", normals, lights), 0)
    linear = cosine[..., None] * paint
    matrix = icc_to_srgb(P3)
    stored = srgb_encode(linear @ np.linalg.inv(matrix).T)
    for index, image in enumerate(np.uint8(np.rint(255 * stored))):
        tagged_png(tmp_path / f"{index}.png", image, png_profile(P3))
    capture = read_capture(select(tmp_path), mask=mask)
    given = capture.images, normals, mask
    fit = estimate_lights(*given, guesses=lights, transfer=capture.transfer)
    red = {}
    for to_srgb in (None, capture.encoding.to_srgb):
        color = base_color(*given, fit, transfer=capture.transfer, to_srgb=to_srgb)
        patch = np.median(color[mask & (np.arange(40) >= 22)], axis=0)
        red[to_srgb is None] = patch[0] / patch[1]
    # Measured: 4.5, as of photographs in sRGB, and 3.3.
    assert red[False] > 4.3 and red[True] < 3.8
    save(tmp_path / "9.png", np.uint8(np.rint(255 * stored[0])))
    (note,) = read_capture(select(tmp_path), mask=mask).notes
    assert "profiles of other colours than 0.png's: 9.png; taken as its own" in note
