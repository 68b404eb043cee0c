"""MATLAB files, sound and damaged."""

import io
import zlib

import numpy as np
import pytest
from scipy.io import savemat

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks.files import read_mat, read_mat_normals

NORMALS = np.random.default_rng(0).random((3, 4, 3), np.float32)
OTHERS = {
    "complex": NORMALS[0] + 1j,
    "text": "some text",
    "cell": np.array([NORMALS, 1], object),
    "struct": {"x": NORMALS},
    "k": np.uint8(3),
}


def stored(variables, **options):
    file = io.BytesIO()
    savemat(file, variables, **options)
    return bytearray(file.getvalue())


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_of_numbers_are_read(tmp_path, compressed):
    data = stored({**OTHERS, "Normal_gt": NORMALS}, do_compression=compressed)
    (tmp_path / "a.mat").write_bytes(data)
    np.testing.assert_array_equal(read_mat_normals(tmp_path / "a.mat"), NORMALS)
    found = read_mat(tmp_path / "a.mat", ("complex", "k"))
    np.testing.assert_array_equal(found["complex"], OTHERS["complex"])
    assert found["k"] == 3
    with pytest.raises(InputError, match=r"no variable 'text', found \['Normal_gt', "):
        read_mat(tmp_path / "a.mat", ("text",))


def test_version_4(tmp_path):
    (tmp_path / "a.mat").write_bytes(stored({"n": NORMALS[0]}, format="4"))
    found = read_mat(tmp_path / "a.mat", ("n",))["n"]
    np.testing.assert_array_equal(found, NORMALS[0])


# Sizes of the variable's name, and types of its values, behind the file's header.
@pytest.mark.parametrize(
    ("place", "value"),
    [(52, 1), (52, 5), (72, 0), (72, 14), (72, 15), (72, 20), (72, 255), (73, 1)],
)
@pytest.mark.parametrize("compressed", [False, True])
def test_damage_that_ends_scipys_process(tmp_path, place, value, compressed):
    data = stored({"Normal_gt": NORMALS})
    data[128 + place] = value
    if compressed:
        packed = zlib.compress(data[128:])
        sizes = (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little")
        data[128:] = sizes + packed
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(InputError, match="a.mat: not a readable MATLAB file"):
        read_mat_normals(tmp_path / "a.mat")
