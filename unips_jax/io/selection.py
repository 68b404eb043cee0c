"""Which files of a folder are photographs, and which is their mask. Reads none.

What is taken: in a folder `X.data` (the authors' layout) the images `L*`, or else `0*`;
elsewhere every image file. Not a normal, depth or material map, a mask, ground truth or
this package's own output, by their names (`is_map`; `plane_0.jpg` to `plane_5.jpg` next
to its records), and never hidden files. Names decide only between files: if they leave
none, or one beside three or more, a numbered series with such a word in its name
(`metal_bowl_0.png`, ...) is taken. The user's patterns overrule names. An RTI's list of
lights (.lp) names the photographs; one in two formats counts once. Files are in the
natural order of their names (2 before 10); whatever is left out is listed with its
reason.
"""

import dataclasses
import fnmatch
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from unips_jax.errors import InputError
from unips_jax.io.light_list import read_light_list
from unips_jax.io.naming import (
    RAW_SUFFIXES,
    VIDEO_SUFFIXES,
    composed,
    each_once,
    in_order,
    plain_name,
)

SUFFIXES = RAW_SUFFIXES | frozenset(
    ".png .jpg .jpeg .jfif .tif .tiff .webp .bmp .exr .hdr".split()
    + ".pgm .ppm .pnm .pbm .gif .tga .mpo .heic .heif .hif .avif".split()
)

_UNREAD_SUFFIXES = frozenset(".jxl .jp2 .psd .xcf .svg .pdf".split())

_MAP_WORDS = "normals?|nrm|masks?|depth|base[ _-]?colou?r|roughness|metal(?:lic|ness)?"
_MAP_NAME = re.compile(
    # Such a word of its own.
    rf"\b(?:{_MAP_WORDS}|albedo|gt)\b|^shading\b|^sheet$|^height$"
    r"|^confidence$|^unreliable$|^plane [0-5]$",
    re.IGNORECASE,
)
_MAP_ONLY = re.compile(
    rf"(?:{_MAP_WORDS}|albedo|shading|sheet|gt|[\W\d_])*", re.IGNORECASE
)

_SERIES = re.compile(r"\d+")  # what differs
_PLANE = re.compile(r"plane_[0-5]\.jpg")  # of a texture map, or of a toy plane
_PLANES_OF = {"info.json", "normals.json"}


def is_map(name: str) -> bool:
    """Whether a file is, by its name, a map or an output and no photograph.

    `normal_gt.png`, `objMask.tif` and `baseColor.tif` are maps; `length_01.png` and
    `abnormal.jpg` are not.
    """
    words = re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", Path(name).stem)
    words = re.sub(r"[\W_]+|(?<=[a-zA-Z])(?=\d)", " ", words).strip()
    return bool(_MAP_NAME.search(words))


def is_photograph(path: Path) -> bool:
    """Whether a file is, by its name, an image, not hidden and no map."""
    return (
        path.suffix.lower() in SUFFIXES
        and not path.name.startswith(".")
        and not is_map(path.name)
    )


@dataclasses.dataclass(frozen=True)
class Selection:
    """Which files of a folder are photographs.

    `files`, at least one, are in order; `left_out` holds for each reason the
    names left out for it; `source` is the file that the photographs lie in, where the
    folder is temporary.
    """

    folder: Path
    files: tuple[Path, ...]
    left_out: dict[str, list[str]]
    mask_file: Path | None
    source: Path | None = None

    @property
    def title(self) -> str:
        """What messages call the set."""
        return str(self.source or self.folder)

    @property
    def names(self) -> tuple[str, ...]:
        """The photographs' file names."""
        return tuple(file.name for file in self.files)


def select(
    folder: Path,
    *,
    mask_file: Path | None = None,
    include: Sequence[str] = (),
    exclude: Sequence[str] = (),
    masks: bool = True,
) -> Selection:
    """Finds the photographs and the mask of a folder, without reading them.

    Images that match `include`, such as `img_*.png`, are the photographs, whatever they
    are called; `exclude` leaves out the folder's own mask too. Without `masks` all of
    its own are left out.
    """
    if not folder.is_dir():
        what = "a file" if folder.exists() else "nothing of this name"
        hint = f"; give its folder, {folder.parent}" if folder.exists() else ""
        raise InputError(
            f"{folder}: expected a folder of photographs, got {what}{hint}"
        )
    try:
        entries = in_order(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from None
    unmet = [p for p in exclude if not any(_fits(e, [p]) for e in entries)]
    entries = [e for e in entries if not e.name.startswith(".")]
    own = [e for e in entries if _is_mask(e) and not _fits(e, exclude)]
    unused = "by --mask none" if not masks else "a mask, and another one is given"
    if masks and mask_file is None:
        mask_file, own = _only_mask(folder, own), []
    entries = [e for e in entries if e not in own]
    if mask_file and not mask_file.is_file():
        raise InputError(f"{mask_file}: expected a mask's image file, got no such file")
    images, left_out = _images(entries, mask_file, include, exclude)
    if others := [e.name for e in own if not (mask_file and _same(e, mask_file))]:
        left_out[unused] = others
    if unmet:
        left_out["by --exclude, which fits no file"] = unmet
    files = images if include else _by_name(folder, entries, images, left_out)
    files = each_once(files, left_out)
    if not files:
        raise InputError(_nothing_found(folder, entries, left_out))
    return Selection(folder, tuple(files), left_out, mask_file)


def drawn(selection: Selection, count: int, seed: int = 0) -> Selection:
    """At most `count` of the photographs; the same seed and files, the same choice."""
    files = selection.files
    if count >= len(files):
        return selection
    chosen = np.random.default_rng(seed).choice(len(files), count, False)
    reason = f"not among the {count} drawn with seed {seed}"
    others = [f.name for i, f in enumerate(files) if i not in chosen]
    return dataclasses.replace(
        selection,
        files=tuple(files[i] for i in sorted(chosen)),
        left_out={**selection.left_out, reason: others},
    )


def unicode_name(name: str) -> str:
    """A name whose bytes are not Unicode with question marks in their place."""
    return os.fsencode(name).decode(errors="replace")


def folder_name(folder: Path) -> str:
    """A folder's name as given, without ".data", or a file's, without its suffix.

    Links are not followed; bytes that are not Unicode are replaced by question marks.
    """
    name = unicode_name(os.path.abspath(folder))
    if folder.is_file():
        return Path(name).stem
    return Path(name).name.removesuffix(".data")


def _is_mask(file: Path) -> bool:
    named = re.fullmatch(r"(.*\.)?mask", file.stem, re.IGNORECASE)
    return bool(named) and file.suffix.lower() in SUFFIXES


def _only_mask(folder: Path, masks: list[Path]) -> Path | None:
    if len(masks) > 1:
        raise InputError(
            f"{folder}: expected one mask, got {', '.join(m.name for m in masks)}; "
            "keep one, or name it with --mask of `unips estimate`"
        )
    return masks[0] if masks else None


def _same(file: Path, other: Path) -> bool:
    # Path.resolve() fails where a link leads to itself.
    return os.path.realpath(file) == os.path.realpath(other)


def _images(
    entries: list[Path],
    mask_file: Path | None,
    include: Sequence[str],
    exclude: Sequence[str],
) -> tuple[list[Path], dict[str, list[str]]]:
    """The images that patterns leave, and what is left out, by reason."""
    images: list[Path] = []
    left_out: dict[str, list[str]] = {}
    originals: dict[str, Path] = {}
    for entry in sorted(entries, key=Path.is_symlink):  # links come last
        suffix = entry.suffix.lower()
        if entry.is_dir() or (mask_file and _same(entry, mask_file)):
            continue
        original = originals.setdefault(os.path.realpath(entry), entry)
        if _fits(entry, exclude):
            reason = "by --exclude"
        elif suffix in _UNREAD_SUFFIXES:
            reason = f"{suffix} is not read: export PNG or TIFF"
        elif suffix == ".lp":
            continue
        elif suffix in VIDEO_SUFFIXES:
            reason = "a video: give the file itself in place of the folder"
        elif suffix not in SUFFIXES:
            reason = "not an image"
        elif entry.exists() and not entry.is_file():
            reason = "a pipe or device, no regular file"
        elif include and not _fits(entry, include):
            reason = "not among --include"
        elif original != entry and entry.is_file():
            reason = f"another name of {original.name}"
        else:
            images.append(entry)
            continue
        left_out.setdefault(reason, []).append(entry.name)
    taken = set(images)
    return [entry for entry in entries if entry in taken], left_out


def _fits(entry: Path, patterns: Sequence[str]) -> bool:
    name = composed(entry.name)
    return any(fnmatch.fnmatch(name, composed(pattern)) for pattern in patterns)


def _by_name(
    folder: Path,
    entries: list[Path],
    images: list[Path],
    left_out: dict[str, list[str]],
) -> list[Path]:
    """The photographs among images; adds the others to what is left out."""
    for path in (e for e in entries if e.suffix.lower() == ".lp" and e.is_file()):
        if files := _listed(path, images, left_out):
            return files
    own = any(entry.name in _PLANES_OF for entry in entries)
    toys = [f for f in images if not own and _PLANE.fullmatch(f.name)]
    files = [file for file in images if file in toys or not is_map(file.name)]
    maps = [file for file in images if file not in files]
    series = series_of([file for file in maps if not _PLANE.fullmatch(file.name)])
    if len(series) > 2 * len(files) and len(files) < 2:  # a preview, or a dark frame
        for file in files:
            left_out[f"beside the series of {series[0].name}"] = [file.name]
        files, maps = series, [file for file in maps if file not in series]
    if maps:
        left_out["a map or output, by its name"] = [file.name for file in maps]
    if os.path.realpath(folder).endswith(".data"):
        for prefix in ("L", "0"):
            taken = [file for file in files if file.name.upper().startswith(prefix)]
            if taken:
                others = [file.name for file in files if file not in taken]
                if others:
                    left_out[f"not named {prefix}* in a .data folder"] = others
                return taken
    return files


def _listed(
    path: Path, images: list[Path], left_out: dict[str, list[str]]
) -> list[Path]:
    """The photographs that a list of lights names, if only with another suffix."""
    listed = read_light_list(path)
    if listed.problems:
        left_out[f"not understood in {path.name}"] = [*listed.problems]
    by_name = {composed(file.name).casefold(): file for file in images}
    by_stem: dict[str, list[Path]] = {}
    for file in images:
        by_stem.setdefault(plain_name(file.name), []).append(file)
    found = {}
    for name in listed.names:
        spelled = composed(name).casefold()
        alike = by_stem.get(plain_name(name)) or by_stem.get(spelled) or []
        only = alike[0] if len(alike) == 1 else None
        found[name] = by_name.get(spelled, only)
    files = [file for file in images if file in found.values()]
    others = [file.name for file in images if file not in files]
    missing = [name for name, file in found.items() if file is None]
    if len(files) < 2 or _of_another_set(len(files), missing, others):
        reason = (
            f"a list of {len(listed.names)} lights, {len(files)} of photographs here"
        )
        left_out[reason] = [path.name]
        return []
    if others:
        left_out[f"not listed in {path.name}"] = others
    if missing:
        left_out[f"listed in {path.name}, but not there"] = missing
    return files


def _of_another_set(found: int, missing: list[str], others: list[str]) -> bool:
    """Whether a list is that of other photographs, of which some have names as here."""
    # A rig's, by a camera that went on counting.
    kinds = {_SERIES.sub("0", plain_name(name)) for name in missing}
    alike = sum(_SERIES.sub("0", plain_name(name)) in kinds for name in others)
    return alike > 0 and (len(missing) > found or len(missing) == alike)


def series_of(maps: list[Path]) -> list[Path]:
    """A series among what are maps by their names, such as `metal_bowl_0.png`, ...

    The largest set of files that differ by numbers and have a name of their own.
    """
    groups: dict[str, list[Path]] = {}
    for file in maps:
        if not _MAP_ONLY.fullmatch(file.stem):
            groups.setdefault(_SERIES.sub("0", file.name), []).append(file)
    series = max(groups.values(), key=len, default=[])
    return series if len(series) > 1 else []


def _nothing_found(
    folder: Path, entries: list[Path], left_out: dict[str, list[str]]
) -> str:
    text = f"{folder}: expected photographs ({', '.join(sorted(SUFFIXES))}), got none"
    for reason, names in left_out.items():
        text += f"; {len(names)} left out ({reason}), such as {names[0]}"
    folders = [entry.name for entry in entries if entry.is_dir()]
    if folders:
        text += f"; it has folders, give those: {folder / folders[0]}"
    return text
