"""One reader for every image on disk: estimates, benchmarks and training agree."""

import os
import sys

import cv2
import evaluation_data as data
import numpy as np
import pytest
import tifffile
from picture_files import HEIGHT, WIDTH, save, smooth, with_orientation

from unips_jax.evaluation.benchmarks import open_benchmark
from unips_jax.evaluation.store import Store
from unips_jax.io.normals import decode_normals, encode_normals, read_normals
from unips_jax.io.official_photographs import read_official
from unips_jax.io.photographs import read_photographs
from unips_jax.io.ps_wild import PSWildFolders, read_object
from unips_jax.io.selection import select


def make_diligent(root, mask):
    """A set whose mask, in any format, is the file given."""
    data.make_diligent(root, objects=("ball",))
    folder = root / "pmsData" / "ballPNG"
    (folder / "mask.png").write_bytes(mask.read_bytes())
    return open_benchmark("diligent", root, objects=("ball",))


def both_masks(tmp_path, suffix, picture, quality=()):
    """What an estimate and a benchmark take for the object."""
    folder = tmp_path / "photographs"
    height, width = picture.shape[:2]
    save(folder / "a.png", smooth(np.uint8, 0, height, width))
    stored = cv2.imencode(suffix, picture, list(quality))[1].tobytes()
    path = folder / f"mask{suffix}"
    path.write_bytes(stored)
    benchmark = make_diligent(tmp_path / "set", path)
    entry = benchmark.entries[0]
    return read_photographs(select(folder)).mask, benchmark.truth(entry).mask


@pytest.fixture
def shape(tmp_path):
    """Height and width of the miniature set's photographs."""
    data.make_diligent(tmp_path / "probe", objects=("ball",))
    folder = tmp_path / "probe" / "pmsData" / "ballPNG"
    return cv2.imread(str(folder / "mask.png"), cv2.IMREAD_UNCHANGED).shape[:2]


def test_mask_by_transparency(tmp_path, shape):
    picture = np.zeros((*shape, 4), np.uint8)
    picture[3:5, 4:6, 3] = 255
    for mask in both_masks(tmp_path, ".png", picture):
        assert mask.sum() == 4


def test_mask_of_a_jpeg(tmp_path, shape):
    picture = np.zeros(shape, np.uint8)
    picture[1:9, 1:9] = 255
    quality = (cv2.IMWRITE_JPEG_QUALITY, 50)
    for mask in both_masks(tmp_path, ".jpg", picture, quality):
        assert mask.sum() == 64


def test_orientation_turns_photographs_of_benchmarks_too(tmp_path):
    data.make_directional(tmp_path / "pmsData" / "ballPNG", images=2)
    folder = tmp_path / "pmsData" / "ballPNG"
    mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_UNCHANGED)
    upright = smooth(np.uint8, 1, *mask.shape[:2])
    for name in (folder / "filenames.txt").read_text().split():
        path = save(folder / "a.jpg", np.ascontiguousarray(np.rot90(upright)))
        (folder / name).write_bytes(with_orientation(path.read_bytes(), 6))
    benchmark = open_benchmark("diligent", tmp_path, objects=("ball",))
    benchmark.check(0)
    assert np.abs(benchmark[0].images.astype(int) - upright).max() <= 4


def test_floats_keep_their_sign(tmp_path):
    values = np.float32([[[0, 0.6, 0.8], [-0.5, 0.5, 0.7071]]])
    tifffile.imwrite(tmp_path / "normal.tif", values, photometric="rgb")
    np.testing.assert_array_equal(read_normals(tmp_path / "normal.tif"), values)


def test_every_16_bit_normal_map_is_written_and_read_alike(tmp_path):
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 40, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[:9] = 0
    stored = encode_normals(normals)
    assert (stored[:9] == 32768).all()
    exact = (normals + 1) * (65535 / 2)
    # Half a level, and float32's rounding of values up to 65535.
    assert np.abs(stored[9:] - exact[9:]).max() <= 0.5 + 65535 * 2**-24
    decoded = decode_normals(stored)
    assert decoded.dtype == np.float32 and not decoded[:9].any()
    assert np.abs(decoded - normals).max() <= 1 / 65535 + 1.3e-7
    store = Store(tmp_path)
    store.commit("a", {}, normals)
    np.testing.assert_array_equal(store.normals("a"), decoded)
    for dtype, middle in ((np.uint8, (127, 128)), (np.uint16, (32767, 32768))):
        for value in middle:
            assert not decode_normals(np.full((1, 1, 3), value, dtype)).any()
    assert (encode_normals(np.full((1, 1, 3), np.nan)) == 32768).all()


OPENED: list[str] | None = None


def _listen(event, arguments):
    if event == "open" and OPENED is not None:
        OPENED.append(str(arguments[0]))  # a number where it is open already


@pytest.fixture(scope="session")
def hook():
    sys.addaudithook(_listen)


@pytest.fixture
def opened(hook):
    """Paths that Python opens during the test."""
    global OPENED
    OPENED = []
    yield OPENED
    OPENED = None


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".exr", ".webp", ".hdr"])
def test_photographs_and_masks_are_opened_once(tmp_path, opened, suffix):
    dtype = np.float32 if suffix in (".exr", ".hdr") else np.uint8
    for i in range(3):
        save(tmp_path / f"{i}{suffix}", smooth(dtype, i))
    save(tmp_path / "mask.png", np.full((HEIGHT, WIDTH, 4), 255, np.uint8))
    for read in (read_photographs, read_official):
        opened.clear()
        read(select(tmp_path))
        ours = [path for path in opened if path.startswith(str(tmp_path))]
        names = ["0", "1", "2", "mask"]
        assert sorted(os.path.basename(p).split(".")[0] for p in ours) == names


def test_benchmarks_and_training_open_photographs_once(tmp_path, opened):
    data.make_folder(tmp_path / "own")
    benchmark = open_benchmark("folder", tmp_path / "own")
    names = [path.name for path in benchmark.entries[0].images]
    for read in (benchmark.check, benchmark.__getitem__):
        opened.clear()
        read(0)
        found = [os.path.basename(p) for p in opened if str(tmp_path) in p]
        assert sorted(n for n in found if n in names) == sorted(names)
    data.make_ps_wild_train(tmp_path / "train")
    files = PSWildFolders(tmp_path / "train", min_images=2)[0]
    opened.clear()
    read_object(files, np.arange(2), 16)
    ours = [path for path in opened if str(tmp_path) in path]
    assert sorted(ours) == sorted(map(str, [*files.photographs[:2], files.normals]))
