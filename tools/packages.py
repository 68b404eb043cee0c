"""Packages from registries, pinned by name, version and hash."""

import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path

from unips_jax.errors import InputError

# Of archives whose hash is not known yet, nothing may run.
NPM = ("npm", "pack", "--silent", "--ignore-scripts")
PIP = (
    sys.executable,
    *"-m pip download --quiet --no-deps --only-binary :all:".split(),
)


def fetch(name: str, sha512: str, tool: tuple[str, ...] = NPM) -> bytes:
    """A package's archive.

    Args:
        name: with its version, as the tool takes it.
        sha512: of the archive.
        tool: the command that writes the archive into the folder where it runs.

    Raises:
        InputError: if it cannot be had, or is another one.
    """
    with tempfile.TemporaryDirectory() as folder:
        try:
            subprocess.run(
                [*tool, name], cwd=folder, check=True, capture_output=True, text=True
            )
        except FileNotFoundError:
            raise InputError(f"{tool[0]}: expected on the path, found none") from None
        except subprocess.CalledProcessError as error:
            raise InputError(f"{name}: {error.stderr.strip()[-300:]}") from None
        (archive,) = Path(folder).iterdir()
        data = archive.read_bytes()
    found = hashlib.sha512(data).hexdigest()
    if found != sha512:
        raise InputError(
            f"{name}: expected an archive of SHA-512 {sha512[:16]}..., got "
            f"{found[:16]}..."
        )
    return data
