"""A folder of results that several processes may fill together.

Each result is a JSON file, put in place in one step after its normal map; it exists
whole or not at all. Work is claimed by a file per result, and files are only written
under the claim; see `io.claims`.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.claims import claim, slug
from unips_jax.io.door import clear_parts, write_whole
from unips_jax.io.images import encode_image
from unips_jax.io.normals import encode_normals, read_normals

_FOLDERS = ("results", ".locks")


def result_key(fields: Mapping[str, Any]) -> str:
    """A short hash of everything, JSON values, that a result depends on."""
    text = json.dumps(fields, sort_keys=True, default=repr)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def is_work_folder(folder: Path) -> bool:
    """Whether a `Store` keeps results there."""
    return all((folder / name).is_dir() for name in _FOLDERS)


class Store:
    """The folder `root`; it can be written to."""

    def __init__(self, root: str | os.PathLike[str]):
        self.root = Path(root)
        try:
            for name in _FOLDERS:
                (self.root / name).mkdir(parents=True, exist_ok=True)
                clear_parts(self.root / name)
        except OSError as error:
            raise InputError(
                f"{self.root}: cannot be the work folder ({error.strerror})"
            ) from error
        if not os.access(self.root / "results", os.W_OK):
            raise InputError(
                f"{self.root}: expected a work folder that can be written to, got one "
                "that cannot; give another --workdir, or the right to write"
            )

    @contextlib.contextmanager
    def claim(self, name: str, *, wait: bool = False) -> Iterator[bool]:
        """Claims a piece of work until the block ends; see `io.claims.claim`."""
        with claim(self.root / ".locks" / slug(name), wait=wait) as ours:
            yield ours

    def path(self, name: str) -> Path:
        """Where a result's JSON lies."""
        return self.root / "results" / f"{name}.json"

    def done(self, name: str) -> bool:
        """Whether the result is there."""
        return self.path(name).is_file()

    def load(self, name: str) -> dict[str, Any]:
        """Reads a result, which someone else may have changed: then `InputError`."""
        path = self.path(name)
        try:
            return json.loads(path.read_bytes())
        except (OSError, ValueError) as error:
            raise InputError(
                f"{path}: not a result ({error}); delete it to have it computed again"
            ) from error

    def commit(
        self, name: str, record: Mapping[str, Any], normals: np.ndarray | None
    ) -> None:
        """Puts a result, JSON values, and its normals in place; it has been claimed."""
        path = self.path(name)
        if normals is not None:
            pixels = encode_normals(normals)
            write_whole(path.with_suffix(".png"), encode_image(".png", pixels))
        text = json.dumps(record, indent=1, sort_keys=True) + "\n"
        write_whole(path, text.encode())

    def normals(self, name: str) -> np.ndarray:
        """A result's normal map, `[H, W, 3]`, float32, unit or zero."""
        path = self.path(name).with_suffix(".png")
        try:
            return read_normals(path)
        except InputError as error:
            raise InputError(
                f"{error} (a stored result: delete the .json next to it to have both "
                "computed again)"
            ) from None
