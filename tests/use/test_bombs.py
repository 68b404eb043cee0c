"""Files that claim to be huge, and files that are none: refused before they hurt."""

import os
import struct
import time
import tracemalloc
import zlib

import numpy as np
import OpenEXR
import pytest
from picture_files import png, save, smooth
from PIL import Image
from tiff_writer import tiff

from unips_jax.capture.unpack import unpacked
from unips_jax.cli import main as cli
from unips_jax.errors import InputError
from unips_jax.io.images import MAX_PIXELS, read_image, read_image_file
from unips_jax.io.photographs import read_capture
from unips_jax.io.selection import select

HUGE = 20_000


def exr_with_display_window(path):
    """8 x 8 pixels, shown in a window of 200000 x 200000."""
    windows = {
        "type": OpenEXR.scanlineimage,
        "dataWindow": (np.int32([0, 0]), np.int32([7, 7])),
        "displayWindow": (np.int32([0, 0]), np.int32([199_999, 199_999])),
    }
    pixels = {"RGB": np.zeros((8, 8, 3), np.float32)}
    OpenEXR.File(windows, pixels).write(str(path))


def exr_with_data_window(path):
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    pixels = {"RGB": np.zeros((8, 8, 3), np.float32)}
    OpenEXR.File(header, pixels).write(str(path))
    data = path.read_bytes()
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    window = struct.pack("<4i", 0, 0, HUGE - 1, HUGE - 1)
    path.write_bytes(data[:at] + window + data[at + 16 :])


def png_of_zeros(path):
    """About 40 kB that unpack to 0.4 GB."""
    pack = zlib.compressobj(9)
    row = bytes(HUGE + 1)
    body = b"".join(pack.compress(row) for _ in range(HUGE)) + pack.flush()
    path.write_bytes(png_like(np.empty((HUGE, 0, 1), np.uint8), body))


def png_like(shape, body):
    header = struct.pack(">IIBBBBB", HUGE, HUGE, 8, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for name, part in ((b"IHDR", header), (b"IDAT", body), (b"IEND", b"")):
        checksum = struct.pack(">I", zlib.crc32(name + part))
        data += struct.pack(">I", len(part)) + name + part + checksum
    return data


def tiff_of_one_huge_tile(path):
    pixels = np.zeros((8, 8, 1), np.uint8)
    data = tiff([{"pixels": pixels, "tile": 16, "compression": "deflate"}])
    for tag in (322, 323):
        at = data.index(struct.pack("<HHI", tag, 3, 1)) + 8
        data = data[:at] + struct.pack("<H", 65_520) + data[at + 2 :]
    path.write_bytes(data)


def patched(suffix, offset, code, *sizes):
    def write(path):
        Image.fromarray(smooth(np.uint8)).save(path, format=suffix)
        data = bytearray(path.read_bytes())
        struct.pack_into(code, data, offset, *sizes)
        path.write_bytes(data)

    write.__name__ = suffix
    return write


def jpeg(path):
    data = save(path, smooth(np.uint8)).read_bytes()
    at = data.index(b"\xff\xc0") + 5
    path.write_bytes(data[:at] + struct.pack(">HH", HUGE, HUGE) + data[at + 4 :])


def pnm(path):
    path.write_bytes(b"P5 200000 200000 255\n" + bytes(100))


def hdr(path):
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 90000 +X 90000\n\2\2\0")


@pytest.mark.parametrize(
    ("suffix", "write"),
    [
        (".exr", exr_with_display_window),
        (".exr", exr_with_data_window),
        (".png", png_of_zeros),
        (".tif", tiff_of_one_huge_tile),
        (".bmp", patched("BMP", 18, "<ii", HUGE, HUGE)),
        (".gif", patched("GIF", 6, "<HH", 65_535, 65_535)),
        (".jpg", jpeg),
        (".pgm", pnm),
        (".hdr", hdr),
    ],
)
def test_huge_sizes_are_refused_by_the_header(tmp_path, suffix, write):
    path = tmp_path / f"a{suffix}"
    write(path)
    start = time.monotonic()
    tracemalloc.start()
    with pytest.raises(InputError, match=rf"a\{suffix}: .*at most 200,000,000 pixels"):
        read_image(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30e6 and time.monotonic() - start < 5


def gif_of_many_frames(path):
    Image.new("L", (4, 4)).save(path)
    data = path.read_bytes()
    frame = data.index(b",")
    path.write_bytes(data[:frame] + data[frame:-1] * 300_000 + b";")


def png_of_many_chunks(path):
    data = save(path, smooth(np.uint8)).read_bytes()
    chunk = bytes(4) + b"tEXt" + struct.pack(">I", zlib.crc32(b"tEXt"))
    path.write_bytes(data[:33] + chunk * 1_000_000 + data[33:])


def jpeg_with(part, count):
    def write(path):
        data = save(path, smooth(np.uint8)).read_bytes()
        path.write_bytes(data[:2] + part * count + data[2:])

    write.__name__ = f"{part[:2].hex()}_{count}"
    return write


ICC = b"\xff\xe2" + struct.pack(">H", 65_014) + b"ICC_PROFILE\0" + bytes(65_000)


def webp_of_many_chunks(path):
    data = save(path, smooth(np.uint8)).read_bytes() + b"XXXX\0\0\0\0" * 3_000_000
    path.write_bytes(data[:4] + struct.pack("<I", len(data) - 8) + data[8:])


def tiff_of_many_pages(path):
    data = b"II*\0" + struct.pack("<I", 8)
    for page in range(20_000):
        tag = struct.pack("<HHHII", 1, 256, 4, 1, 1)
        data += tag + struct.pack("<I", 26 + 18 * page)
    path.write_bytes(data)


def exr_of_many_parts(path):
    names = [f"p{i}" for i in range(3000)]
    OpenEXR.File(
        [OpenEXR.Part({"name": n}, {"R": np.zeros((1, 1), "f4")}, n) for n in names]
    ).write(str(path))


@pytest.mark.parametrize(
    ("suffix", "write", "said"),
    [
        (".gif", gif_of_many_frames, "an animated GIF"),
        (".png", png_of_many_chunks, "more than 4096 chunks"),
        (".jpg", jpeg_with(b"\xff\xfe\0\2", 1_000_000), "more than 4096 segments"),
        (".jpg", jpeg_with(b"\xff", 20_000_000), None),  # filling: sound
        (".jpg", jpeg_with(ICC, 1500), "bad ICC marker"),
        (".webp", webp_of_many_chunks, "more than 4096 chunks"),
        (".tif", tiff_of_many_pages, "more than 64 pages"),
        (".exr", exr_of_many_parts, "p1002.R, .* and 2980 more"),
    ],
)
def test_files_of_many_parts_take_no_time(tmp_path, suffix, write, said):
    path = tmp_path / f"a{suffix}"
    write(path)
    start = time.process_time()
    if said is None:
        read_image(path)
    else:
        with pytest.raises(InputError, match=rf"a\{suffix}: .*{said}"):
            read_image(path)
    assert time.process_time() - start < 2


def test_the_size_is_named_and_the_limit_can_be_moved(tmp_path):
    for i in range(3):
        save(tmp_path / f"{i}.png", smooth(np.uint8, i))
    size = smooth(np.uint8).shape[0] * smooth(np.uint8).shape[1]
    with pytest.raises(InputError, match=r"0\.png: .*at most 800 .*got 37 x 23 = 851;"):
        read_capture(select(tmp_path), max_pixels=800)
    assert read_capture(select(tmp_path), max_pixels=size).mask.any()
    save(tmp_path / "mask.png", np.full((900, 900), 255, np.uint8))
    with pytest.raises(InputError, match=r"mask\.png: .*got 900 x 900"):
        read_capture(select(tmp_path), max_pixels=size)
    assert MAX_PIXELS == 200_000_000


def test_a_set_has_a_limit_too(tmp_path):
    for i in range(11):
        save(tmp_path / f"{i}.png", smooth(np.uint8, i))
    with pytest.raises(InputError, match="8,510 pixels in all .*11 of 37 x 23 = 9,361"):
        read_capture(select(tmp_path), max_pixels=851)


def test_the_command_has_the_option(tmp_path, capsys):
    save(tmp_path / "in" / "a.png", smooth(np.uint8))
    arguments = ["estimate", str(tmp_path / "in"), "-o", str(tmp_path / "out")]
    assert cli.main([*arguments, "--max-pixels", "800"]) == 2
    assert "at most 800 pixels, got 37 x 23" in capsys.readouterr().err
    assert not (tmp_path / "out" / "in").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "b.png").symlink_to("/dev/zero")
    (tmp_path / "c.png").symlink_to(tmp_path / "d.png")
    save(tmp_path / "d.png", smooth(np.uint8))
    selection = select(tmp_path)
    assert selection.names == ("d.png",)
    assert selection.left_out == {
        "a pipe or device, no regular file": ["a.png", "b.png"],
        "another name of d.png": ["c.png"],
    }
    for name in ("a.png", "b.png"):
        with pytest.raises(InputError, match=rf"{name}: expected a regular file"):
            read_image(tmp_path / name)
        with pytest.raises(InputError, match=f"{name}: expected a mask"):
            select(tmp_path, mask_file=tmp_path / name)
    for name in ("mask.png", "mask.tif"):
        (tmp_path / name).symlink_to("/dev/zero")
        with pytest.raises(InputError, match=rf"{name}: expected a mask"):
            select(tmp_path)
        (tmp_path / name).unlink()
    (tmp_path / "e.png").symlink_to(tmp_path / "e.png")
    with pytest.raises(InputError, match=r"e\.png: cannot be read"):
        read_capture(select(tmp_path))


def test_a_file_as_large_as_a_disk_is_not_read(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png(smooth(np.uint8)[..., :1], 0, 8, {}))
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="got a file of 1,099,511,627,776 bytes"):
        read_image(path)


def test_a_stack_has_the_limit_of_a_set(tmp_path):
    pages = [{"pixels": smooth(np.uint8), "compression": "deflate"}] * 11
    (tmp_path / "stack.tif").write_bytes(tiff(pages))
    with (
        pytest.raises(InputError, match="at most 8,510 pixels in all pages, got 9,361"),
        unpacked(tmp_path / "stack.tif", max_pixels=851),
    ):
        pass


def test_all_parts_of_an_exr_have_the_limit(tmp_path):
    window = np.int32([0, 0]), np.int32([7, 7])
    pixels = {
        "a": {"RGB": np.zeros((8, 8, 3), "f4")},
        "b": {"Z": np.zeros((99, 99), "f4")},
    }
    parts = [
        OpenEXR.Part({"displayWindow": window}, channels, name)
        for name, channels in pixels.items()
    ]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=r"a\.exr: .*at most 9,000 pixels"):
        read_image_file(tmp_path / "a.exr", max_pixels=9_000)
    assert read_image_file(tmp_path / "a.exr", max_pixels=9_801).pixels.size == 192
