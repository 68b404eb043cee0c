"""The small network computes what it computed when `tests/golden` was written."""

import runpy
from pathlib import Path

import numpy as np
import pytest

TESTS = Path(__file__).parent
TOOL = runpy.run_path(str(TESTS.parent / "tools/make_golden.py"))


@pytest.mark.parametrize("name", sorted(TOOL["CONFIGS"]))
def test_small_network_is_unchanged(name):
    actual = TOOL["golden_arrays"](TOOL["CONFIGS"][name])
    with np.load(TESTS / "golden" / f"{name}.npz") as expected:
        assert set(expected) == set(actual)
        for key, value in expected.items():
            size = np.linalg.norm(value)
            error = np.linalg.norm(actual[key] - value)
            assert error <= 1e-4 * size + 1e-6, key
