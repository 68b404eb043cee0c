"""What a record of results, `normals.json`, may hold: checked once, when it is read.

Records come from others: names may point anywhere, numbers may be none. Fields that
older versions did not write may be missing; those that are there have their types.
"""

import json
import math
import os
import stat
from pathlib import Path
from typing import Any, Literal

from unips_jax.checks import require_type
from unips_jax.errors import InputError

_APART = "/\0\\" if os.name == "nt" else "/\0"  # what no name of a file has
_LARGEST = 16_000_000  # bytes: ten thousand photographs need two million
_FIELDS: dict[str, Any] = {
    "unips_jax": str,
    "code": str,
    "date": str,
    "folder": str,
    "images": dict[str, str],
    "left_out": dict[str, list[str]],
    "mask": str | None,
    "mask_hash": str | None,
    "transfer": Literal["linear", "srgb"],
    "transfer_rule": str,
    "options": dict[str, Any],
    "weights": dict[str, Any],
    "surface": dict[str, Any] | None,
    "moved_back": dict[str, Any] | None,
    "orientation": int,  # by EXIF, 1 to 8; of HEIC 1, as every program turns it
    "exif_orientation": int,  # of HEIC, too
    "warnings": list[str],
    "width": int,
    "height": int,
    "files": dict[str, str],
}
_WEIGHTS: dict[str, Any] = {"name": str, "hash": str}
_SURFACE: dict[str, Any] = {
    "camera": str,
    "unit": str,
    "scale": int | float,
    "focal_px": int | float | None,
    "near": int | float,
    "far": int | float,
}


def load_record(path: Path) -> dict[str, Any]:
    """Reads and checks a record."""
    try:
        _require_regular(path)
        if path.stat().st_size > _LARGEST:
            raise ValueError(f"expected at most {_LARGEST:,} bytes")
        record = json.loads(path.read_bytes(), parse_constant=_no_number)
        _check(record)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: expected a record of `unips estimate`: {reason}; estimate anew"
        ) from None
    return record


def file_of(folder: Path, name: str) -> Path:
    """A file that a record names, which must be a regular one."""
    path = folder / name
    try:
        _require_regular(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    return path


def _require_regular(path: Path) -> None:
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("expected a regular file, got a folder, pipe or device")


def _no_number(constant: str) -> float:
    raise ValueError(f"expected finite numbers, got {constant}")


def _check(record: Any) -> None:
    """Raises ValueError unless it is a record."""
    require_type("record", record, dict[str, Any])
    _check_fields("", record, _FIELDS)
    if "files" not in record:
        raise ValueError("files: expected their names and hashes, got none")
    _require_path("folder", record.get("folder", ""))
    for field in ("files", "images"):
        for name in record.get(field, ()):
            _require_plain(field, name)
    if record.get("weights"):
        missing = _WEIGHTS.keys() - record["weights"].keys()
        if missing:
            raise ValueError(f"weights: expected {', '.join(missing)}, got none")
        _check_fields("weights.", record["weights"], _WEIGHTS)
    surface = record.get("surface")
    if surface:
        _check_fields("surface.", surface, _SURFACE)
        for name in ("scale", "focal_px"):
            value = surface.get(name)
            if value is not None and not value > 0:
                raise ValueError(f"surface.{name}: expected above 0, got {value}")


def _check_fields(prefix: str, values: dict[str, Any], kinds: dict[str, Any]) -> None:
    for name, kind in kinds.items():
        if name not in values:
            continue
        value = values[name]
        require_type(prefix + name, value, kind)
        number = isinstance(value, int | float)
        # JSON has numbers that Python reads as infinite, and true for 1.
        if number and (isinstance(value, bool) or not _finite(value)):
            raise ValueError(f"{prefix}{name}: expected a finite number, got {value}")


def _finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


def _require_path(field: str, path: str) -> None:
    try:
        encoded = os.fsencode(path)
    except UnicodeEncodeError:
        encoded = b"\0"
    if b"\0" in encoded:
        raise ValueError(f"{field}: expected a path, got {path!r:.100}")


def _require_plain(field: str, name: str) -> None:
    _require_path(field, name)
    if name in ("", ".", "..") or any(c in name for c in _APART):
        raise ValueError(f"{field}: expected plain names of files, got {name!r:.100}")
