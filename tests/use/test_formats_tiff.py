"""TIFF files, as cameras and programs write them."""

import contextlib
import itertools
import struct

import imagecodecs
import numpy as np
import pytest
from picture_files import noise, read, smooth
from tiff_writer import COMPRESSIONS, tiff

from unips_jax.errors import InputError
from unips_jax.io.formats import lzw
from unips_jax.io.formats.lzw import begins_soundly

# Samples of a pixel: how many colours, and what other kinds there are.
SAMPLES = {
    "grey": (1, ()),
    "grey, alpha": (1, (2,)),
    "rgb": (3, ()),
    "rgb, unassociated alpha": (3, (2,)),
    "rgb, associated alpha": (3, (1,)),
    "rgb, unspecified": (3, (0,)),
}


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize(
    "dtype", [np.uint8, np.uint16, np.float16, np.float32, np.float64]
)
def test_tiffs(tmp_path, dtype, compression):
    for planar, order, tile, kind, predictor in itertools.product(
        (False, True), "<>", (0, 16), SAMPLES, (False, True)
    ):
        if predictor and (np.dtype(dtype).kind == "f" or compression == "none"):
            continue
        colours, extra = SAMPLES[kind]
        pixels = noise(dtype, colours + len(extra))
        layout = {"planar": planar, "tile": tile, "predictor": predictor}
        layout |= {"compression": compression, "extra": extra}
        file = read(tmp_path / "a.tif", tiff([{"pixels": pixels, **layout}], order))
        expected = pixels.astype(np.float32) if pixels.dtype.kind == "f" else pixels
        cell = (layout, order, kind)
        assert file.pixels.dtype == expected.dtype, cell
        np.testing.assert_array_equal(file.pixels, expected[..., :colours], str(cell))
        if extra:
            np.testing.assert_array_equal(file.alpha, expected[..., -1], str(cell))
        else:
            assert file.alpha is None


@pytest.mark.parametrize("bits", [1, 2, 4])
@pytest.mark.parametrize("white_is_zero", [False, True])
def test_tiffs_of_few_bits(tmp_path, bits, white_is_zero):
    pixels = noise(np.uint8, 1, top=2**bits - 1)
    arguments = {"pixels": pixels, "bits": bits, "photometric": 1 - white_is_zero}
    file = read(tmp_path / "a.tif", tiff([arguments]))
    full = pixels * np.uint8(255 // (2**bits - 1))
    np.testing.assert_array_equal(file.pixels, 255 - full if white_is_zero else full)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("extra", [(), (2,)])
def test_white_may_be_zero(tmp_path, dtype, extra):
    pixels = noise(dtype, 1 + len(extra))
    arguments = {"pixels": pixels, "photometric": 0, "extra": extra}
    file = read(tmp_path / "a.tif", tiff([arguments]))
    np.testing.assert_array_equal(file.pixels, np.iinfo(dtype).max - pixels[..., :1])
    if extra:
        np.testing.assert_array_equal(file.alpha, pixels[..., 1])


@pytest.mark.parametrize("bits", [4, 8])
def test_palettes(tmp_path, bits):
    table = np.random.default_rng(1).integers(0, 65536, (3, 2**bits))
    index = noise(np.uint8, 1, top=2**bits - 1)
    tags = {320: (3, table.ravel().tolist())}
    arguments = {"pixels": index, "bits": bits, "photometric": 3, "tags": tags}
    file = read(tmp_path / "a.tif", tiff([arguments]))
    np.testing.assert_array_equal(file.pixels, table.T[index[..., 0]] >> 8)


def test_previews_and_masks_are_no_photographs(tmp_path):
    pixels = noise(np.uint16, 3)
    preview = {"pixels": noise(np.uint8, 3)[:5, :9], "tags": {254: (4, [1])}}
    mask = {
        "pixels": noise(np.uint8, 1, top=1),
        "bits": 1,
        "photometric": 4,
        "tags": {254: (4, [4])},
    }
    old = {"pixels": noise(np.uint8, 3)[:5, :9], "tags": {255: (3, [2])}}
    for pages in ([preview, {"pixels": pixels}], [{"pixels": pixels}, old, mask]):
        file = read(tmp_path / "a.tif", tiff(pages))
        np.testing.assert_array_equal(file.pixels, pixels)
    for pages, name in (([preview], "previews only"), ([{"pixels": pixels}] * 3, "3")):
        with pytest.raises(InputError, match=rf"got a TIFF .*{name}"):
            read(tmp_path / "a.tif", tiff(pages))


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"pixels": noise(np.uint32, 1)}, "32-bit samples"),
        ({"pixels": noise(np.int16, 1), "form": 2}, "16-bit signed samples"),
        ({"pixels": noise(np.uint8, 4), "photometric": 5}, "SEPARATED colours"),
        ({"pixels": noise(np.uint8, 3), "photometric": 6}, "YCBCR colours"),
        ({"pixels": noise(np.uint8, 3), "photometric": 8}, "CIELAB colours"),
        ({"pixels": noise(np.uint16, 1), "photometric": 32803}, "camera's raw file"),
        ({"pixels": noise(np.uint8, 3), "compression": 7}, "JPEG compression"),
        ({"pixels": noise(np.uint8, 3), "compression": 34712}, "compression"),
        (
            {"pixels": noise(np.uint8, 5), "photometric": 2, "extra": (0, 0)},
            "5 samples",
        ),
        ({"pixels": noise(np.uint8, 2)}, "2 samples"),
        ({"pixels": noise(np.float32, 1), "photometric": 0}, "zero is white"),
        ({"pixels": noise(np.uint8, 1), "photometric": 3}, "without their colours"),
    ],
)
def test_other_tiffs_are_named(tmp_path, changes, name):
    with pytest.raises(InputError, match=rf"can be read, got .*{name}"):
        read(tmp_path / "a.tif", tiff([changes]))


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("tile", [0, 16])
def test_cut_and_altered_tiffs(tmp_path, compression, tile):
    path = tmp_path / "a.tif"
    data = tiff(
        [{"pixels": smooth(np.uint8), "compression": compression, "tile": tile}]
    )
    for length in range(0, len(data) - 1, 97):
        with pytest.raises(InputError, match=r"a\.tif: .*(empty|damaged)"):
            read(path, data[:length])


@pytest.mark.parametrize("byte", range(8))
def test_a_changed_byte_of_the_size_is_no_traceback(tmp_path, byte):
    data = bytearray(tiff([{"pixels": smooth(np.uint8)}]))
    entry = data.index(b"\x00\x01", 8)  # the width's tag
    for bit in range(8):
        changed = data.copy()
        changed[entry + 2 + byte] ^= 1 << bit
        with contextlib.suppress(InputError):
            read(tmp_path / "a.tif", bytes(changed))


def test_text_of_exif_3_hides_no_picture(tmp_path):
    """Its UTF-8 texts have a type of their own, which may stand in any directory."""
    pixels = noise(np.uint8, 3)
    text = (129, [*"Schärfe".encode(), 0])
    for tag in (270, 305, 315, 42037):
        file = read(tmp_path / "a.tif", tiff([{"pixels": pixels, "tags": {tag: text}}]))
        np.testing.assert_array_equal(file.pixels, pixels)
    for tag in (256, 258, 277, 273):
        data = tiff([{"pixels": pixels}])
        at = data.index(struct.pack("<H", tag), int.from_bytes(data[4:8], "little"))
        data = data[: at + 2] + struct.pack("<H", 129) + data[at + 4 :]
        with pytest.raises(InputError, match=f"{tag} .*invalid data type 129"):
            read(tmp_path / "a.tif", data)


def packed(codes, late=False):
    """LZW data of these codes; of the old kind, where the low bits are first."""
    bits, number, entries = 0, 0, 257
    for code in codes:
        grown = entries + (not late)
        width = 9 + sum(grown >= limit for limit in (512, 1024, 2048))
        if late:
            number |= code << bits
        else:
            number = number << width | code
        bits += width
        entries = 257 if code == 256 else entries + 1
    size = -(-bits // 8)
    if late:
        return number.to_bytes(size, "little")
    return (number << 8 * size - bits).to_bytes(size, "big")


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("before", [0, 200, 600, 1500, 3000])
def test_lzw_that_begins_with_what_is_not_there_is_refused(tmp_path, before, late):
    """Its decoder would read anywhere in memory; the second table counts, too."""
    pixels = np.zeros((100, 100, 1), np.uint8)
    values = np.random.default_rng(0).integers(0, 256, before).tolist()
    for first, sound in ((65, True), (257, True), (258, False), (511, False)):
        data = packed([256, *values, 256, 256, first, 65, 66, 257, 256, 300], late)
        assert begins_soundly(data) == sound
        if not sound:
            compressions = {"bad": (5, lambda _, data=data: data)}
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("tiff_writer.COMPRESSIONS", compressions)
                file = tiff([{"pixels": pixels, "compression": "bad"}])
                # A newer decoder ends where a strip is full, before what is bad.
                patch.setattr(lzw, "TRUSTING", True)
                with pytest.raises(InputError, match=r"a\.tif: .*LZW"):
                    read(tmp_path / "a.tif", file)


def test_sound_lzw_is_told_by_short_data_too():
    assert all(
        begins_soundly(data) for data in (b"", b"\x80", b"\0", b"\0\1", b"\x80\0")
    )
    rng = np.random.default_rng(0)
    for size in (1, 2, 1000, 4000, 30_000):
        for top in (2, 256):
            raw = rng.integers(0, top, size, dtype=np.uint8).tobytes()
            assert begins_soundly(imagecodecs.lzw_encode(raw))
