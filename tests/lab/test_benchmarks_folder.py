"""The benchmark of one's own folders, which reads as `unips estimate` does."""

import json
import os
import struct

import cv2
import evaluation_data as data
import numpy as np
import OpenEXR
import pytest
from picture_files import (
    HEIGHT,
    WIDTH,
    png_with_orientation,
    save,
    smooth,
    tiff_with_orientation,
    with_orientation,
)
from scipy.io import savemat

from unips_jax.cli import main as cli
from unips_jax.errors import InputError
from unips_jax.estimation import streaming, writing
from unips_jax.evaluation.benchmarks import open_benchmark
from unips_jax.io.color import as_linear


@pytest.mark.parametrize("mask", [True, False])
def test_reads_what_was_stored(tmp_path, mask):
    data.make_folder(tmp_path, mask=mask)
    data.write_image(tmp_path / "cup" / "baseColor.png", np.zeros((3, 3, 3), np.uint8))
    benchmark = open_benchmark("folder", tmp_path)
    item = benchmark[0]
    assert [p.name for p in benchmark.entries[0].images] == [
        f"IMG_{i}.PNG" for i in (8, 9, 10, 11, 12)
    ]
    inside, normals = data.sphere(20, 20)
    expected = inside if mask else normals.any(-1)
    np.testing.assert_array_equal(item.mask, expected)
    single = open_benchmark("folder", tmp_path / "shoe")
    assert len(single) == 1 and single[0].images.shape[1:3] == (20, 21)


def test_lights_are_those_of_a_list(tmp_path):
    """By name, in any order; names may have another format."""
    root = data.make_folder(tmp_path / "sets")
    directions = data.lights(5, seed=0)
    lines = [
        f"img_{i + 8}.jpg {x} {y} {z}" for i, (x, y, z) in enumerate(3 * directions)
    ]
    path = root / "cup" / "dome.LP"
    path.write_text("\n".join(["5", *lines[::-1]]))
    cup, shoe = open_benchmark("folder", root)
    np.testing.assert_allclose(cup.lights.directions, directions, atol=1e-6)
    assert (cup.lights.intensities == 1).all() and shoe.lights is None
    given = ["--benchmark", "folder", "--root", str(root), "--workdir"]
    given += [str(tmp_path / "work"), "--objects", "cup", "--no-pictures"]
    assert cli.main(["eval", *given, "-m", "least-squares"]) == 0
    (result,) = (tmp_path / "work").rglob("cup/least-squares*.json")
    assert json.loads(result.read_text())["score"]["median"] < 0.1


@pytest.mark.parametrize(
    ("listed", "said"),
    [
        ("IMG_8.PNG 5 7\nIMG_9.PNG 6 7", "expected directions, three numbers"),
        ("a.png 0 0 1\nb.png 0 0 1", "has none of IMG_8.PNG"),
        ("IMG_8 0 0 1\nIMG_9 0 0 0", "got one of length 0"),
    ],
)
def test_a_list_that_gives_no_lights_is_named(tmp_path, listed, said):
    root = data.make_folder(tmp_path)
    (root / "cup" / "a.lp").write_text(listed)
    cup = open_benchmark("folder", root)[0]
    assert cup.lights is None
    (note,) = (note for note in cup.notes if "lights not known: a.lp" in note)
    assert said in note


@pytest.mark.parametrize("suffix", [".npy", ".mat"])
def test_truth_may_be_an_array(tmp_path, suffix):
    mask, normals = data.sphere(9, 11)
    for i in range(3):
        data.write_image(tmp_path / "cup" / f"{i}.png", np.full((9, 11), 50, np.uint8))
    path = tmp_path / "cup" / f"Normal_gt{suffix}"
    np.save(path, normals) if suffix == ".npy" else savemat(path, {"n": normals})
    item = open_benchmark("folder", tmp_path)[0]
    np.testing.assert_array_equal(item.mask, mask)
    np.testing.assert_allclose(item.normals, normals, atol=1e-6)
    data.write_image(tmp_path / "cup" / "normals.png", data.to16((normals + 1) / 2))
    (entry,) = open_benchmark("folder", tmp_path).entries
    assert entry.files[0] == path
    assert entry.notes == (f"true normals of {path.name}, not normals.png",)
    path.unlink()
    np.save(tmp_path / "cup" / "normal.npy", np.where(mask[..., None], normals, np.nan))
    assert open_benchmark("folder", tmp_path).entries[0].files[0].suffix == ".png"
    (tmp_path / "cup" / "normals.png").unlink()
    np.testing.assert_array_equal(open_benchmark("folder", tmp_path)[0].mask, mask)
    np.save(tmp_path / "cup" / "normal.npy", normals[..., 0])
    with pytest.raises(InputError, match=r"expected normals \[H, W, 3\], got \(9, 11"):
        open_benchmark("folder", tmp_path)[0]


def test_truth_of_another_encoding_is_refused(tmp_path):
    data.make_folder(tmp_path)
    _, normals = data.sphere(20, 20)
    np.save(tmp_path / "cup" / "normal_gt.npy", (normals + 1) / 2)
    with pytest.raises(InputError, match="cup: expected true normals of length 1, got"):
        open_benchmark("folder", tmp_path)[0]


def test_floats_above_1_are_divided(tmp_path):
    """`woodham` clips at 1."""
    root = data.make_folder(tmp_path / "sets")
    _, normals = data.sphere(20, 20)
    directions = data.lights(5, seed=0)
    for i, image in enumerate(data.shade(normals, directions)):
        (root / "cup" / f"IMG_{i + 8}.PNG").unlink()
        cv2.imwrite(str(root / "cup" / f"{i}.tif"), np.float32(20 * image))
    lines = [f"{i}.tif {x} {y} {z}" for i, (x, y, z) in enumerate(directions)]
    (root / "cup" / "dome.lp").write_text("\n".join(lines))
    item = open_benchmark("folder", root, objects=["cup"])[0]
    assert item.images.max() == 1
    assert any("photographs divided by" in note for note in item.notes)


@pytest.mark.parametrize("benchmark", ["folder", "ps-wild"])
def test_names_that_are_not_unicode(tmp_path, benchmark):
    folder = tmp_path / "sets" / "plain.data"
    _, normals = data.sphere(20, 20)
    for i, image in enumerate(data.shade(normals, data.lights(3, seed=0))):
        data.write_image(folder / f"L_{i}.png", data.to16(image))
    data.write_image(folder / "normal.tif", data.encode16(normals))
    (folder / "L_2.png").rename(folder / os.fsdecode(b"L_\xe9.png"))
    folder.rename(folder.with_name(os.fsdecode(b"caf\xe9.data")))
    given = ["--benchmark", benchmark, "--root", str(tmp_path / "sets"), "--workdir"]
    given += [str(tmp_path / "work"), "-m", "constant", "--no-pictures"]
    assert cli.main(["eval", *given]) == 0
    table = (tmp_path / "work" / "tables" / "figures.csv").read_text()
    assert "caf\N{REPLACEMENT CHARACTER}" in table


def test_takes_the_focal_length_from_exif(tmp_path):
    _, normals = data.sphere(9, 11)
    data.write_image(tmp_path / "normal.png", data.to16((normals + 1) / 2))
    jpeg = cv2.imencode(".jpg", np.full((9, 11, 3), 90, np.uint8))[1].tobytes()
    entry = struct.pack("<HHIHH", 0xA405, 3, 1, 50, 0)  # 50 mm, 35 mm equivalent
    pointer = struct.pack("<HHII", 0x8769, 4, 1, 26)
    tiff = b"II*\0\10\0\0\0\1\0" + pointer + b"\0\0\0\0\1\0" + entry + b"\0\0\0\0"
    body = b"Exif\0\0" + tiff
    segment = b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])
    item = open_benchmark("folder", tmp_path)[0]
    assert item.focal == pytest.approx(50 / np.hypot(36, 24) * np.hypot(9, 11))


def test_reads_exr_truth_and_grey_photographs(tmp_path):
    mask, normals = data.sphere(9, 11)
    for i in range(3):
        data.write_image(tmp_path / f"{i}.tif", np.full((9, 11), i + 1, np.uint8))
    pixels = np.ascontiguousarray(normals, np.float32)
    header = {"type": OpenEXR.scanlineimage}
    channels = {"RGB": OpenEXR.Channel("RGB", pixels)}
    with OpenEXR.File(header, channels) as file:
        file.write(str(tmp_path / "Normal_gt.exr"))
    item = open_benchmark("folder", tmp_path)[0]
    inside = normals.any(-1)
    np.testing.assert_array_equal(item.mask, inside)
    np.testing.assert_array_equal(item.normals[inside], pixels[inside])
    assert item.images.shape == (3, 9, 11, 3)
    np.testing.assert_allclose(item.images[2], 3 / 255 / 12.92, rtol=1e-6)
    assert item.notes == ("photographs taken as sRGB (8-bit values) and made linear",)


def test_exr_truth_is_placed_by_its_windows(tmp_path):
    _, normals = data.sphere(9, 11)
    data.write_image(tmp_path / "0.tif", np.full((9, 11), 7, np.uint8))
    header = {
        "type": OpenEXR.scanlineimage,
        "dataWindow": (np.int32([2, 1]), np.int32([9, 8])),
        "displayWindow": (np.int32([0, 0]), np.int32([10, 8])),
    }
    pixels = np.ascontiguousarray(normals[1:9, 2:10], np.float32)
    with OpenEXR.File(header, {"RGB": pixels}) as file:
        file.write(str(tmp_path / "normal.exr"))
    expected = np.zeros((9, 11, 3), np.float32)
    expected[1:9, 2:10] = pixels
    item = open_benchmark("folder", tmp_path)[0]
    np.testing.assert_array_equal(item.normals, expected)


def test_objects_are_named_as_given(tmp_path):
    for name in ("a", "b"):
        data.make_folder(tmp_path / "captures" / name)
        linked = tmp_path / "set" / name
        linked.parent.mkdir(exist_ok=True)
        linked.symlink_to(tmp_path / "captures" / name / "cup")
    benchmark = open_benchmark("folder", tmp_path / "set")
    assert [entry.name for entry in benchmark.entries] == ["a", "b"]
    (tmp_path / "set" / "b").rename(tmp_path / "set" / "a.data")
    with pytest.raises(InputError, match="two named 'a'; rename one"):
        open_benchmark("folder", tmp_path / "set")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_gives_the_network_what_estimate_does(tmp_path, monkeypatch, dtype):
    """To the bit, from a folder with an example of all that readers differ in."""
    given = []

    def stand_in(network, images, mask, *, transfer="linear", **options):
        given.append((as_linear(images, transfer), mask))
        normals = mask[..., None] * np.float32([0, 0, 1])
        return streaming.NormalsAndLights(normals, None)

    monkeypatch.setattr(streaming, "estimate_with_lights", stand_in)
    monkeypatch.setattr(writing, "write_sheet", lambda *args, **options: None)
    folder, size = tmp_path / "photographs" / "shoe", (HEIGHT, WIDTH)
    inside, normals = data.sphere(*size)
    data.write_image(tmp_path / "photographs/shoe/normal.png", data.encode16(normals))
    for name, seed in (("IMG_9.png", 0), ("IMG_10.png", 1), ("a.tif", 2)):
        save(folder / name, smooth(dtype, seed))
    save(folder / "gray.png", smooth(dtype, 3)[..., 0])
    save(folder / "clear.png", smooth(dtype, 4)[..., [0, 1, 2, 0]])
    for path in folder.glob("[!n]*.png"):
        path.write_bytes(png_with_orientation(path.read_bytes(), 3))
    path = folder / "a.tif"
    path.write_bytes(tiff_with_orientation(path.read_bytes(), 3))
    if dtype == np.uint8:
        path = save(folder / "b.jpg", smooth(dtype, 5))
        path.write_bytes(with_orientation(path.read_bytes(), 3))
    for name in (".thumbnail.jpg", "sheet.png", "shoeNormals.png", "albedo.jpg"):
        save(folder / name, smooth(np.uint8, 6, 7, 8))
    (folder / "c.psd").write_bytes(b"raw")
    mask = np.full((*size, 4), 255, np.uint8)
    mask[..., 3] *= inside
    save(folder / "mask.png", mask)

    assert cli.main(["estimate", str(folder), "-o", str(tmp_path / "out")]) == 0
    root = ["--root", str(folder.parent), "--workdir", str(tmp_path / "work")]
    options = ["--benchmark", "folder", "--method", "unips", "--no-pictures"]
    assert cli.main(["eval", *root, *options]) == 0
    (images, mask), (ours, our_mask) = given
    assert len(images) == (6 if dtype == np.uint8 else 5)
    np.testing.assert_array_equal(ours, images)
    np.testing.assert_array_equal(our_mask, mask)
    np.testing.assert_array_equal(mask, inside)


def test_refuses_photographs_of_another_size_than_the_truth(tmp_path):
    data.make_folder(tmp_path, mask=False)
    _, normals = data.sphere(21, 22)
    data.write_image(tmp_path / "cup" / "normal.png", data.encode16(normals))
    benchmark = open_benchmark("folder", tmp_path)
    for read in (benchmark.check, benchmark.__getitem__):
        with pytest.raises(InputError, match=r"22 x 21 pixels as normal\.png, got 20"):
            read(0)
