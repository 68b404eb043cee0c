"""What importing the package pulls in."""

import subprocess
import sys


def test_import_is_light():
    code = (
        "import sys, unips_jax; "
        "heavy = {'orbax', 'grain', 'cv2', 'matplotlib', 'tyro'}; "
        "found = heavy & {name.split('.')[0] for name in sys.modules}; "
        "assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_import_needs_no_fcntl():
    """Windows has none; only claims on work need it."""
    code = """
import importlib, pathlib, sys
sys.modules["fcntl"] = None
from unips_jax.cli.main import COMMANDS
from unips_jax.io.claims import claim
from unips_jax.errors import InputError
for module, _ in COMMANDS.values():
    importlib.import_module(f"unips_jax.{module}")
try:
    with claim(pathlib.Path("lock")):
        raise AssertionError("claimed without flock")
except InputError as error:
    assert "lock: expected a system with flock" in str(error)
"""
    subprocess.run([sys.executable, "-c", code], check=True)
