"""What visitors may use: bytes, files, memory, time."""

import contextlib
import dataclasses
import os


def _of_machine(share: float, most: float = float("inf")) -> int:
    """Bytes of memory; 0 where the system does not say how much there is."""
    with contextlib.suppress(ValueError, OSError, AttributeError):
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        return int(min(there * share, most))
    return 0


@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds on what one server takes; memory is of all visitors together.

    Attributes:
        file_bytes: of an uploaded file.
        object_bytes: of all files of an object.
        files: of an object.
        objects: that have no result yet.
        pixels: of a photograph.
        looking_bytes: memory of the process that looks at single photographs.
        gathering_bytes: of the one that reads all of an object.
        estimating_bytes: of the one that estimates.
        looking_s: time for one photograph; a video has ten times that.
        gathering_s: for all of an object.
        stalled_s: an upload of which nothing comes for so long is given up.
        left_s: photographs are not read on when their page has been gone so long.
        draft_days: photographs without an estimate, and what was removed, are kept so
            long.
    """

    file_bytes: int = 200_000_000
    object_bytes: int = 4_000_000_000
    files: int = 200
    objects: int = 50
    pixels: int = 100_000_000
    looking_bytes: int = _of_machine(0.12, 4 * 2**30)
    gathering_bytes: int = _of_machine(0.20, 8 * 2**30)
    estimating_bytes: int = _of_machine(0.45)
    looking_s: float = 60
    gathering_s: float = 600
    stalled_s: float = 60
    left_s: float = 30
    draft_days: float = 30


def limit_memory(limit: int) -> None:
    """Bounds this process' memory; what asks for more fails, and nothing else does.

    In bytes of data (what is allocated, not what is mapped); 0 for none. Where the
    system knows no such limit, there is none.
    """
    if not limit:
        return
    try:
        import resource  # not on Windows
    except ImportError:
        return
    with contextlib.suppress(ValueError, OSError):
        _, most = resource.getrlimit(resource.RLIMIT_DATA)
        if most != resource.RLIM_INFINITY:
            limit = min(limit, most)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
