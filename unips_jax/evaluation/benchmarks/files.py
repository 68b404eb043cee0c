"""Finding and reading the files other than images, with errors that name the file.

Everything here reads; nothing writes. A file that is missing, cut short or of another
kind raises `InputError`, never a library's own exception; `what` names what was
expected there.
"""

import io
from pathlib import Path

import numpy as np

from unips_jax.errors import InputError
from unips_jax.evaluation.benchmarks.matlab import read_arrays
from unips_jax.io import normals

_NORMAL_NAMES = ("Normal_est", "normals", "normal", "Normal", "N")


def require_folder(path: Path, what: str) -> Path:
    """Returns the path of a folder."""
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; expected {what}")
    return path


def require_file(path: Path, what: str) -> Path:
    """Returns the path of a file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected {what}")
    return path


def read_bytes(path: Path) -> bytes:
    """The file's bytes, at least one."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if not data:
        raise InputError(f"{path}: the file is empty")
    return data


def read_numbers(path: Path, columns: int, what: str, *, skip: int = 0) -> np.ndarray:
    """A text table of numbers separated by white space: `[lines, columns]`, float64.

    Blank lines are passed over, and `skip` leading ones that are not part of it.
    """
    require_file(path, what)
    text = read_bytes(path).decode("utf-8", "replace")
    rows = []
    for number, line in enumerate(text.splitlines()[skip:], skip + 1):
        fields = line.replace(",", " ").split()
        if not fields:
            continue
        try:
            row = [float(field) for field in fields]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise InputError(
                f"{path}, line {number}: expected {columns} finite numbers ({what}), "
                f"got {line.strip()[:60]!r}"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: no numbers; expected {what}")
    return np.array(rows)


def read_mat(path: Path, keys: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Variables of a MATLAB file (versions 4 to 7)."""
    require_file(path, f"a MATLAB file with {', '.join(keys)}")
    content = _variables(path)
    missing = [key for key in keys if key not in content]
    if missing:
        found = sorted(content)
        raise InputError(f"{path}: no variable {missing[0]!r}, found {found}")
    return {key: content[key] for key in keys}


def read_mat_normals(path: Path) -> np.ndarray:
    """Normals `[H, W, 3]` of a MATLAB file, as stored: the only ones, or by name."""
    content = {
        key: value
        for key, value in _variables(path).items()
        if value.ndim == 3 and value.shape[2] == 3 and value.dtype.kind in "fiu"
    }
    named = [key for key in _NORMAL_NAMES if key in content] or list(content)
    if not named or (len(named) > 1 and named[0] not in _NORMAL_NAMES):
        raise InputError(
            f"{path}: expected one variable [H, W, 3], or one named Normal_est, found "
            f"{sorted(content)}"
        )
    return content[named[0]].astype(np.float32)


def read_array_normals(path: Path) -> np.ndarray:
    """Normals `[H, W, 3]` of a `.npy` or `.mat` file, as stored."""
    is_mat = path.suffix.lower() == ".mat"
    values = read_mat_normals(path) if is_mat else normals.read_numbers(path)
    if values.ndim != 3 or values.shape[2] != 3:
        raise InputError(f"{path}: expected normals [H, W, 3], got {values.shape}")
    return values


def _variables(path: Path) -> dict[str, np.ndarray]:
    data = read_bytes(path)
    if data.startswith(b"MATLAB 7.3"):
        raise InputError(f"{path}: saved by MATLAB as -v7.3; save it again with -v7")
    try:
        return read_arrays(data)
    except Exception as error:  # scipy raises what its parser stumbles on
        raise InputError(
            f"{path}: not a readable MATLAB file ({type(error).__name__}: {error})"
        ) from error


def read_npz(path: Path, key: str) -> np.ndarray:
    """One array of a NumPy archive."""
    require_file(path, f"a NumPy archive with {key}")
    content = io.BytesIO(read_bytes(path))
    try:
        with np.load(content, allow_pickle=False) as archive:
            found = sorted(archive.files)
            if key in found:
                return archive[key]
    except Exception as error:  # damaged archives raise what they like
        raise InputError(f"{path}: not a readable NumPy archive ({error})") from error
    raise InputError(f"{path}: no array {key!r}, found {found}")
