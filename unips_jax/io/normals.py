"""Normals as pixels, and on disk.

Arrays (`.npy`, `.mat`) hold unit normals, x right, y up, z towards the viewer, 0 on the
background. Normal maps are images of integers, `(n + 1) / 2` of full scale rounded to
the nearest in R, G, B, or float images (EXR, TIFF) holding n. Zero lies between two of
the integers; the upper one, 32768 of 16 bits, stands for it. Either, in all three
channels, is read as 0. DirectX maps have y, the green channel, flipped; OpenCV's are in
the frame of its cameras, x right, y down, z away from the viewer; those of x-left have
x, the red channel, flipped; OpenGL's are as the arrays.
"""

import os
import stat
from pathlib import Path
from typing import Literal

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.door import new_file
from unips_jax.io.images import (
    ImageFile,
    read_image_file,
    require_finite,
    write_exr,
    write_image,
)

NormalMap = Literal["opengl", "directx", "opencv", "x-left"]

_SIGNS = {
    "opengl": (1, 1, 1),
    "directx": (1, -1, 1),
    "opencv": (1, -1, -1),
    "x-left": (-1, 1, 1),
}

_FULL = 65535


def write_normals(
    folder: str | os.PathLike[str],
    normals: np.ndarray,
    *,
    exr: bool = False,
    mat: bool = False,
    normal_map: NormalMap = "opengl",
) -> None:
    """Writes `normals.png` and `normals.npy`, and on request `.exr` and `.mat`.

    `normals` are floats `[H, W, 3]`, unit length or 0; `normals.mat` is for MATLAB, key
    `Normal_est`; `normal_map` is the convention of the PNG and the EXR. `ValueError`
    for another shape or convention, or the integers of a normal map, which
    `read_normals` decodes.
    """
    normals = np.asarray(normals)
    if normals.ndim != 3 or normals.shape[2] != 3 or normals.dtype.kind in "uib":
        raise ValueError(
            f"normals: expected floats [H, W, 3], got {normals.dtype} of "
            f"{normals.shape}; read_normals decodes a normal map"
        )
    normals = normals.astype(np.float32)
    folder, turned = Path(folder), turn_normals(normals, normal_map)
    write_image(folder / "normals.png", encode_normals(turned))
    with new_file(folder / "normals.npy") as file:
        np.save(file, normals)
    if exr:
        write_exr(folder / "normals.exr", {"RGB": turned})
    if mat:
        import scipy.io

        with new_file(folder / "normals.mat") as file:
            scipy.io.savemat(file, {"Normal_est": normals})


def encode_normals(normals: np.ndarray) -> np.ndarray:
    """Normals as 16-bit colours: `[H, W, 3]` uint16; what is not finite becomes 0."""
    values = np.array(normals, np.float32)
    np.nan_to_num(values, copy=False, nan=0, posinf=0, neginf=0)
    values *= _FULL / 2
    values += _FULL / 2 + 0.5  # the nearest integer is the one below
    return np.clip(values, 0, _FULL, out=values).astype(np.uint16)


def decode_normals(values: np.ndarray) -> np.ndarray:
    """Normals, not normalised, of uint8 or uint16; float32 holds them already."""
    if values.dtype == np.float32:
        return values
    top = np.iinfo(values.dtype).max
    normals = (values * (2 / top) - 1).astype(np.float32)
    normals[((values == top // 2) | (values == top // 2 + 1)).all(axis=-1)] = 0
    return normals


def read_normals(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads a map of 8 or 16 bits or floats, or a `.npy` of floats.

    Returns `[H, W, 3]`, float32, not normalised. `InputError` if it is none.
    """
    path = Path(path)
    if path.suffix.lower() != ".npy":
        return normals_of(read_image_file(path, vectors=True))
    values = read_numbers(path)
    if values.ndim != 3 or values.shape[2] != 3 or values.dtype.kind != "f":
        raise InputError(
            f"{path}: expected normals, floats [H, W, 3], got {values.dtype} of "
            f"{values.shape}"
        )
    return values.astype(np.float32)


def read_numbers(path: Path) -> np.ndarray:
    """Reads a `.npy` file of numbers, in its own type."""
    try:
        regular = stat.S_ISREG(path.stat().st_mode)
        if regular:
            # As a map of the file: headers may claim any size.
            values = np.array(np.lib.format.open_memmap(path, mode="r"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # damaged headers raise what they like
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: expected an array of numbers: {reason}") from None
    if not regular:
        raise InputError(f"{path}: expected a file, got a folder, pipe or device")
    if values.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected numbers, got {values.dtype}")
    return values


def normals_of(file: ImageFile) -> np.ndarray:
    """What a normal map's image holds; see `read_normals`."""
    require_normal_map(file)
    return decode_normals(file.pixels)


def require_normal_map(file: ImageFile) -> None:
    """Refuses images of other than three channels, or of values that are not finite."""
    require_three_channels(file)
    require_finite(file.path, file.pixels)


def require_three_channels(file: ImageFile) -> None:
    """Refuses images of other than three channels."""
    if file.pixels.shape[2] != 3:
        raise InputError(
            f"{file.path}: expected a normal map of 3 channels, got {file.channels}"
        )


def has_unit_length(normals: np.ndarray, tolerance: float = 1e-3) -> np.ndarray:
    """PS-Wild's rule for the object's pixels, | 1 - |n| | < 1e-3: `[H, W]`, bool."""
    length = np.linalg.norm(normals.astype(np.float64), axis=-1)
    return np.abs(1 - length) < tolerance


def true_pixels(normals: np.ndarray) -> np.ndarray:
    """Where a map of true normals has some: `[H, W]`, bool.

    By PS-Wild's rule, or within 5 % where that leaves less than half: of values of 8
    bits, whatever the file has, or of a map that was made smaller.
    """
    roughly, exactly = has_unit_length(normals, 0.05), has_unit_length(normals)
    return exactly if 2 * exactly.sum() >= roughly.sum() else roughly


def turn_normals(normals: np.ndarray, normal_map: NormalMap) -> np.ndarray:
    """Normals of arrays as those of a map's convention, and back."""
    if normal_map not in _SIGNS:
        raise ValueError(
            f"normal_map: expected one of {tuple(_SIGNS)}, got {normal_map!r}"
        )
    return normals * np.array(_SIGNS[normal_map], normals.dtype)
