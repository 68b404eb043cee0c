"""Writes normals to disk: all files of a folder at once, or none.

Arrays (`.npy`, `.mat`) hold unit normals, x right, y up, z towards the viewer, 0 on
the background. Normal maps are for graphics programs: 16-bit PNG holding
`round((n + 1) / 2 * 65535)` in R, G, B, with 32768 on the background (which decodes to
within 1e-5 of 0), and float EXR holding n. DirectX maps have y, the green channel,
flipped; OpenGL maps do not.
"""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from unips_jax.errors import InputError

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
    write_png(folder / "normals.png", encode_normals(flipped)[..., ::-1])
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


def write_png(file: Path, pixels: np.ndarray) -> None:
    """Writes a PNG; unlike `cv2.imwrite` under names of any characters.

    Args:
        file: where.
        pixels: `[H, W, 3]`, uint8 or uint16, blue first.
    """
    file.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def encode_normals(normals: np.ndarray) -> np.ndarray:
    """Maps [-1, 1] to 16 bit: `[H, W, 3]` float to uint16, 0 to 32768.

    Args:
        normals: components in [-1, 1].
    """
    values = np.multiply(normals, _FULL / 2, dtype=np.float32)
    values += _FULL / 2 + 0.5  # rounds half up
    return np.clip(values, 0, _FULL, out=values).astype(np.uint16)


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
