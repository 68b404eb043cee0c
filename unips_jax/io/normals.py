"""Normals as pixels, and on disk: all files of a folder at once, or none.

Arrays (`.npy`, `.mat`) hold unit normals, x right, y up, z towards the viewer, 0 on
the background. Normal maps are images of integers, `(n + 1) / 2` of full scale rounded
to the nearest in R, G, B, or float images (EXR, TIFF) holding n. Zero lies between two
of the integers; the upper one, 32768 of 16 bits, stands for it. Either, in all three
channels, is read as 0. DirectX maps have y, the green channel, flipped; OpenGL maps do
not.
"""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.images import ImageFile, read_image_file, require_finite, write_image

NormalMap = Literal["opengl", "directx"]

RECORD = "normals.json"
_RESULTS = frozenset(
    ("normals.png", "normals.npy", "normals.exr", "normals.mat", "sheet.png", RECORD)
)
_FULL = 65535


def write_normals(
    folder: Path,
    normals: np.ndarray,
    *,
    exr: bool = False,
    mat: bool = False,
    normal_map: NormalMap = "opengl",
) -> None:
    """Writes `normals.png` and `normals.npy`, and on request `.exr` and `.mat`.

    Args:
        folder: where; it exists.
        normals: `[H, W, 3]`, float32, unit length or 0.
        exr: also write `normals.exr`.
        mat: also write `normals.mat`, for MATLAB, key `Normal_est`.
        normal_map: convention of the PNG and the EXR.
    """
    flipped = flip_green(normals) if normal_map == "directx" else normals
    write_image(folder / "normals.png", encode_normals(flipped))
    np.save(folder / "normals.npy", normals)
    if exr:
        import OpenEXR

        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
        }
        channels = {"RGB": np.ascontiguousarray(flipped)}
        OpenEXR.File(header, channels).write(str(folder / "normals.exr"))
    if mat:
        import scipy.io

        scipy.io.savemat(folder / "normals.mat", {"Normal_est": normals})


def encode_normals(normals: np.ndarray) -> np.ndarray:
    """Normals as 16-bit colours: `[H, W, 3]` uint16; see the module.

    Args:
        normals: `[H, W, 3]`, components in [-1, 1]; 0 where there is none. What is not
            finite becomes 0.
    """
    values = np.array(normals, np.float32)
    np.nan_to_num(values, copy=False, nan=0, posinf=0, neginf=0)
    values *= _FULL / 2
    values += _FULL / 2 + 0.5  # the nearest integer is the one below
    return np.clip(values, 0, _FULL, out=values).astype(np.uint16)


def decode_normals(values: np.ndarray) -> np.ndarray:
    """Normals from a normal map's values: `[H, W, 3]` float32, not normalised.

    Args:
        values: `[H, W, 3]`, uint8, uint16, or float32, which holds normals already.
    """
    if values.dtype == np.float32:
        return values
    top = np.iinfo(values.dtype).max
    normals = (values * (2 / top) - 1).astype(np.float32)
    normals[((values == top // 2) | (values == top // 2 + 1)).all(axis=-1)] = 0
    return normals


def read_normals(path: Path) -> np.ndarray:
    """Reads a normal map: `[H, W, 3]`, float32, as stored: not normalised.

    Args:
        path: an image of 8 or 16 bits, or a float EXR or TIFF.

    Raises:
        InputError: if the image cannot be read or has not three channels of finite
            values.
    """
    return normals_of(read_image_file(path, vectors=True))


def normals_of(file: ImageFile) -> np.ndarray:
    """What a normal map's image holds; see `read_normals`.

    Args:
        file: the image.

    Raises:
        InputError: if it has not three channels of finite values.
    """
    if file.pixels.shape[2] != 3:
        raise InputError(
            f"{file.path}: expected a normal map of 3 channels, got {file.channels}"
        )
    require_finite(file.path, file.pixels)
    return decode_normals(file.pixels)


def has_unit_length(normals: np.ndarray, tolerance: float = 1e-3) -> np.ndarray:
    """PS-Wild's rule for the object's pixels, | 1 - |n| | < 1e-3: `[H, W]`, bool.

    Args:
        normals: `[H, W, 3]`.
        tolerance: in place of 1e-3.
    """
    length = np.linalg.norm(normals.astype(np.float64), axis=-1)
    return np.abs(1 - length) < tolerance


def flip_green(normals: np.ndarray) -> np.ndarray:
    """Negates y: turns an OpenGL normal map to a DirectX one, and back.

    Args:
        normals: `[..., 3]`.
    """
    return normals * np.array([1, -1, 1], normals.dtype)


def write_record(folder: Path, record: dict[str, Any]) -> list[str]:
    """Writes `normals.json`: how these normals came about, and the list of files.

    Args:
        folder: where; the other files are there already.
        record: JSON values.

    Returns:
        The names of all files of the folder.
    """
    names = sorted([*(file.name for file in folder.iterdir()), RECORD])
    text = json.dumps({**record, "files": names}, indent=2, ensure_ascii=False)
    # Names that are not Unicode become JSON's escapes.
    data = (text + "\n").encode(errors="backslashreplace")
    (folder / RECORD).write_bytes(data)
    return names


def check_target(target: Path, source: Path) -> None:
    """Refuses to write where something that is not ours would be overwritten.

    Args:
        target: folder for the results; need not exist.
        source: folder of the photographs.

    Raises:
        InputError: if the target is the source, a file, or a folder with files that
            this program did not write.
    """
    if target.resolve() == source.resolve():
        raise InputError(
            f"{target}: expected another place for the results than the photographs' "
            "own folder; choose another -o"
        )
    if target.exists() and not target.is_dir():
        raise InputError(
            f"{target}: expected a folder for the results, got a file; choose another "
            "-o"
        )
    if target.is_dir() and any(target.iterdir()) and not (target / RECORD).is_file():
        raise InputError(
            f"{target}: expected a new folder or one with earlier results "
            f"({RECORD}), got one with other files; choose another -o"
        )
    place = next(p for p in (target, *target.absolute().parents) if p.exists())
    if not (place.is_dir() and os.access(place, os.W_OK)):
        raise InputError(
            f"{target}: cannot be written, {place} is a file or may not be written to; "
            "choose another -o"
        )


@contextlib.contextmanager
def appearing_at_once(target: Path) -> Iterator[Path]:
    """Gives a temporary folder whose files appear in `target` when all are written.

    A new target appears by one rename. In a target with earlier results each file is
    replaced, the record last, and earlier results that were not written again go. If
    anything fails before, the target stays as it was.

    Args:
        target: the folder of the results.

    Raises:
        InputError: if the file system refuses.
    """
    temporary = target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        prefix, suffix = f".{target.name}.", ".partial"
        temporary = Path(tempfile.mkdtemp(suffix, prefix, target.parent))
        temporary.chmod(0o755)
        yield temporary
        if not target.exists():
            temporary.rename(target)
            return
        written = sorted(temporary.iterdir(), key=lambda file: file.name == RECORD)
        for file in written:
            file.replace(target / file.name)
        for name in _RESULTS - {file.name for file in written}:
            (target / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error}") from None
    finally:
        if temporary != target:
            shutil.rmtree(temporary, ignore_errors=True)
