"""A doctor for normal maps: what is certain is mended, what is likely is reported.

Maps by others come on backgrounds of any colour, with alpha, in other ranges
(`io.normal_values`), with axes the other way. Each shows in the numbers:

- a normal has length 1 and faces the viewer; a background has not, or is transparent;
- slopes fit together, and normals point outwards along an outline (`io.normal_axes`).
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import tifffile

from unips_jax.errors import InputError
from unips_jax.io.formats.tiff import whole_pages
from unips_jax.io.images import read_image_file
from unips_jax.io.naming import VIDEO_SUFFIXES
from unips_jax.io.normal_axes import SURE, facing, integrability, other_axes
from unips_jax.io.normal_values import OVERRULE, UNIT, decode_values, foreground
from unips_jax.io.normals import NormalMap, decode_normals, read_numbers, turn_normals
from unips_jax.io.record import print_line
from unips_jax.io.record_schema import load_record
from unips_jax.io.results import RECORD, require_results

_OFF = 0.25  # of a length: JPEG and resizing leave less in most pixels
_AWAY = -0.35  # z: wide lenses see what faces away by as much
_STEEP = 0.2  # z
_CUT = 35.0  # degrees between a flat background and what lies on it


class Examined(NamedTuple):
    """A normal map, read."""

    # `[H, W, 3]`, float32, x right, y up, z towards the viewer, of unit length, 0 where
    # there is no surface
    normals: np.ndarray
    mended: tuple[str, ...] = ()  # what was certain, a line each
    # what is likely, a line each, with the option that settles it
    doubts: tuple[str, ...] = ()
    # the correlation of dp/dy and dq/dx, 0 where nothing is known
    integrability: float = 0.0


def read_normal_map(
    path: Path, convention: NormalMap = "opengl", *, as_stored: bool = False
) -> Examined:
    """Reads and examines an image, a `.npy`, or a folder of results, always opengl.

    With `as_stored` the values are believed: nothing is mended or doubted.
    """
    if path.is_dir():
        require_results(path)
        if (path / RECORD).exists():
            load_record(path / RECORD)
        path, convention = path / "normals.npy", "opengl"
    alpha = None
    if path.suffix.lower() == ".npy":
        values = read_numbers(path)
    else:
        file = read_image_file(path, vectors=True)
        values, alpha = file.pixels, file.alpha
    if values.ndim != 3 or values.shape[2] != 3 or 0 in values.shape:
        raise InputError(
            f"{path}: expected normals, [H, W, 3], got {values.shape}; "
            "give a normal map of 3 channels"
        )
    if as_stored:
        image = path.suffix.lower() != ".npy"
        normals = decode_normals(values) if image else values.astype(np.float32)
        found = Examined(_unit(turn_normals(normals, convention)))
    else:
        found = examine_normals(values, alpha=alpha, convention=convention)
        if path.suffix.lower() == ".npy" and values.dtype.kind == "u":
            line = f"the array holds {values.dtype}: read as a picture's (n + 1) / 2"
            found = found._replace(mended=(line, *found.mended))
    if not found.normals.any():
        raise InputError(
            f"{path}: expected normals, got none: no pixel has one; give another file, "
            f"or {OVERRULE}"
        )
    return found


def is_normal_map(path: Path) -> bool:
    """Whether a path may be a normal map: one picture, or an array, not photographs."""
    suffix = path.suffix.lower()
    if not path.is_file() or suffix in VIDEO_SUFFIXES:
        return False
    if suffix not in (".tif", ".tiff"):
        return True
    try:
        with tifffile.TiffFile(path) as tiff:
            if int((tiff.imagej_metadata or {}).get("images", 1)) > 1:
                return False  # a stack may be one page
            return len(whole_pages(tiff)) < 2
    except Exception:  # damaged: reading finds out
        return True


def print_examined(found: Examined) -> None:
    """Prints what was mended, and on standard error what is likely wrong."""
    for text in found.mended:
        print_line("normals", text)
    for text in found.doubts:
        print(f"warning: {text}", file=sys.stderr)


def examine_normals(
    values: np.ndarray,
    *,
    alpha: np.ndarray | None = None,
    convention: NormalMap = "opengl",
) -> Examined:
    """Examines the values of a normal map, or of an array of normals.

    Of `[H, W, 3]`, uint8 and uint16 hold (n + 1) / 2, other types n, finite or not;
    alpha `[H, W]` is opaque at its type's largest value, or at 1.
    """
    mended: list[str] = []
    doubts: list[str] = []
    if values.dtype not in (np.uint8, np.uint16):
        values = values.astype(np.float64 if values.dtype.itemsize > 4 else np.float32)
        most = np.abs(values[np.isfinite(values)]).max(initial=0)
        values = (values / (most if most > 1e6 else 1)).astype(np.float32)
    there = np.isfinite(values).all(-1)
    if not there.all():
        mended.append(f"{_count(~there)} are not finite: no surface there")
    if alpha is not None:
        there &= _opaque(alpha, mended, doubts)
    normals = turn_normals(decode_values(values, there, mended), convention)
    there = _surface(normals, values.dtype.kind == "u", mended, doubts)
    normals = _unit(np.where(there[..., None], normals, 0))
    if there.any() and (normals[..., 2][there] < 0).mean() > 0.95:
        normals = normals * np.array(facing(normals, mended), np.float32)
    found = integrability(normals)
    if found < -SURE:
        doubts.append(other_axes(normals, found, convention))
    plane = _plane_around(normals)
    if plane is not None:
        doubts.append(
            f"{_count(plane)} around the object are one plane: it counts as surface; "
            "--mask FILE leaves it out"
        )
    return Examined(normals, tuple(mended), tuple(doubts), found)


def _unit(normals: np.ndarray) -> np.ndarray:
    """Normals of length 1, float32; 0 where they are 0 or not finite."""
    normals = np.nan_to_num(normals, nan=0.0, posinf=0.0, neginf=0.0)
    most = np.abs(normals).max(-1, keepdims=True)  # else squares might overflow
    normals = normals / np.where(most > 1e-6, most, np.inf)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return (normals / np.where(length > 0, length, 1)).astype(np.float32)


def _count(pixels: np.ndarray) -> str:
    return f"{np.count_nonzero(pixels):,} of {pixels.size:,} pixels"


def _opaque(alpha: np.ndarray, mended: list[str], doubts: list[str]) -> np.ndarray:
    top = np.iinfo(alpha.dtype).max if alpha.dtype.kind in "ui" else 1.0
    share = np.nan_to_num(alpha / top)
    clear = share < 0.5
    if not clear.any() or clear.all():
        return np.ones(alpha.shape, bool)
    if ((share > 0.02) & (share < 0.98)).mean() > 0.1:
        doubts.append(
            "alpha has many values, as heights have: it is not used; --mask FILE "
            "leaves out what is no surface"
        )
        return np.ones(alpha.shape, bool)
    mended.append(f"{_count(clear)} are transparent: no surface there")
    return ~clear


def _surface(
    normals: np.ndarray, encoded: bool, mended: list[str], doubts: list[str]
) -> np.ndarray:
    """Where lengths are about 1 and normals do not face away: `[H, W]`, bool."""
    length = np.linalg.norm(normals, axis=-1)
    some = length > 1e-3
    seen = foreground(normals, some)
    off = np.abs(length - 1)
    border = some & ~seen
    # Where the border's colour is a normal, as of a plane, it is surface.
    plane = border.any() and np.median(off[border]) < 2 * UNIT
    background = border & (off > UNIT) & (not plane)
    unit = off < 2 * UNIT
    share = float(np.count_nonzero(unit & seen)) / max(int(np.count_nonzero(seen)), 1)
    if share < 0.6:
        left = np.count_nonzero(some & ~background)
        if encoded and np.count_nonzero(unit & some & ~background) < 0.15 * left:
            doubts.append(
                "few values have a normal's length: is it a normal map? If so, export "
                "it again, without loss"
            )
        usual = np.median(length[some]) if some.any() else 1.0
        return some & ~background & (np.abs(length / usual - 1) < 0.7)
    away = normals[..., 2] < _AWAY
    if (normals[..., 2][seen] < 0).mean() > 0.9:
        away = normals[..., 2] > -_AWAY
    far = background | (some & ((length > 1 + _OFF) | away))
    far = _together(far, some & (length < 1 - _OFF), ~some)
    # A grey background needs no word, nor what JPEG left around the object there.
    known = far & (length > 0.3)
    if border.any() and np.median(length[border]) < 0.3:
        known = scipy.ndimage.binary_erosion(known, iterations=3)
    if known.mean() > 0.02:
        mended.append(
            f"{_count(far)} hold no normal (not of unit length, or facing away): no "
            f"surface there; --mask FILE says where it is, {OVERRULE} takes all"
        )
    if np.count_nonzero(away & unit & seen) > 0.05 * np.count_nonzero(seen):
        doubts.append(
            f"{_count(away & unit & seen)} hold normals that face away, as in maps in "
            "an object's own frame: give one in the camera's"
        )
    there = some & ~far & (length > 0.3)
    return there & ~_blended(normals, length, there) if encoded else there


def _blended(normals: np.ndarray, length: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Steep pixels of an edge that JPEG mixed with the background: `[H, W]`.

    Their depths would outweigh all others'. None where nothing was lost.
    """
    off = np.abs(length - 1)
    inner = scipy.ndimage.binary_erosion(there, iterations=4)
    if not inner.any() or (off[inner] > 0.02).mean() < 0.02:
        return np.zeros_like(there)
    rim = there & scipy.ndimage.binary_dilation(~there, iterations=2)
    toward = np.sign(np.median(normals[..., 2][inner])) * normals[..., 2]
    return rim & (off > 2 * UNIT) & (toward < _STEEP * length)


def _together(far: np.ndarray, short: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """What is no surface: `far`, and what is `short` of length 1 next to it."""
    labels, count = scipy.ndimage.label(far | short)
    large = np.bincount(labels.ravel(), minlength=count + 1) >= max(30, 1e-4 * far.size)
    near = scipy.ndimage.binary_dilation(outside, border_value=1)
    large[labels[near]] = True
    with_far = np.zeros(count + 1, bool)
    with_far[labels[far]] = True
    return (large & with_far)[labels] & (far | short)


def _plane_around(normals: np.ndarray) -> np.ndarray | None:
    """A plane that faces the viewer around an object with an outline: `[H, W]`."""
    flat = normals[..., 2] > 0.9999
    edge = np.ones(flat.shape, bool)
    edge[1:-1, 1:-1] = False
    if flat[edge].mean() < 0.9:
        return None
    labels, count = scipy.ndimage.label(flat)
    outer = np.zeros(count + 1, bool)
    outer[labels[edge]] = True
    outer[0] = False
    around = outer[labels]
    thing = (normals != 0).any(-1) & ~flat
    inner = scipy.ndimage.binary_erosion(thing, iterations=3)
    rim = scipy.ndimage.binary_dilation(around, iterations=2) & thing
    if np.count_nonzero(rim) < 40 or around.mean() < 0.05:
        return None
    if np.count_nonzero(inner) < 0.4 * np.count_nonzero(thing):
        return None
    z = np.clip(np.median(normals[..., 2][rim]), -1, 1)
    return around if np.degrees(np.arccos(z)) > _CUT else None
