"""SHA-256 checksums of a folder's files, in a list that `sha256sum -c` reads too."""

import hashlib
from pathlib import Path

from unips_jax.io.door import write_whole

_NAME = "SHA256SUMS"


def write_checksums(folder: Path) -> None:
    """Lists the checksums of a folder's files in `SHA256SUMS`, whole or not at all."""
    lines = [f"{digest}  {name}\n" for name, digest in _checksums(folder).items()]
    write_whole(folder / _NAME, "".join(lines).encode())


def damage(folder: Path) -> str | None:
    """What is wrong with a folder's files; None if they are as they were written."""
    if not (folder / _NAME).is_file():
        return f"it has no {_NAME}"
    try:
        lines = (folder / _NAME).read_text("utf-8").splitlines()
        found = _checksums(folder)
    except (OSError, UnicodeDecodeError) as error:
        return f"it cannot be read: {error}"
    listed = {name: digest for digest, _, name in (x.partition("  ") for x in lines)}
    for name in sorted(listed.keys() | found.keys()):
        if name not in found:
            return f"{name!r} is missing"
        if listed.get(name) != found[name]:
            return f"{name!r} is not as it was written"
    return None if found else "it is empty"


def _checksums(folder: Path) -> dict[str, str]:
    """By name, without what systems add, such as `.nfs0001` or `.DS_Store`."""
    sums = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name != _NAME and not path.name.startswith("."):
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            sums[path.relative_to(folder).as_posix()] = digest
    return sums
