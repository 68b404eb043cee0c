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

import cv2
import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.claims import claim, slug, write_whole


def result_key(fields: Mapping[str, Any]) -> str:
    """A short hash of everything a result depends on.

    Args:
        fields: JSON values.
    """
    text = json.dumps(fields, sort_keys=True, default=repr)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


class Store:
    """The folder.

    Attributes:
        root: where everything is.
    """

    def __init__(self, root: str | os.PathLike[str]):
        """Makes the folder.

        Raises:
            InputError: if it cannot be made or written to.
        """
        self.root = Path(root)
        try:
            for name in ("results", ".locks"):
                (self.root / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.root}: cannot be the work folder ({error.strerror})"
            ) from error
        if not os.access(self.root / "results", os.W_OK):
            raise InputError(f"{self.root}: cannot be written to")

    @contextlib.contextmanager
    def claim(self, name: str, *, wait: bool = False) -> Iterator[bool]:
        """Claims a piece of work until the block ends.

        Args:
            name: of the work.
            wait: until nobody else has it.

        Yields:
            Whether it is ours.
        """
        with claim(self.root / ".locks" / slug(name), wait=wait) as ours:
            yield ours

    def path(self, name: str) -> Path:
        """Where a result's JSON lies."""
        return self.root / "results" / f"{name}.json"

    def done(self, name: str) -> bool:
        """Whether the result is there."""
        return self.path(name).is_file()

    def load(self, name: str) -> dict[str, Any]:
        """Reads a result.

        Raises:
            InputError: if someone else than this program changed it.
        """
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
        """Puts a result in place. The caller has claimed it.

        Args:
            name: of the result.
            record: JSON values.
            normals: `[H, W, 3]`, unit or zero, kept as a 16-bit PNG, (n + 1) / 2.

        Raises:
            InputError: if it cannot be written.
        """
        path = self.path(name)
        if normals is not None:
            write_whole(path.with_suffix(".png"), encode_normals(normals))
        text = json.dumps(record, indent=1, sort_keys=True) + "\n"
        write_whole(path, text.encode())

    def normals(self, name: str) -> np.ndarray:
        """A result's normal map, `[H, W, 3]`, float32, unit or zero.

        Raises:
            InputError: if someone else than this program changed it.
        """
        path = self.path(name).with_suffix(".png")
        data = np.frombuffer(path.read_bytes() if path.is_file() else b"", np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
        if image is None:
            raise InputError(
                f"{path}: expected a normal map, got a missing or damaged file; delete "
                "the .json beside it to have both computed again"
            )
        normals = image[..., ::-1].astype(np.float32) * np.float32(2 / 65535) - 1
        # Zero lies between two of the 65,536 steps.
        is_zero = (np.abs(normals) < 1e-4).all(axis=-1, keepdims=True)
        return np.where(is_zero, np.float32(0), normals)


def encode_normals(normals: np.ndarray) -> bytes:
    """A normal map as a 16-bit PNG, rounded; not finite becomes zero.

    Args:
        normals: `[H, W, 3]`.
    """
    values = np.nan_to_num(normals.astype(np.float64), nan=0, posinf=0, neginf=0)
    stored = np.rint((np.clip(values, -1, 1) + 1) * (65535 / 2)).astype(np.uint16)
    return cv2.imencode(".png", np.ascontiguousarray(stored[..., ::-1]))[1].tobytes()
