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
    """Bounds on what one server takes; memory is of all visitors together."""

    file_bytes: int = 200_000_000
    object_bytes: int = 4_000_000_000
    files: int = 200
    objects: int = 50  # that have no result yet
    pixels: int = 100_000_000  # of a photograph
    # memory of the process that looks at single photographs
    looking_bytes: int = _of_machine(0.12, 4 * 2**30)
    # of the one that reads all of an object
    gathering_bytes: int = _of_machine(0.20, 8 * 2**30)
    estimating_bytes: int = _of_machine(0.45)
    looking_s: float = 60  # for one photograph; a video has ten times that
    gathering_s: float = 600
    stalled_s: float = 60  # an upload of which nothing comes for this time is given up
    left_s: float = 30  # photographs are read on after their page has gone
    draft_days: float = 30  # for photographs without an estimate, and what was removed


def limit_memory(limit: int) -> None:
    """Bounds the bytes this process may allocate, where the system can; 0: none."""
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
