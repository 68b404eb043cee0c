"""Folders of results: all files appear at once, and a later run knows them again.

`normals.json`, the record, holds the hash of every other file, so that results that
were changed or damaged since are known from whole ones.
"""

import contextlib
import errno
import hashlib
import json
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from unips_jax.errors import InputError
from unips_jax.io.claims import claim
from unips_jax.io.color import Transfer
from unips_jax.io.door import (
    NotWritten,
    clear_parts,
    move,
    patiently,
    write_json,
    writing,
)
from unips_jax.io.images import ImageFile
from unips_jax.io.record_schema import file_of, load_record

RECORD = "normals.json"
_RESULTS = frozenset(
    "normals.png normals.npy normals.exr normals.mat sheet.png depth.exr depth.png "
    "height.png mesh.ply mesh.obj mesh.glb view.html lights.json lights.lp "
    "base_color.exr base_color.png relight.ptm confidence.exr confidence.png "
    "unreliable.png info.json plane_0.jpg plane_1.jpg plane_2.jpg plane_3.jpg "
    "plane_4.jpg plane_5.jpg".split()
    + [RECORD]
)
_MASK, _VIEW = "mask.png", "view.html"
# What file managers leave in folders that look empty in them.
UNSEEN = frozenset([".DS_Store", "Thumbs.db", "desktop.ini"])
_EDITABLE = frozenset([_VIEW])  # readers save their notes into it
_NOTES = b'<script type="application/json" id="notes">'
_WITHOUT_NOTES = _NOTES + b"{}</script>"
# Names apart from the results': those may be as long as names can be.
_WORK = ".unips-"
_BEFORE = "before-"


def file_hash(file: Path) -> str:
    """SHA-256 of a file's contents, as `sha256sum` prints it."""
    try:
        with file.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from None


def write_record(folder: Path, record: dict[str, Any]) -> list[str]:
    """Writes `normals.json` after the other files; returns the names of all."""
    hashes = {file.name: file_hash(file) for file in sorted(folder.iterdir())}
    write_json(folder / RECORD, {**record, "files": hashes}, indent=2)
    return sorted([*hashes, RECORD])


def read_record(folder: Path) -> dict[str, Any] | None:
    """The record of a folder of results; None unless all files are as written."""
    try:
        record = whole_record(folder)
    except InputError:
        return None
    return record if all((folder / n).is_file() for n in record["files"]) else None


def whole_record(folder: Path) -> dict[str, Any]:
    """The record of a folder of results; refused if a file was changed since.

    The page that readers edit may be another, and gone.
    """
    record = load_record(folder / RECORD)
    for name, value in record["files"].items():
        if name not in _EDITABLE and file_hash(file_of(folder, name)) != value:
            raise InputError(
                f"{folder / name}: expected the file that `unips estimate` wrote, got "
                "another; estimate anew"
            )
    return record


def require_results(folder: Path) -> None:
    """Raises InputError for a folder that holds no results of an object itself."""
    if (folder / RECORD).is_file() or (folder / "normals.npy").is_file():
        return
    inside = sorted(path for path in folder.iterdir() if (path / RECORD).is_file())
    if inside:
        hint = f"it holds those of {len(inside)}: give {inside[0]}"
    else:
        hint = f"`unips estimate {folder} -o OUT` makes some of photographs"
    raise InputError(
        f"{folder}: expected an object's results by `unips estimate`, got none; {hint}"
    )


def results_of(folder: Path) -> list[Path]:
    """The files of a folder of results, there and named by its record if it has one."""
    if not (folder / RECORD).is_file():
        return [folder / "normals.npy"] if folder.is_dir() else [folder]
    names = whole_record(folder)["files"]
    files = [folder / name for name in [*names, RECORD]]
    return [file for file in files if file.is_file()]


def transfer_of(file: ImageFile) -> Transfer:
    """How values encode light: by tags; our base colours are sRGB, tagged or not."""
    ours = file.path.name == "base_color.png" and (file.path.parent / RECORD).is_file()
    return "srgb" if ours else file.encoding.transfer


def normal_map_of(folder: Path) -> str:
    """The convention of a folder's pictures of normals."""
    if not (folder / RECORD).is_file():
        return "opengl"
    options = load_record(folder / RECORD).get("options", {})
    return options.get("normal_map", "opengl")


def check_target(target: Path, source: Path, *, record: str = RECORD) -> None:
    """Refuses what cannot become a folder of results, before there are any.

    That is the folder of the photographs, a file, a folder with files that this program
    did not write (by its `record`), or a place where nothing may be written.
    """
    try:
        _check_target(target, source, record)
    except OSError as error:
        raise InputError(
            f"{_shortened(target)}: cannot become a folder of results: "
            f"{error.strerror}; choose another -o"
        ) from None


def clear_leftovers(parent: Path) -> None:
    """Removes what killed processes left; results they had set aside come back."""
    if not parent.is_dir():
        return
    clear_parts(parent)
    for lock in parent.glob(f"{_WORK}*.lock"):
        with contextlib.suppress(InputError), claim(lock) as nobodys:
            if nobodys:
                _dissolve(lock)


@contextlib.contextmanager
def appearing_at_once(
    target: Path, *, record: str = RECORD, ours: Sequence[str] = ()
) -> Iterator[Path]:
    """Gives a temporary folder that becomes `target` when all is written.

    An earlier folder of results is set aside and the new one put in its place, by two
    renames. Files in it that are not listed by its `record` are kept, unless their name
    fits a pattern of `ours`. If anything fails, the target stays as it was, and the
    error is `NotWritten` where the file system refused. A process that is killed before
    the first rename leaves the earlier results, after the second the new ones; between
    them, none, until `clear_leftovers` brings the earlier ones back.
    """
    place = Path(os.path.realpath(target))
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        clear_leftovers(place.parent)
        with workspace(place.parent) as work:
            new = work / "new"
            new.mkdir()
            yield new
            if place.is_dir():
                _carry_over(place, new, record, ours)
            _switch(place, new, work)
    except (OSError, NotWritten) as error:
        raise NotWritten(target, error) from None


@contextlib.contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Gives a temporary folder whose files move into `folder` when all are written.

    Files of the same names are replaced, others stay. If writing fails, all stays as it
    was.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        clear_leftovers(folder)
        with workspace(folder) as work:
            yield work
            for file in sorted(work.iterdir()):
                move(file, folder / file.name)


def _check_target(target: Path, source: Path, record: str) -> None:
    place = Path(os.path.realpath(target))
    if place == Path(os.path.realpath(source)):
        raise InputError(
            f"{target}: expected another place for the results than the photographs' "
            "own folder; choose another -o"
        )
    there = place.exists() or place.is_symlink()  # a link to itself does not exist
    if there and not place.is_dir():
        raise InputError(
            f"{target}: expected a folder for the results, got a file; choose another "
            "-o"
        )
    others = there and {path.name for path in place.iterdir()} - UNSEEN
    if others and not (place / record).is_file():
        raise InputError(
            f"{target}: expected a new folder or one with earlier results "
            f"({record}), got one with other files; choose another -o"
        )
    above = next(p for p in place.parents if p.exists() or p.is_symlink())
    for needed in (above, place) if there else (above,):
        if not (needed.is_dir() and os.access(needed, os.W_OK)):
            raise InputError(
                f"{_shortened(target)}: cannot be written, {needed} is a file or may "
                "not be written to; choose another -o"
            )
    if os.path.ismount(place):
        raise InputError(
            f"{target}: expected a folder that can be replaced, got one that is "
            "mounted; choose a folder in it as -o"
        )


def _shortened(path: Path) -> str:
    text = str(path)
    return text if len(text) < 400 else f"{text[:200]}...{text[-100:]}"


@contextlib.contextmanager
def workspace(parent: Path) -> Iterator[Path]:
    """A folder of ours alone that nobody clears while this process lives."""
    lock = parent / f"{_WORK}{secrets.token_hex(8)}.lock"
    with contextlib.ExitStack() as held:
        # Without locks, nobody else clears it either.
        with contextlib.suppress(InputError):
            held.enter_context(claim(lock, wait=True))
        try:
            # Under Windows what is made in a private folder stays private when moved.
            lock.with_suffix("").mkdir(0o777 if sys.platform == "win32" else 0o700)
            yield lock.with_suffix("")
        finally:
            _dissolve(lock)


def _carry_over(place: Path, new: Path, record: str, patterns: Sequence[str]) -> None:
    """Takes the user's files along, as further names of the same files."""
    earlier: dict[str, Any] = {}
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        listed = json.loads((place / record).read_bytes())["files"]
        earlier = dict(listed) if isinstance(listed, dict) else dict.fromkeys(listed)
    known: frozenset[str] = frozenset()
    if record == RECORD and (place / record).is_file():
        # Early versions listed no files; `unips view` adds its page to any.
        known = frozenset([_VIEW]) if earlier else _RESULTS
    ours = {*known, record, *earlier} - _by_hand(place, new, earlier)
    ours |= {file.name for file in new.iterdir()}

    def left(folder: str, names: list[str]) -> set[str]:
        if Path(folder) != place:
            return set()
        fitting = {n for n in names if any(fnmatch(n, each) for each in patterns)}
        return ours & set(names) | fitting

    shutil.copytree(
        place,
        new,
        symlinks=True,
        ignore=left,
        copy_function=link_or_copy,
        dirs_exist_ok=True,
    )


def mended_mask(target: Path) -> Path | None:
    """A folder's `mask.png`, if it is not what was written with the results."""
    mask, listed = target / _MASK, {}
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        listed = dict(json.loads((target / RECORD).read_bytes())["files"])
    if mask.is_file() and listed.get(_MASK) != file_hash(mask):
        return mask
    return None


def _by_hand(place: Path, new: Path, hashes: dict[str, Any]) -> set[str]:
    """Of our files those that a reader changed or gave: there may be no copy."""
    mask, view, found = place / _MASK, place / _VIEW, set()
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        given = json.loads((new / RECORD).read_bytes())["mask"]
        if given is not None and Path(given).resolve() == mask.resolve():
            found.add(_MASK)
    with contextlib.suppress(OSError, InputError):
        if mask.is_file() and hashes.get(_MASK) not in (None, file_hash(mask)):
            found.add(_MASK)
        page = view.read_bytes() if view.is_file() else b""
        if _NOTES in page and _WITHOUT_NOTES not in page:
            found.add(_VIEW)
    return found


def link_or_copy(source: str, target: str) -> None:
    """Gives a file another name; a copy where there are no links."""
    try:
        os.link(source, target, follow_symlinks=False)
    except (OSError, NotImplementedError):  # not every file system has links
        with writing(Path(target)):  # else `copytree` collects what failed
            shutil.copy2(source, target, follow_symlinks=False)


def _switch(place: Path, new: Path, work: Path) -> None:
    while True:
        try:
            patiently(new.rename, place)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        aside = Path(tempfile.mkdtemp(prefix=_BEFORE, dir=work))
        with contextlib.suppress(FileNotFoundError):  # another process was faster
            patiently(place.rename, aside / place.name)


def _dissolve(lock: Path) -> None:
    """Removes a workspace; what was set aside comes back where nothing replaced it."""
    work = lock.with_suffix("")
    with contextlib.suppress(OSError):
        for before in work.glob(f"{_BEFORE}*/*"):
            if not (work.parent / before.name).exists():
                before.rename(work.parent / before.name)
        shutil.rmtree(work, ignore_errors=True)
        lock.unlink()
