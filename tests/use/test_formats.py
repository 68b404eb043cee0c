"""Every layout of a format is read right, or refused by the format's name."""

import itertools
import struct
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
from picture_files import SIZE, noise, png, read, save, smooth
from PIL import Image
from tiff_writer import COMPRESSIONS, tiff

from unips_jax.errors import InputError
from unips_jax.io.images import check_image, decode_image, read_image, read_image_file
from unips_jax.io.normals import read_normals


def test_pngs(tmp_path):
    palette = np.random.default_rng(1).integers(0, 256, (16, 3), dtype=np.uint8)
    for kind, bits in (
        (0, 1),
        (0, 2),
        (0, 4),
        (0, 8),
        (0, 16),
        (2, 8),
        (2, 16),
        (3, 1),
        (3, 2),
        (3, 4),
        (3, 8),
        (4, 8),
        (4, 16),
        (6, 8),
        (6, 16),
    ):
        channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[kind]
        dtype = np.uint16 if bits == 16 else np.uint8
        top = min(2**bits - 1, 15 if kind == 3 else 65535)
        values = noise(dtype, channels, top=top)
        data = png(
            values, kind, bits, {b"PLTE": palette.tobytes()} if kind == 3 else {}
        )
        file = read(tmp_path / "a.png", data)
        full = values * dtype(255 // (2**bits - 1)) if bits < 8 else values
        colours = palette[values[..., 0]] if kind == 3 else full
        alpha = None
        if kind in (4, 6):
            colours, alpha = full[..., :-1], full[..., -1]
        np.testing.assert_array_equal(file.pixels, colours, str((kind, bits)))
        assert (file.alpha is None) == (alpha is None)
        if alpha is not None:
            np.testing.assert_array_equal(file.alpha, alpha)
        facts = check_image(data, tmp_path / "a.png")
        assert facts == (*SIZE, colours.shape[2] + (alpha is not None), dtype)


def test_transparent_colours_of_png(tmp_path):
    values = noise(np.uint8, 1, top=15)
    chunks = {b"PLTE": bytes(range(48)), b"tRNS": b"\0\x80"}
    file = read(tmp_path / "a.png", png(values, 3, 8, chunks))
    expected = np.select([values == 0, values == 1], [0, 128], 255)[..., 0]
    np.testing.assert_array_equal(file.alpha, expected)
    chunks = {b"tRNS": struct.pack(">H", 7)}
    file = read(tmp_path / "a.png", png(values, 0, 8, chunks))
    np.testing.assert_array_equal(file.alpha == 0, values[..., 0] == 7)


@pytest.mark.parametrize(
    ("suffix", "mode"),
    [
        (".bmp", "1"),
        (".bmp", "L"),
        (".bmp", "P"),
        (".bmp", "RGB"),
        (".bmp", "RGBA"),
        (".gif", "1"),
        (".gif", "L"),
        (".gif", "P"),
        (".pbm", "1"),
        (".pgm", "L"),
        (".ppm", "RGB"),
    ],
)
def test_other_bitmaps(tmp_path, suffix, mode):
    image = Image.fromarray(noise(np.uint8, 4))
    image = image if mode == "RGBA" else image.convert("RGB").convert(mode)
    image.save(tmp_path / f"a{suffix}")
    file = read_image_file(tmp_path / f"a{suffix}")
    expected = np.asarray(image.convert("L" if mode in "1L" else "RGB"))
    np.testing.assert_array_equal(
        file.pixels, np.broadcast_to(expected.reshape(*SIZE, -1), file.pixels.shape)
    )


def test_pnm_of_sixteen_bits(tmp_path):
    values = noise(np.uint16, 3, top=1000)
    header = f"P6 {SIZE[1]}\n{SIZE[0]} # size\n1000\n".encode()
    file = read(tmp_path / "a.ppm", header + values.astype(">u2").tobytes())
    exact = values * (65535 / 1000)
    assert file.pixels.dtype == np.uint16
    assert np.abs(file.pixels - exact).max() <= 0.5
    with pytest.raises(InputError, match="damaged"):
        read(tmp_path / "a.ppm", header + values.astype(">u2").tobytes()[:-1])


def exr(path, parts):
    OpenEXR.File([OpenEXR.Part(dict(h), c, n) for h, c, n in parts]).write(str(path))
    return path


def planes(prefix, letters, seed):
    values = noise(np.float32, len(letters), seed=seed)
    return {
        f"{prefix}{c}": values[..., i].copy() for i, c in enumerate(letters)
    }, values


def test_the_picture_of_an_exr(tmp_path):
    path = tmp_path / "a.exr"
    header = {"type": OpenEXR.scanlineimage}
    main, expected = planes("", "RGBA", 0)
    more = planes("diffuse.", "RGB", 1)[0] | planes("Normal.", "RGB", 2)[0]
    OpenEXR.File(header, main | more).write(str(path))
    file = read_image_file(path)
    np.testing.assert_array_equal(file.pixels, expected[..., :3])
    np.testing.assert_array_equal(file.alpha, expected[..., 3])
    layers = planes("beauty.", "RGB", 1)[0]
    OpenEXR.File(header, layers | planes("normal.", "RGB", 2)[0]).write(str(path))
    np.testing.assert_array_equal(read_image(path)[..., 1], layers["beauty.G"])
    OpenEXR.File(header, planes("normal.", "RGB", 2)[0]).write(str(path))
    with pytest.raises(InputError, match="EXR with the channels normal.B.*no map"):
        read_image(path)
    np.testing.assert_array_equal(read_normals(path), planes("", "RGB", 2)[1])
    OpenEXR.File(header, planes("View.Normal.", "XYZ", 3)[0]).write(str(path))
    np.testing.assert_array_equal(read_normals(path), planes("", "XYZ", 3)[1])
    two = layers | planes("other.", "RGB", 2)[0]
    OpenEXR.File(header, two).write(str(path))
    with pytest.raises(InputError, match=r"beauty\.B.*in one layer"):
        read_image(path)


def test_parts_of_an_exr(tmp_path):
    path = tmp_path / "a.exr"
    header = {"type": OpenEXR.scanlineimage}
    first, second = planes("", "RGB", 0), planes("", "RGB", 1)
    exr(path, [(header, second[0], "normal"), (header, first[0], "beauty")])
    np.testing.assert_array_equal(read_image(path), first[1])
    exr(path, [(header, second[0], "left"), (header, first[0], "right")])
    with pytest.raises(InputError, match=r"left\.B"):
        read_image(path)
    integers = {c: np.zeros(SIZE, np.uint32) for c in "RGB"}
    OpenEXR.File(header, integers).write(str(path))
    with pytest.raises(InputError, match="an EXR of integers"):
        read_image(path)


def test_jpegs(tmp_path):
    path = tmp_path / "a.jpg"
    for sampling, progressive in itertools.product((0, 1, 2), (False, True)):
        image = Image.fromarray(smooth(np.uint8, height=61, width=79))
        image.save(path, quality=93, subsampling=sampling, progressive=progressive)
        expected = cv2.imread(str(path))[..., ::-1]
        np.testing.assert_array_equal(read_image(path), expected)
    Image.fromarray(smooth(np.uint8)[..., 0]).save(path, quality=95)
    np.testing.assert_array_equal(read_image(path)[..., 0], cv2.imread(str(path), 0))
    Image.fromarray(noise(np.uint8, 4)).convert("CMYK").save(path)
    with pytest.raises(InputError, match="got a CMYK JPEG"):
        read_image(path)


def test_jpegs_whose_scan_states_no_coefficients(tmp_path):
    """As phones write them: what a sequential scan has is known without."""
    path = tmp_path / "a.jpg"
    for progressive in (False, True):
        Image.fromarray(smooth(np.uint8)).save(path, progressive=progressive)
        data = bytearray(path.read_bytes())
        expected = read_image(path)
        at = data.index(b"\xff\xda")
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        data[end - 3 : end] = bytes(3) if not progressive else b"\1\0\0"
        path.write_bytes(data)
        if progressive:
            with pytest.raises(InputError, match="the decoder says: Invalid progress"):
                read_image(path)
        else:
            np.testing.assert_array_equal(read_image(path), expected)


@pytest.mark.parametrize("start", [0.4, 0.5, 0.8])
def test_damaged_jpegs_are_refused_in_threads_too(tmp_path, start):
    path = save(tmp_path / "a.jpg", smooth(np.uint8, height=200, width=200))
    data = bytearray(path.read_bytes())
    begin = int(start * len(data))
    data[begin : begin + 300] = bytes(300)
    path.write_bytes(data)
    for _ in range(2):
        with ThreadPoolExecutor(1) as pool:
            result = pool.submit(read_image, path)
            with pytest.raises(InputError, match="damaged.*the decoder says"):
                result.result()
    with pytest.raises(InputError, match="damaged.*the decoder says"):
        read_image(path)


@pytest.mark.parametrize(
    ("start", "name"),
    [
        (b"\0\0\0\x18ftypmp42", "a video; give the file itself"),
        (b"FUJIFILMCCD-RAW 0201", "camera's raw file .RAF."),
        (b"IIU\0\x18\0\0\0", "camera's raw file .RW2."),
        (b"IIRO\x08\0\0\0", "camera's raw file .ORF."),
        (b"8BPS\0\1", "a Photoshop document"),
        (b"\0\0\0\x0cjP  \r\n", "a JPEG 2000 picture"),
        (b"\xff\x0a\xfa\x7f", "a JPEG XL picture"),
    ],
)
def test_other_formats_are_named_whatever_the_file_is_called(tmp_path, start, name):
    with pytest.raises(InputError, match=rf"IMG_1\.JPG: .* got .*{name}"):
        read(tmp_path / "IMG_1.JPG", start + bytes(200))


def test_animations_are_named(tmp_path):
    frames = [Image.fromarray(noise(np.uint8, 1, seed=i)[..., 0]) for i in range(3)]
    for suffix in (".gif", ".webp", ".png"):
        path = tmp_path / f"a{suffix}"
        frames[0].save(path, save_all=True, append_images=frames[1:])
        with pytest.raises(InputError, match="got an animated"):
            read_image(path)


def test_same_bytes_same_picture(tmp_path):
    """Memory that was used before does not show."""
    pixels = noise(np.uint16, 3)
    data = tiff([{"pixels": pixels, "planar": True, "compression": "lzw"}])
    for i in range(12):
        junk = [np.full(50_000 * (i % 4 + 1), i * 1.7) for _ in range(6)]
        del junk
        file = decode_image(data, tmp_path / "a.tif")
        np.testing.assert_array_equal(file.pixels, pixels)


def test_stacks_of_imagej_are_named(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((4, *SIZE), np.uint8), imagej=True)
    with pytest.raises(InputError, match="got a TIFF of 4 pages"):
        read_image(path)


def test_altered_files_are_read_or_refused_in_one_line(tmp_path, capfd):
    pixels = smooth(np.uint8)
    seeds = [
        cv2.imencode(suffix, pixels)[1].tobytes()
        for suffix in (".png", ".jpg", ".webp", ".bmp", ".ppm", ".hdr")
    ]
    seeds += [tiff([{"pixels": pixels, "compression": name}]) for name in COMPRESSIONS]
    seeds.append(save(tmp_path / "a.exr", smooth(np.float32)).read_bytes())
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(600):
        data = bytearray(seeds[rng.integers(len(seeds))])
        for place in rng.integers(0, rng.choice([60, len(data)]), rng.integers(1, 5)):
            data[place] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
        if rng.random() < 0.2:
            data = data[: rng.integers(1, len(data))]
        try:
            decode_image(bytes(data), tmp_path / "a")
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
    assert 100 < refused < 600
    assert capfd.readouterr() == ("", "")
