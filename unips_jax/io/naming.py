"""What names and suffixes show of a folder's files."""

import importlib.util
import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path

RAW_SUFFIXES = frozenset(
    ".dng .cr2 .cr3 .crw .nef .nrw .arw .srf .sr2 .raf .rw2 .rwl .orf .pef .srw .x3f"
    " .3fr .fff .iiq .mrw .kdc .dcr .erf .mef .mos .raw".split()
)

VIDEO_SUFFIXES = frozenset(
    ".mp4 .mov .m4v .avi .mkv .webm .mts .m2ts .mpg .mpeg .wmv .3gp".split()
)

_HEIC_SUFFIXES = (".heic", ".heif", ".hif")

_BETTER = (  # of a photograph in two formats; a camera's raw file is the best
    (".jpg", ".jpeg", ".jfif", ".mpo"),
    (".heic", ".heif", ".hif", ".avif", ".webp"),
    (".png", ".bmp", ".tga"),
    (".tif", ".tiff"),
    (".exr",),
)


def composed(name: str) -> str:
    """A name with each accent in its letter, not after it as macOS may write them."""
    return unicodedata.normalize("NFC", name)


def plain_name(name: str) -> str:
    """What the names of one photograph share, whatever their case and suffix."""
    return composed(Path(name).stem).casefold()


def natural_key(name: str) -> tuple[tuple[str | int, ...], str]:
    """Sorts `2.png` before `10.png`, as people and file managers do."""
    parts = re.split(r"([0-9]+)", name.lower())
    return tuple(int(p) if i % 2 else p for i, p in enumerate(parts)), name


def rows_in_order(names: Sequence[str]) -> list[int]:
    """Where names stand in natural order; as they are, unless by letters (10 before 2).

    So were photographs in order in results of version 0.3.0.
    """
    rows = list(range(len(names)))
    if list(names) == sorted(names):
        rows.sort(key=lambda row: natural_key(names[row]))
    return rows


def in_order(folder: Path) -> list[Path]:
    """What is in a folder, by its names' natural order."""
    return sorted(folder.iterdir(), key=lambda path: natural_key(path.name))


def each_once(files: list[Path], left_out: dict[str, list[str]]) -> list[Path]:
    """Each photograph once, of names that differ in their suffix alone.

    Of two formats the one that most have, or the better. `left_out` receives the
    others' names, by reason.
    """
    stems: dict[str, list[Path]] = {}
    for file in files:
        stems.setdefault(file.stem, []).append(file)
    if len(stems) == len(files):
        return files
    most: dict[str, int] = {}
    for file in files:
        most[file.suffix.lower()] = most.get(file.suffix.lower(), 0) + 1

    def worth(file: Path) -> tuple[int, int]:
        suffix = file.suffix.lower()
        better = [suffix in suffixes for suffixes in _BETTER]
        rank = better.index(True) if True in better else -1
        reader = "rawpy" if suffix in RAW_SUFFIXES else ""
        if suffix in _HEIC_SUFFIXES:
            reader = "pillow_heif"
        known = not reader or importlib.util.find_spec(reader) is not None
        return most[suffix] * known, len(_BETTER) if reader == "rawpy" else rank

    taken = {max(alike, key=worth) for alike in stems.values()}
    for file in files:
        if file not in taken:
            kept = next(f for f in stems[file.stem] if f in taken)
            reason = f"the same photographs as {kept.suffix}"
            left_out.setdefault(reason, []).append(file.name)
    return [file for file in files if file in taken]
